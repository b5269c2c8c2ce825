"""Scenarios and moving obstacles: all that is true of the world as a pure function of (world preset, seed,
episode, time).

Draws of different purposes have keys of their own, so that the number of moving obstacles or their speed
changes neither the static obstacles nor start and goal, and obstacle i of S is drawn alike for every S. Every
search is bounded; where its draws run out, ``WorldState.faults`` says so: a scenario is never silently made
easier.
"""

import taichi as ti

from uuvtai.kernels.core.footprint import footprint_of
from uuvtai.kernels.core.geometry import NONE
from uuvtai.kernels.core.signature import Bundle, spread
from uuvtai.kernels.world.bodies import first_moving, put_body
from uuvtai.kernels.world.bundles import WorldIO
from uuvtai.kernels.world.layout import draw_layout
from uuvtai.kernels.world.paths import draw_moving_bodies, path_point, polyline_length
from uuvtai.native.launch import quick_launch


@quick_launch
@ti.kernel
def generate_scenarios(io: Bundle[WorldIO]):
    """Draw start, goal, static and moving obstacles of every awake row; ``move_obstacles`` then puts the
    moving ones in place."""
    n = ti.static(io.clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and io.clock.awake[env] == 1:
            clear_bodies(env, io)
            place_fixed(env, io)
            draw_layout(env, io)
    if ti.static(io.world_cfg.dynamic_slots > 0):
        for env, pad in ti.ndrange(n, ti.static(spread(n))):  # a loop of its own compiles in half the time
            if pad == 0 and io.clock.awake[env] == 1:
                draw_moving_bodies(env, io)


@ti.func
def clear_bodies(env, io: Bundle[WorldIO]):
    """Empty every slot, so that nothing of the last episode stays."""
    for slot in range(io.world.kind.shape[1]):
        put_body(env, slot, NONE, ti.Vector([0.0, 0.0, 0.0]), ti.Vector([0.0, 0.0, 0.0]), 0.0, io)
    io.world.draws[env] = 0
    io.world.unclear_paths[env] = 0
    io.world.faults[env] = 0


@ti.func
def place_fixed(env, io: Bundle[WorldIO]):
    """Explicit obstacles: those at rest in the first slots, those with a path in the first moving ones."""
    n_still = ti.static(io.world_cfg.n_fixed_static)
    for i in range(ti.static(len(io.world_cfg.fixed))):
        slot = i
        lane = i - n_still
        if lane >= 0:
            slot = first_moving(io.world, io.path) + lane
            io.path.n_way[env, lane] = io.fixed.n_way[i]
            io.path.radius_m[env, lane] = 0.0
            io.path.phase_m[env, lane] = 0.0
            io.path.speed_m_s[env, lane] = (
                io.fixed.speed_m_s[i] if io.fixed.speed_m_s[i] >= 0.0 else io.scene.speed_m_s[env]
            )
            for j in range(io.path.way_w.shape[2]):
                io.path.way_w[env, lane, j] = io.fixed.way_w[i, j]
            io.path.length_m[env, lane] = polyline_length(env, lane, io)
        put_body(env, slot, io.fixed.kind[i], io.fixed.pos_w[i], io.fixed.size[i], io.fixed.yaw[i], io)
        io.scratch.footprint[env, slot] = footprint_of(
            io.fixed.kind[i], io.fixed.pos_w[i], io.fixed.size[i], io.fixed.yaw[i]
        )


@quick_launch
@ti.kernel
def move_obstacles(io: Bundle[WorldIO]):
    """Put every moving body of the awake rows where it is at time step * dt, with its velocity; depth
    stays."""
    n = ti.static(io.clock.awake.shape[0])
    for env, lane in ti.ndrange(n, ti.static(io.path.n_way.shape[1])):
        slot = first_moving(io.world, io.path) + lane
        if io.clock.awake[env] == 1 and io.world.kind[env, slot] != NONE:
            speed = io.path.speed_m_s[env, lane]
            time_s = io.clock.step[env] * ti.static(io.episode_cfg.control_dt_s)
            at = path_point(env, lane, io.path.phase_m[env, lane] + speed * time_s, io)
            io.world.pos_w[env, slot] = ti.Vector([at[0], at[1], io.world.pos_w[env, slot][2]])
            io.world.vel_w[env, slot] = ti.Vector([speed * at[2], speed * at[3], 0.0])
