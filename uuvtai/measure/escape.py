"""Could the vehicle still have got away? Velocities held from some time before the end on, rolled out against the true motion of all."""

from __future__ import annotations

import numpy as np

from uuvtai.config import Config
from uuvtai.measure import hindsight
from uuvtai.measure.history import Array, Bodies, History

N_HEADING = 24
SPEEDS = (0.5, 1.0)
"""Shares of the pilot's fastest evasion."""
STEP_S = 0.1


def escapes(h: History, bodies: Bodies, config: Config, lead_s: float, after_s: float) -> dict[str, int]:
    """How many velocities, chosen ``lead_s`` before the end and held, keep clear of everything up to ``after_s`` after it.

    Candidates are ``N_HEADING`` headings x ``SPEEDS`` and stopping, at constant depth (``escapes``) or with full heave up or down
    (``escapes_by_heave``); the vehicle follows them with the pilot's lag. Bodies move as they did, after the end straight on. Clear means
    the referee's rules: clearance, time to collision, tank.
    """
    end = float(h.t_s[-1])
    start = int(np.abs(h.t_s - (end - lead_s)).argmin())
    t = np.arange(0.0, end - h.t_s[start] + after_s + 1e-6, STEP_S)
    command = candidates(config)
    R_wb = hindsight.rotation(h.quat_wb[start])
    pos = rolled_out(h.pos_w[start], R_wb @ h.vel_b[start], command, t, config.teacher.lag_s)
    clear = is_clear(pos, R_wb[:, 0], body_positions(h, h.t_s[start] + t), bodies, config)
    level = command[:, 2] == 0
    return {"escapes": int(clear[level].sum()), "escapes_by_heave": int(clear[~level].sum())}


def candidates(config: Config) -> Array:
    """(n, 3) world velocities [m/s]."""
    heading = 2 * np.pi * np.arange(N_HEADING) / N_HEADING
    ring = np.stack([np.cos(heading), np.sin(heading)], -1) * config.teacher.evade_m_s
    level = np.concatenate([np.zeros((1, 2)), *(ring * share for share in SPEEDS)])
    heave = config.vehicle.max_heave_m_s
    return np.concatenate([np.column_stack([level, np.full(len(level), up)]) for up in (0.0, heave, -heave)])


def rolled_out(pos: Array, vel: Array, command: Array, t: Array, lag_s: float) -> Array:
    """(n, n_t, 3) positions of a vehicle that approaches each commanded velocity with a first-order lag."""
    coasted = lag_s * (1.0 - np.exp(-t / lag_s))[:, None]
    return pos + command[:, None] * t[:, None] + (vel - command)[:, None] * coasted


def body_positions(h: History, at_s: Array) -> Array:
    """(n_t, nb, 3) true positions; straight on after the last sample."""
    flat = h.body_w.reshape(len(h.t_s), -1)
    inside = np.stack([np.interp(at_s, h.t_s, column) for column in flat.T], -1).reshape(len(at_s), -1, 3)
    return inside + np.maximum(at_s - h.t_s[-1], 0.0)[:, None, None] * h.body_vel_w[-1]


def is_clear(pos: Array, axis_w: Array, body_w: Array, bodies: Bodies, config: Config) -> Array:
    """(n,) bool: paths (n, n_t, 3) along which the referee would stop nothing; bodies out of everybody's reach are left out."""
    rules, hull = config.episode, (config.vehicle.hull_radius_m, config.vehicle.hull_half_length_m)
    n, n_t = pos.shape[:2]
    near = np.linalg.norm(body_w[..., :2] - pos[:, :, None, :2].mean(0), axis=-1).min(0) < _reach(pos, bodies)
    near &= bodies.kind > 0
    flat, axis = pos.reshape(-1, 3), np.broadcast_to(axis_w, (n * n_t, 3))
    clear = np.ones((n, n_t), bool)
    if near.any():
        others = np.broadcast_to(body_w[None, :, near], (n, n_t, int(near.sum()), 3)).reshape(n * n_t, -1, 3)
        gap, _, _ = hindsight.hull_gaps(flat, axis, bodies.kind[near], others, bodies.size[near], bodies.yaw[near], *hull)
        gap = gap.reshape(n, n_t, -1)
        closing = np.maximum(-np.diff(gap, axis=1, append=gap[:, -1:]), 0.0) / STEP_S
        clear &= (gap >= np.maximum(rules.collision_clearance_m, rules.ttc_s * closing)).all(-1)
    floor, surface = hindsight.floor_and_surface_gaps(flat, axis, config.world.tank, *hull)
    wall = hindsight.wall_gaps(flat, axis, config.world.tank, *hull)
    tank = (wall >= rules.collision_clearance_m) & (floor >= 0) & (surface >= 0)
    return np.asarray((clear & tank.reshape(n, n_t)).all(1))


def _reach(pos: Array, bodies: Bodies) -> Array:
    """(nb,) distance from the mean of all paths beyond which a body touches none of them."""
    spread = np.linalg.norm(pos[..., :2] - pos[..., :2].mean(0), axis=-1).max()
    return spread + np.linalg.norm(bodies.size[:, :2], axis=1) + 1.0
