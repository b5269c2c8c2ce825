"""Scenarios and moving obstacles: all that is true of the world as a pure function of (world preset, seed, episode, time).

Draws of different purposes have keys of their own, so that the number of moving obstacles or their speed changes neither the static
obstacles nor start and goal, and obstacle i of S is drawn alike for every S. Every search is bounded; where its draws run out,
``WorldState.faults`` says so: a scenario is never silently made easier.
"""

import taichi as ti

from uuvtai.config import EpisodeConfig, WorldConfig
from uuvtai.kernels.core.footprint import footprint_of
from uuvtai.kernels.core.geometry import NONE
from uuvtai.kernels.core.signature import Const, In, Out, quick_launch, spread
from uuvtai.kernels.world.bodies import first_moving, put_body
from uuvtai.kernels.world.layout import draw_layout
from uuvtai.kernels.world.paths import draw_moving_bodies, path_point, polyline_length
from uuvtai.state import ClockState, EpisodeState, FixedTable, MissionState, PathState, ScenarioScratch, SceneState, WorldState


@quick_launch
@ti.kernel
def generate_scenarios(
    world: Out[WorldState],
    path: Out[PathState],
    mission: Out[MissionState],
    scratch: Out[ScenarioScratch],
    scene: In[SceneState],
    fixed: In[FixedTable],
    episode: In[EpisodeState],
    clock: In[ClockState],
    world_cfg: Const[WorldConfig],
):
    """Draw start, goal, static and moving obstacles of every awake row; ``move_obstacles`` then puts the moving ones in place."""
    n = ti.static(clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and clock.awake[env] == 1:
            clear_bodies(env, world)
            place_fixed(env, world, path, scratch, scene, fixed, world_cfg)
            draw_layout(env, world, mission, scratch, scene, episode, world_cfg)
    if ti.static(world_cfg.dynamic_slots > 0):
        for env, pad in ti.ndrange(n, ti.static(spread(n))):  # a loop of its own compiles in half the time
            if pad == 0 and clock.awake[env] == 1:
                draw_moving_bodies(env, world, path, mission, scratch, scene, episode, world_cfg)


@ti.func
def clear_bodies(env, world: Out[WorldState]):
    """Empty every slot, so that nothing of the last episode stays."""
    for slot in range(world.kind.shape[1]):
        put_body(env, slot, NONE, ti.Vector([0.0, 0.0, 0.0]), ti.Vector([0.0, 0.0, 0.0]), 0.0, world)
    world.draws[env] = 0
    world.unclear_paths[env] = 0
    world.faults[env] = 0


@ti.func
def place_fixed(
    env,
    world: Out[WorldState],
    path: Out[PathState],
    scratch: Out[ScenarioScratch],
    scene: In[SceneState],
    fixed: In[FixedTable],
    world_cfg: Const[WorldConfig],
):
    """Explicit obstacles: those at rest in the first slots, those with a path in the first moving ones."""
    n_still = ti.static(world_cfg.n_fixed_static)
    for i in range(ti.static(len(world_cfg.fixed))):
        slot = i
        lane = i - n_still
        if lane >= 0:
            slot = first_moving(world, path) + lane
            path.n_way[env, lane] = fixed.n_way[i]
            path.radius_m[env, lane] = 0.0
            path.phase_m[env, lane] = 0.0
            path.speed_m_s[env, lane] = fixed.speed_m_s[i] if fixed.speed_m_s[i] >= 0.0 else scene.speed_m_s[env]
            for j in range(path.way_w.shape[2]):
                path.way_w[env, lane, j] = fixed.way_w[i, j]
            path.length_m[env, lane] = polyline_length(env, lane, path)
        put_body(env, slot, fixed.kind[i], fixed.pos_w[i], fixed.size[i], fixed.yaw[i], world)
        scratch.footprint[env, slot] = footprint_of(fixed.kind[i], fixed.pos_w[i], fixed.size[i], fixed.yaw[i])


@quick_launch
@ti.kernel
def move_obstacles(world: Out[WorldState], path: In[PathState], clock: In[ClockState], episode_cfg: Const[EpisodeConfig]):
    """Put every moving body of the awake rows where it is at time step * dt, with its velocity; depth stays."""
    n = ti.static(clock.awake.shape[0])
    for env, lane in ti.ndrange(n, ti.static(path.n_way.shape[1])):
        slot = first_moving(world, path) + lane
        if clock.awake[env] == 1 and world.kind[env, slot] != NONE:
            speed = path.speed_m_s[env, lane]
            time_s = clock.step[env] * ti.static(episode_cfg.control_dt_s)
            at = path_point(env, lane, path.phase_m[env, lane] + speed * time_s, path)
            world.pos_w[env, slot] = ti.Vector([at[0], at[1], world.pos_w[env, slot][2]])
            world.vel_w[env, slot] = ti.Vector([speed * at[2], speed * at[3], 0.0])
