"""Clock, begin and end of episodes: the referee judges every control step from the truth, in the order of the rules."""

import taichi as ti

from uuvtai.config import EpisodeConfig, TankConfig, VehicleConfig
from uuvtai.kernels.core.geometry import FAR_M, NONE, rotation_wb
from uuvtai.kernels.core.hull import hull_to_body, hull_to_floor_or_surface, hull_to_side_wall, is_in_tank
from uuvtai.kernels.core.noise import episode_key
from uuvtai.kernels.core.signature import Const, In, Out, quick_launch, spread
from uuvtai.outcomes import COLLISION, OUT_OF_TANK, OUTCOMES, RUNNING, SUCCESS, TIMEOUT, TTC
from uuvtai.state import ClockState, EpisodeState, MissionState, RefereeState, VehicleState, WorldState

__all__ = ["COLLISION", "OUTCOMES", "OUT_OF_TANK", "RUNNING", "SUCCESS", "TIMEOUT", "TTC"]


@ti.kernel
def begin_episodes(
    mask: ti.types.ndarray(dtype=ti.i32, ndim=1),  # type: ignore[valid-type]
    seed: ti.types.ndarray(dtype=ti.i32, ndim=1),  # type: ignore[valid-type]
    number: ti.types.ndarray(dtype=ti.i32, ndim=1),  # type: ignore[valid-type]
    clock: Out[ClockState],
    episode: Out[EpisodeState],
):
    """Give the rows of ``mask`` a new episode and wake only them."""
    for env in range(ti.static(clock.awake.shape[0])):
        clock.awake[env] = mask[env]
        if mask[env] == 1:
            clock.active[env] = 1
            clock.step[env] = 0
            episode.seed[env] = seed[env]
            episode.number[env] = number[env]
            episode.key[env] = episode_key(seed[env], number[env])


@quick_launch
@ti.kernel
def advance_clock(clock: Out[ClockState]):
    """One control step more for the awake rows."""
    for env in range(ti.static(clock.awake.shape[0])):
        if clock.awake[env] == 1:
            clock.step[env] += 1


@quick_launch
@ti.kernel
def wake(clock: Out[ClockState]):
    """After a reset: every running row takes part in the next step."""
    for env in range(ti.static(clock.awake.shape[0])):
        clock.awake[env] = clock.active[env]


@quick_launch
@ti.kernel
def sleep_ended(clock: Out[ClockState], referee: In[RefereeState]):
    """Rows whose episode has ended take no part in further steps."""
    for env in range(ti.static(clock.awake.shape[0])):
        if referee.outcome[env] != RUNNING:
            clock.active[env] = 0
            clock.awake[env] = 0


@ti.func
def nearest_threat(
    env,
    vehicle: In[VehicleState],
    world: In[WorldState],
    vehicle_cfg: Const[VehicleConfig],
    tank: Const[TankConfig],
    episode_cfg: Const[EpisodeConfig],
):
    """(clearance [m] to the nearest obstacle or side wall, smallest time to collision [s] with an obstacle)."""
    pos_w = vehicle.pos_w[env]
    R_wb = rotation_wb(vehicle.quat_wb[env])
    axis_w = ti.Vector([R_wb[0, 0], R_wb[1, 0], R_wb[2, 0]])
    vel_w = R_wb @ vehicle.vel_b[env]
    rate_w = R_wb @ vehicle.rate_b[env]
    clearance = hull_to_side_wall(pos_w, axis_w, vehicle_cfg, tank)
    ttc = FAR_M + 0.0
    for body in range(world.kind.shape[1]):
        kind = world.kind[env, body]
        if kind != NONE:
            gap, normal, along = hull_to_body(
                pos_w, axis_w, kind, world.pos_w[env, body], world.size[env, body], world.yaw[env, body], vehicle_cfg
            )
            hull_vel = vel_w + along * rate_w.cross(axis_w)
            closing = (hull_vel - world.vel_w[env, body]).dot(normal)
            clearance = ti.min(clearance, gap)
            if closing > episode_cfg.ttc_closing_m_s:
                ttc = ti.min(ttc, ti.max(gap, 0.0) / closing)
    return ti.Vector([clearance, ttc])


@ti.func
def outcome_of(
    env,
    referee: In[RefereeState],
    clock: In[ClockState],
    vehicle: In[VehicleState],
    mission: In[MissionState],
    vehicle_cfg: Const[VehicleConfig],
    tank: Const[TankConfig],
    episode_cfg: Const[EpisodeConfig],
):
    """How the episode stands; the first rule that holds decides."""
    pos_w = vehicle.pos_w[env]
    R_wb = rotation_wb(vehicle.quat_wb[env])
    axis_w = ti.Vector([R_wb[0, 0], R_wb[1, 0], R_wb[2, 0]])
    to_goal = mission.goal_w[env] - pos_w
    out = RUNNING
    if is_in_tank(pos_w, tank) == 0:
        out = OUT_OF_TANK
    elif referee.clearance_m[env] < episode_cfg.collision_clearance_m or hull_to_floor_or_surface(pos_w, axis_w, vehicle_cfg, tank) < 0.0:
        out = COLLISION
    elif referee.ttc_s[env] < episode_cfg.ttc_s:
        out = TTC
    elif to_goal.dot(to_goal) <= episode_cfg.goal_radius_m**2:
        out = SUCCESS
    elif clock.step[env] >= episode_cfg.horizon_steps:
        out = TIMEOUT
    return out


@quick_launch
@ti.kernel
def reset_referee(
    referee: Out[RefereeState],
    clock: In[ClockState],
    vehicle: In[VehicleState],
    world: In[WorldState],
    vehicle_cfg: Const[VehicleConfig],
    tank: Const[TankConfig],
    episode_cfg: Const[EpisodeConfig],
):
    """Start the referee's book of the awake rows with the initial clearance."""
    n = ti.static(clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and clock.awake[env] == 1:
            threat = nearest_threat(env, vehicle, world, vehicle_cfg, tank, episode_cfg)
            referee.outcome[env] = RUNNING
            referee.clearance_m[env] = threat[0]
            referee.ttc_s[env] = threat[1]
            referee.min_clearance_m[env] = threat[0]
            referee.path_length_m[env] = 0.0
            referee.last_pos_w[env] = vehicle.pos_w[env]


@quick_launch
@ti.kernel
def judge(
    referee: Out[RefereeState],
    clock: In[ClockState],
    vehicle: In[VehicleState],
    world: In[WorldState],
    mission: In[MissionState],
    vehicle_cfg: Const[VehicleConfig],
    tank: Const[TankConfig],
    episode_cfg: Const[EpisodeConfig],
):
    """Clearance, time to collision, way driven and outcome of the awake rows after they and the obstacles have moved."""
    n = ti.static(clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and clock.awake[env] == 1:
            threat = nearest_threat(env, vehicle, world, vehicle_cfg, tank, episode_cfg)
            referee.clearance_m[env] = threat[0]
            referee.ttc_s[env] = threat[1]
            referee.min_clearance_m[env] = ti.min(referee.min_clearance_m[env], threat[0])
            referee.path_length_m[env] += (vehicle.pos_w[env] - referee.last_pos_w[env]).norm()
            referee.last_pos_w[env] = vehicle.pos_w[env]
            referee.outcome[env] = outcome_of(env, referee, clock, vehicle, mission, vehicle_cfg, tank, episode_cfg)
