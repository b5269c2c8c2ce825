"""Clock, begin and end of episodes: the termination check looks at every control step from the truth, in the
order of the rules."""

import taichi as ti

from uuvtai.common.enums import COLLISION, OUT_OF_TANK, OUTCOMES, RUNNING, SUCCESS, TIMEOUT, TTC
from uuvtai.compile.launch import quick_launch
from uuvtai.config import EpisodeConfig, TankConfig, VehicleConfig
from uuvtai.kernels.core.geometry import (
    FAR_M,
    NONE,
    hull_to_floor_or_surface,
    hull_to_obstacle,
    hull_to_side_wall,
    is_in_tank,
    rotation_wb,
)
from uuvtai.kernels.core.noise import episode_key
from uuvtai.kernels.core.stage import Bundle, Const, IntVector, n_envs
from uuvtai.kernels.task.io import EpisodeIO

__all__ = ["COLLISION", "OUTCOMES", "OUT_OF_TANK", "RUNNING", "SUCCESS", "TIMEOUT", "TTC"]


@quick_launch
@ti.kernel
def begin_episodes(io: Bundle[EpisodeIO], mask: IntVector, seed: IntVector, number: IntVector):
    """Give the rows of ``mask`` a new episode and wake only them."""
    for env in range(mask.shape[0]):
        io.clock.active[env] = mask[env]
        if mask[env] == 1:
            io.clock.running[env] = 1
            io.clock.step[env] = 0
            io.episode.seed[env] = seed[env]
            io.episode.number[env] = number[env]
            io.episode.key[env] = episode_key(seed[env], number[env])


@quick_launch
@ti.kernel
def advance_clock(io: Bundle[EpisodeIO]):
    """One control step more for the active rows."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
            io.clock.step[env] += 1


@quick_launch
@ti.kernel
def wake(io: Bundle[EpisodeIO]):
    """After a reset: every running row takes part in the next step."""
    for env in range(n_envs(io.clock)):
        io.clock.active[env] = io.clock.running[env]


@quick_launch
@ti.kernel
def deactivate_ended(io: Bundle[EpisodeIO]):
    """Rows whose episode has ended take no part in further steps."""
    for env in range(n_envs(io.clock)):
        if io.termination.outcome[env] != RUNNING:
            io.clock.running[env] = 0
            io.clock.active[env] = 0


@ti.func
def threat_of(
    pos_w, axis_w, vel_w, rate_w, kind, obstacle_pos_w, size, yaw, obstacle_vel_w,
    episode_cfg: Const[EpisodeConfig], vehicle_cfg: Const[VehicleConfig],
):  # fmt: skip
    """(clearance [m], time to collision [s]) of the hull to one obstacle; FAR_M where they do not close."""
    gap, normal, along = hull_to_obstacle(pos_w, axis_w, kind, obstacle_pos_w, size, yaw, vehicle_cfg)
    closing = (vel_w + along * rate_w.cross(axis_w) - obstacle_vel_w).dot(normal)
    ttc = FAR_M + 0.0
    if closing > episode_cfg.ttc_closing_m_s:
        ttc = ti.max(gap, 0.0) / closing
    return ti.Vector([gap, ttc])


@ti.func
def verdict(
    pos_w, axis_w, goal_w, threat, is_late,
    episode_cfg: Const[EpisodeConfig], vehicle_cfg: Const[VehicleConfig], tank_cfg: Const[TankConfig],
):  # fmt: skip
    """How an episode stands, ``threat`` (clearance [m], time to collision [s]) being the nearest; the first
    rule that holds decides."""
    to_goal = goal_w - pos_w
    out = RUNNING
    if is_in_tank(pos_w, tank_cfg) == 0:
        out = OUT_OF_TANK
    elif (
        threat[0] < episode_cfg.collision_clearance_m
        or hull_to_floor_or_surface(pos_w, axis_w, vehicle_cfg, tank_cfg) < 0.0
    ):
        out = COLLISION
    elif threat[1] < episode_cfg.ttc_s:
        out = TTC
    elif to_goal.dot(to_goal) <= episode_cfg.goal_radius_m**2:
        out = SUCCESS
    elif is_late:
        out = TIMEOUT
    return out


@ti.func
def nearest_threat(env, io: Bundle[EpisodeIO]):
    """(clearance [m] to the nearest obstacle or side wall, smallest time to collision [s] with an
    obstacle)."""
    pos_w = io.vehicle.pos_w[env]
    R_wb = rotation_wb(io.vehicle.quat_wb[env])
    axis_w = ti.Vector([R_wb[0, 0], R_wb[1, 0], R_wb[2, 0]])
    vel_w = R_wb @ io.vehicle.vel_b[env]
    rate_w = R_wb @ io.vehicle.rate_b[env]
    clearance = hull_to_side_wall(pos_w, axis_w, io.vehicle_cfg, io.tank_cfg)
    ttc = FAR_M + 0.0
    for obstacle in range(io.world.kind.shape[1]):
        kind = io.world.kind[env, obstacle]
        if kind != NONE:
            threat = threat_of(
                pos_w, axis_w, vel_w, rate_w, kind, io.world.pos_w[env, obstacle],
                io.world.size[env, obstacle], io.world.yaw[env, obstacle], io.world.vel_w[env, obstacle],
                io.episode_cfg, io.vehicle_cfg,
            )  # fmt: skip
            clearance, ttc = ti.min(clearance, threat[0]), ti.min(ttc, threat[1])
    return ti.Vector([clearance, ttc])


@ti.func
def outcome_of(env, io: Bundle[EpisodeIO]):
    """How the episode of an env stands."""
    R_wb = rotation_wb(io.vehicle.quat_wb[env])
    axis_w = ti.Vector([R_wb[0, 0], R_wb[1, 0], R_wb[2, 0]])
    threat = ti.Vector([io.termination.clearance_m[env], io.termination.ttc_s[env]])
    is_late = io.clock.step[env] >= io.episode_cfg.horizon_steps
    return verdict(
        io.vehicle.pos_w[env], axis_w, io.mission.goal_w[env], threat, is_late,
        io.episode_cfg, io.vehicle_cfg, io.tank_cfg,
    )  # fmt: skip


@quick_launch
@ti.kernel
def reset_termination(io: Bundle[EpisodeIO]):
    """Start the termination check's book of the active rows with the initial clearance."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
            threat = nearest_threat(env, io)
            io.termination.outcome[env] = RUNNING
            io.termination.clearance_m[env] = threat[0]
            io.termination.ttc_s[env] = threat[1]
            io.termination.min_clearance_m[env] = threat[0]
            io.termination.path_length_m[env] = 0.0
            io.termination.last_pos_w[env] = io.vehicle.pos_w[env]


@quick_launch
@ti.kernel
def check_termination(io: Bundle[EpisodeIO]):
    """Clearance, time to collision, way driven and outcome of the active rows after they and the obstacles
    have moved."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
            threat = nearest_threat(env, io)
            io.termination.clearance_m[env] = threat[0]
            io.termination.ttc_s[env] = threat[1]
            io.termination.min_clearance_m[env] = ti.min(io.termination.min_clearance_m[env], threat[0])
            io.termination.path_length_m[env] += (
                io.vehicle.pos_w[env] - io.termination.last_pos_w[env]
            ).norm()
            io.termination.last_pos_w[env] = io.vehicle.pos_w[env]
            io.termination.outcome[env] = outcome_of(env, io)
