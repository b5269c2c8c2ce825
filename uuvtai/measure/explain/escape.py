"""Could the vehicle still have got away? Velocities held from some time before the end on, rolled out against
the true motion of all."""

from __future__ import annotations

import numpy as np

from uuvtai.config import Config
from uuvtai.measure.explain import hindsight
from uuvtai.measure.explain.history import Array, Bodies, History

N_HEADING = 16
SPEEDS = (0.5, 1.0)
"""Shares of the fastest evasion in that direction."""
STEP_S = 0.05
_DEEP_M = 1e3
AFTER_S = 0.5
"""An escape keeps clear up to this after the end."""


def escapes(history: History, bodies: Bodies, config: Config, lead_s: float) -> tuple[int, int]:
    """How many velocities, chosen ``lead_s`` before the end and held, keep clear of everything: (at constant
    depth, with heave).

    Candidates are ``N_HEADING`` headings x ``SPEEDS`` and stopping, each at constant depth and with full
    heave up and down, within the limits of the body axes; the vehicle follows them with the pilot's lag and
    keeps its yaw. Bodies move as they did, after the end straight on. Clear means the referee's rules:
    clearance, time to collision, tank.
    """
    end = float(history.t_s[-1])
    start = int(np.abs(history.t_s - (end - lead_s)).argmin())
    t = np.arange(0.0, end - history.t_s[start] + AFTER_S + 1e-6, STEP_S)
    R_wb = hindsight.rotation(history.quat_wb[start])
    command = candidates(config, float(np.arctan2(R_wb[1, 0], R_wb[0, 0])))
    pos, vel = rolled_out(history.pos_w[start], R_wb @ history.vel_b[start], command, t, config.teacher.lag_s)
    clear = is_clear(pos, vel, R_wb[:, 0], *motion(history, history.t_s[start] + t), bodies, config)
    level = command[:, 2] == 0
    return int(clear[level].sum()), int(clear[~level].sum())


def escapes_beyond_the_edge(history: History, bodies: Bodies, config: Config, lead_s: float) -> int:
    """How many of them would keep clear with heave if the water went on beyond floor and surface."""
    tank = config.world.tank.model_copy(update={"z_m": (-_DEEP_M, _DEEP_M)})
    world = config.world.model_copy(update={"tank": tank})
    return escapes(history, bodies, config.model_copy(update={"world": world}), lead_s)[1]


def candidates(config: Config, yaw: float) -> Array:
    """(n, 3) world velocities [m/s] of a vehicle with this yaw."""
    heading = 2 * np.pi * np.arange(N_HEADING) / N_HEADING
    limits = np.abs(
        [np.cos(heading) / config.vehicle.max_surge_m_s, np.sin(heading) / config.vehicle.max_sway_m_s]
    )
    top = np.minimum(config.teacher.evade_m_s, 1.0 / limits.max(0))
    ring = np.stack([np.cos(heading + yaw), np.sin(heading + yaw)], -1) * top[:, None]
    level = np.concatenate([np.zeros((1, 2)), *(ring * share for share in SPEEDS)])
    heave = config.vehicle.max_heave_m_s
    return np.concatenate([np.column_stack([level, np.full(len(level), up)]) for up in (0.0, heave, -heave)])


def rolled_out(pos: Array, vel: Array, command: Array, t: Array, lag_s: float) -> tuple[Array, Array]:
    """(n, n_t, 3) positions and velocities of a vehicle that approaches each commanded velocity with a
    first-order lag."""
    left = np.exp(-t / lag_s)[:, None]
    off = (vel - command)[:, None]
    return pos + command[:, None] * t[:, None] + off * lag_s * (1.0 - left), command[:, None] + off * left


def motion(history: History, at_s: Array) -> tuple[Array, Array]:
    """(n_t, nb, 3) true positions and velocities of the bodies; straight on after the last sample."""
    flat = history.body_w.reshape(len(history.t_s), -1)
    inside = np.stack([np.interp(at_s, history.t_s, column) for column in flat.T], -1).reshape(
        len(at_s), -1, 3
    )
    vel = history.body_vel_w[np.clip(np.searchsorted(history.t_s, at_s), 0, len(history.t_s) - 1)]
    return inside + np.maximum(at_s - history.t_s[-1], 0.0)[:, None, None] * history.body_vel_w[-1], vel


def is_clear(
    pos: Array, vel: Array, axis_w: Array, body_w: Array, body_vel_w: Array, bodies: Bodies, config: Config
) -> Array:
    """(n,) bool: paths (n, n_t, 3) along which the referee would stop nothing."""
    rules, hull = config.episode, (config.vehicle.hull_radius_m, config.vehicle.hull_half_length_m)
    n, n_t = pos.shape[:2]
    flat, axis = pos.reshape(-1, 3), np.broadcast_to(axis_w, (n * n_t, 3))
    floor, surface = hindsight.floor_and_surface_gaps(flat, axis, config.world.tank, *hull)
    clear = (
        (hindsight.wall_gaps(flat, axis, config.world.tank, *hull) >= rules.collision_clearance_m)
        & (floor >= 0)
        & (surface >= 0)
    )
    for body in np.flatnonzero((bodies.kind > 0) & (_nearest(pos, body_w) < _reach(pos, bodies))):
        there = np.broadcast_to(body_w[:, body], pos.shape).reshape(-1, 1, 3)
        one = slice(body, body + 1)
        gap, normal, _ = hindsight.hull_gaps(
            flat, axis, bodies.kind[one], there, bodies.size[one], bodies.yaw[one], *hull
        )
        closing = ((vel - body_vel_w[:, body]).reshape(-1, 3) * normal[:, 0]).sum(-1)
        clear &= gap[:, 0] >= np.maximum(rules.collision_clearance_m, rules.ttc_s * closing)
    return np.asarray(clear.reshape(n, n_t).all(1))


def _nearest(pos: Array, body_w: Array) -> Array:
    """(nb,) least distance of each body from the mean of all paths."""
    return np.linalg.norm(body_w[..., :2] - pos.mean(0)[:, None, :2], axis=-1).min(0)


def _reach(pos: Array, bodies: Bodies) -> Array:
    """(nb,) distance from that mean beyond which a body troubles none of the paths."""
    spread = np.linalg.norm(pos[..., :2] - pos[..., :2].mean(0), axis=-1).max()
    return spread + np.linalg.norm(bodies.size[:, :2], axis=1) + 1.0
