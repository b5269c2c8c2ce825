"""What was true in the last seconds of a failed episode, as numbers with names. Pure NumPy;
``failure_causes.py`` makes labels of them.

What was touched is what the termination check stopped the episode for: the obstacle with the least time to
collision of a ``ttc`` stop, otherwise what the hull touches. "Seen" means that a beam of a delivered scan met
the obstacle, "believed" that a forecast lies within ``BELIEF_M`` of it. Facts that end in ``_ago_s`` count
back from the end; None = not within ``WINDOW_S``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from uuvtai.common.obstacle_motion import KIND_NAMES
from uuvtai.config import Config, SonarConfig, TankConfig
from uuvtai.kernels.core.geometry import BOX, CYLINDER, NONE, SPHERE

# ---- What the truth looked like, in NumPy: distances of the hull to every obstacle, what the sonar could
# reach, what its beams met. For explanations after the fact only; nothing that drives a vehicle may import
# it. Same geometry as ``kernels/core/geometry.py`` and ``kernels/sensors/raycast.py``. Arrays of one episode
# have the samples first, shape (n, ...); obstacles are on the next axis.

Array = np.ndarray

_AXIS_SAMPLES = 9  # Points along the hull's axis, 25 mm apart: the clearance is less than 1 mm too large.


def rotation(quat_wb: Array) -> Array:
    """(n, 3, 3) rotation matrices body to world of unit quaternions (n, 4) = (w, x, y, z)."""
    w, x, y, z = np.moveaxis(np.asarray(quat_wb, float), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def hull_gaps(
    pos_w: Array,
    axis_w: Array,
    kind: Array,
    obstacle_w: Array,
    size: Array,
    yaw: Array,
    radius_m: float,
    half_m: float,
):
    """(gap [m], unit vector hull to body, place on the axis [m]) of the capsule to every obstacle: (n, nb),
    (n, nb, 3), (n, nb).

    ``pos_w``, ``axis_w`` (n, 3); ``obstacle_w`` (n, nb, 3); ``kind``, ``yaw`` (nb,), ``size`` (nb, 3). Empty
    slots are infinitely far.
    """
    along = np.linspace(-half_m, half_m, _AXIS_SAMPLES)
    point = pos_w[:, None, :] + along[:, None] * axis_w[:, None, :]
    away = point[:, None, :, :] - np.asarray(obstacle_w, float)[:, :, None, :]
    c, s = (
        turn[None, :, None]
        for turn in (np.cos(np.where(kind == BOX, yaw, 0.0)), np.sin(np.where(kind == BOX, yaw, 0.0)))
    )
    q = np.stack([c * away[..., 0] + s * away[..., 1], c * away[..., 1] - s * away[..., 0], away[..., 2]], -1)
    outside = q - _core_point(q, kind[None, :, None], size[None, :, None, :])
    distance = np.linalg.norm(outside, axis=-1)
    best = distance.argmin(-1)
    gap = (
        np.take_along_axis(distance, best[..., None], -1)[..., 0]
        - radius_m
        - np.where(kind == SPHERE, size[:, 0], 0.0)
    )
    toward = -np.take_along_axis(outside, best[..., None, None], 2)[..., 0, :]
    toward = np.stack(
        [
            c[..., 0] * toward[..., 0] - s[..., 0] * toward[..., 1],
            s[..., 0] * toward[..., 0] + c[..., 0] * toward[..., 1],
            toward[..., 2],
        ],
        -1,
    )
    normal = toward / np.maximum(np.linalg.norm(toward, axis=-1, keepdims=True), 1e-9)
    return np.where(kind == NONE, np.inf, gap), normal, along[best]


def _core_point(q: Array, kind: Array, size: Array) -> Array:
    """Point of an obstacle's core nearest to q: a sphere's core is its centre, other obstacles are their
    own."""
    rho = np.hypot(q[..., 0], q[..., 1])
    scale = np.minimum(1.0, size[..., 0] / np.maximum(rho, 1e-9))
    z = np.clip(q[..., 2], -size[..., 2], size[..., 2])
    cylinder = np.stack([q[..., 0] * scale, q[..., 1] * scale, z], -1)
    box = np.clip(q, -size, size)
    return np.where((kind == BOX)[..., None], box, np.where((kind == CYLINDER)[..., None], cylinder, 0.0))


def wall_gaps(pos_w: Array, axis_w: Array, tank_cfg: TankConfig, radius_m: float, half_m: float) -> Array:
    """(n,) clearance of the hull to the nearest side wall [m]."""
    ends = np.stack([pos_w + half_m * axis_w, pos_w - half_m * axis_w])
    if tank_cfg.shape == "circle":
        middle = [0.5 * sum(tank_cfg.x_m), 0.5 * sum(tank_cfg.y_m)]
        return tank_cfg.radius_m - np.linalg.norm(ends[..., :2] - middle, axis=-1).max(0) - radius_m
    low, high = np.array([tank_cfg.x_m, tank_cfg.y_m]).T
    return np.minimum(ends[..., :2] - low, high - ends[..., :2]).min((0, -1)) - radius_m


def floor_and_surface_gaps(
    pos_w: Array, axis_w: Array, tank_cfg: TankConfig, radius_m: float, half_m: float
) -> tuple[Array, Array]:
    """(n,) clearance of the hull to the floor and to the surface [m]."""
    low, high = tank_cfg.z_m
    reach = np.abs(axis_w[:, 2]) * half_m + radius_m
    return pos_w[:, 2] - low - reach, high - pos_w[:, 2] - reach


def vertical_gap(pos_w: Array, kind: int, obstacle_w: Array, size: Array) -> Array:
    """(n,) signed gap [m] from the sonar's plane to an obstacle: positive = it is above, 0 = it crosses."""
    rise = obstacle_w[:, 2] - pos_w[:, 2]
    half = size[0] if kind == SPHERE else size[2]
    return np.where(np.abs(rise) > half, rise - np.sign(rise) * half, 0.0)


def beam_entries(
    pos_w: Array,
    yaw: Array,
    kind: int,
    obstacle_w: Array,
    size: Array,
    obstacle_yaw: float,
    sonar_cfg: SonarConfig,
) -> Array:
    """(n, n_ray) range at which each beam enters an obstacle's outline within the vertical fan; inf =
    none."""
    slope = math.tan(math.radians(sonar_cfg.vertical_half_aperture_deg))
    beams = np.arange(sonar_cfg.n_ray)
    bearing = yaw[:, None] + sonar_cfg.first_beam_rad + sonar_cfg.beam_step_rad * beams
    ux, uy = np.cos(bearing), np.sin(bearing)
    start = pos_w - obstacle_w
    sx, sy, rise = start[:, 0:1], start[:, 1:2], np.abs(start[:, 2:3])
    if kind == BOX:
        c, s = math.cos(obstacle_yaw), math.sin(obstacle_yaw)
        enter = _box_entry(sx * c + sy * s, sy * c - sx * s, ux * c + uy * s, uy * c - ux * s, size)
    else:
        lost = np.maximum(rise - np.hypot(sx, sy) * slope, 0.0) if kind == SPHERE else 0.0
        room = size[0] ** 2 - lost**2 - (sx * uy - sy * ux) ** 2
        enter = np.where(room >= 0, -(sx * ux + sy * uy) - np.sqrt(np.maximum(room, 0.0)), np.inf)
    gap = 0.0 if kind == SPHERE else np.maximum(rise - size[2], 0.0)
    return np.where((enter > 0) & (enter * slope >= gap) & (enter <= sonar_cfg.max_range_m), enter, np.inf)


def _box_entry(x: Array, y: Array, dx: Array, dy: Array, size: Array) -> Array:
    into, out = -np.inf, np.inf
    for start, direction, half in ((x, dx, size[0]), (y, dy, size[1])):
        inverse = 1.0 / np.where(np.abs(direction) < 1e-9, 1e-9, direction)
        one, other = (-half - start) * inverse, (half - start) * inverse
        into, out = np.maximum(into, np.minimum(one, other)), np.minimum(out, np.maximum(one, other))
    return np.where(into <= out, into, np.inf)


# ---- What is kept of a failed episode: its obstacles, its last seconds sample by sample, all of it coarsely.


@dataclass(frozen=True)
class Obstacles:
    """What stays the same over an episode: its obstacles. Arrays have one entry per slot."""

    kind: Array
    size: Array
    yaw: Array
    speed_m_s: Array  # nominal; 0 = at rest
    circle_m: Array  # radius of the circle it drives on; 0 = a polyline or at rest
    lap_s: Array  # time once around its closed path; inf = at rest

    @property
    def moving(self) -> Array:
        return (self.kind != NONE) & (self.speed_m_s > 0.01)


@dataclass(frozen=True)
class CoarseHistory:
    """The whole episode at a coarse rate."""

    t_s: Array
    pos_w: Array
    goal_m: Array  # 3-D distance to the goal
    has_route: Array
    leaf: list[str]


@dataclass(frozen=True)
class History:
    """The last seconds of an episode, oldest sample first; ``coarse`` is the account of all of it."""

    t_s: Array  # (n,) since the start
    pos_w: Array
    believed_pos_w: Array  # (n, 3) own position as the vehicle estimates it
    vel_valid: Array  # (n,) whether it knows its velocity: 1, 2 = heave alone, 0 = not
    quat_wb: Array
    vel_b: Array
    rate_b: Array
    obstacle_w: Array  # (n, nb, 3)
    obstacle_vel_w: Array
    ping_age_s: Array  # (n,) age of the newest delivered scan
    range_m: Array  # (n, n_ray) that scan; no return = maximum range
    track_moving: Array  # (n, n_track) 1 = confirmed, 0 = taken to be static, -1 = empty slot
    track_w: Array  # (n, n_track, 2)
    forecast_w: Array  # (n, n_track, n_forecast, 2)
    forecast_m: Array  # (n, n_track) present radius, negative = no forecast
    forecast_above_w: Array
    """(n, n_track) z of the lowest edge it may have above the vehicle; the own z where it may be level"""
    forecast_below_w: Array  # (n, n_track) z of the highest edge of what it may hold below
    conflict: Array  # (n,) bool: the agent foresees a conflict
    leaf: list[str]  # type of the leaf in charge, "" = none
    action: Array  # (n, 4)
    map_clearance_m: Array  # (n,) what the vehicle's own map says
    coarse: CoarseHistory


# ---- Could the vehicle still have got away? Velocities held before the end, against the true motion of all.

N_HEADING = 16
SPEEDS = (0.5, 1.0)  # Shares of the fastest evasion in that direction.
STEP_S = 0.05
_DEEP_M = 1e3
AFTER_S = 0.5  # An escape keeps clear up to this after the end.


def escapes(history: History, obstacles: Obstacles, config: Config, lead_s: float) -> tuple[int, int]:
    """How many velocities, chosen ``lead_s`` before the end and held, keep clear of everything: (at constant
    depth, with heave).

    Candidates are ``N_HEADING`` headings x ``SPEEDS`` and stopping, each at constant depth and with full
    heave up and down, within the limits of the body axes; the vehicle follows them with the agent's lag and
    keeps its yaw. Obstacles move as they did, after the end straight on. Clear means the termination check's
    rules: clearance, time to collision, tank.
    """
    end = float(history.t_s[-1])
    start = int(np.abs(history.t_s - (end - lead_s)).argmin())
    t = np.arange(0.0, end - history.t_s[start] + AFTER_S + 1e-6, STEP_S)
    R_wb = rotation(history.quat_wb[start])
    command = candidates(config, float(np.arctan2(R_wb[1, 0], R_wb[0, 0])))
    pos, vel = rolled_out(
        history.pos_w[start], R_wb @ history.vel_b[start], command, t, config.behavior.lag_s
    )
    clear = is_clear(pos, vel, R_wb[:, 0], *motion(history, history.t_s[start] + t), obstacles, config)
    level = command[:, 2] == 0
    return int(clear[level].sum()), int(clear[~level].sum())


def escapes_beyond_the_edge(history: History, obstacles: Obstacles, config: Config, lead_s: float) -> int:
    """How many of them would keep clear with heave if the water went on beyond floor and surface."""
    tank = config.world.tank.model_copy(update={"z_m": (-_DEEP_M, _DEEP_M)})
    world = config.world.model_copy(update={"tank": tank})
    return escapes(history, obstacles, config.model_copy(update={"world": world}), lead_s)[1]


def candidates(config: Config, yaw: float) -> Array:
    """(n, 3) world velocities [m/s] of a vehicle with this yaw."""
    heading = 2 * np.pi * np.arange(N_HEADING) / N_HEADING
    limits = np.abs(
        [np.cos(heading) / config.vehicle.max_surge_m_s, np.sin(heading) / config.vehicle.max_sway_m_s]
    )
    top = np.minimum(config.behavior.evade_m_s, 1.0 / limits.max(0))
    ring = np.stack([np.cos(heading + yaw), np.sin(heading + yaw)], -1) * top[:, None]
    level = np.concatenate([np.zeros((1, 2)), *(ring * share for share in SPEEDS)])
    heave = config.vehicle.max_heave_m_s
    return np.concatenate([np.column_stack([level, np.full(len(level), up)]) for up in (0.0, heave, -heave)])


def rolled_out(pos: Array, vel: Array, command: Array, t: Array, lag_s: float) -> tuple[Array, Array]:
    """(n, n_t, 3) positions and velocities of a vehicle that takes commanded ones with first-order lag."""
    left = np.exp(-t / lag_s)[:, None]
    off = (vel - command)[:, None]
    return pos + command[:, None] * t[:, None] + off * lag_s * (1.0 - left), command[:, None] + off * left


def motion(history: History, at_s: Array) -> tuple[Array, Array]:
    """(n_t, nb, 3) true positions and velocities of the obstacles; straight on after the last sample."""
    flat = history.obstacle_w.reshape(len(history.t_s), -1)
    inside = np.stack([np.interp(at_s, history.t_s, column) for column in flat.T], -1).reshape(
        len(at_s), -1, 3
    )
    vel = history.obstacle_vel_w[np.clip(np.searchsorted(history.t_s, at_s), 0, len(history.t_s) - 1)]
    return inside + np.maximum(at_s - history.t_s[-1], 0.0)[:, None, None] * history.obstacle_vel_w[-1], vel


def is_clear(
    pos: Array,
    vel: Array,
    axis_w: Array,
    obstacle_w: Array,
    obstacle_vel_w: Array,
    obstacles: Obstacles,
    config: Config,
) -> Array:
    """(n,) bool: paths (n, n_t, 3) along which the termination check would stop nothing."""
    rules, hull = config.episode, (config.vehicle.hull_radius_m, config.vehicle.hull_half_length_m)
    n, n_t = pos.shape[:2]
    flat, axis = pos.reshape(-1, 3), np.broadcast_to(axis_w, (n * n_t, 3))
    floor, surface = floor_and_surface_gaps(flat, axis, config.world.tank, *hull)
    clear = (
        (wall_gaps(flat, axis, config.world.tank, *hull) >= rules.collision_clearance_m)
        & (floor >= 0)
        & (surface >= 0)
    )
    for obstacle in np.flatnonzero(
        (obstacles.kind > 0) & (_nearest(pos, obstacle_w) < _reach(pos, obstacles))
    ):
        there = np.broadcast_to(obstacle_w[:, obstacle], pos.shape).reshape(-1, 1, 3)
        one = slice(obstacle, obstacle + 1)
        gap, normal, _ = hull_gaps(
            flat, axis, obstacles.kind[one], there, obstacles.size[one], obstacles.yaw[one], *hull
        )
        closing = ((vel - obstacle_vel_w[:, obstacle]).reshape(-1, 3) * normal[:, 0]).sum(-1)
        clear &= gap[:, 0] >= np.maximum(rules.collision_clearance_m, rules.ttc_s * closing)
    return np.asarray(clear.reshape(n, n_t).all(1))


def _nearest(pos: Array, obstacle_w: Array) -> Array:
    """(nb,) least distance of each obstacle from the mean of all paths."""
    return np.linalg.norm(obstacle_w[..., :2] - pos.mean(0)[:, None, :2], axis=-1).min(0)


def _reach(pos: Array, obstacles: Obstacles) -> Array:
    """(nb,) distance from that mean beyond which an obstacle troubles none of the paths."""
    spread = np.linalg.norm(pos[..., :2] - pos[..., :2].mean(0), axis=-1).max()
    return spread + np.linalg.norm(obstacles.size[:, :2], axis=1) + 1.0


WINDOW_S = 4.0  # How far back the facts look; a time "ago" that is None lies farther back or never was.
LEAD_S = 1.0  # Forecasts are judged by what they said this long before the end: to react, and to get away.
SIGHT_S = (1.5, 0.5)
"""Without a forecast LEAD_S before the end, why in this interval: out of the fan, hidden, not tracked."""
TURN_RAD = math.radians(30.0)  # A corner: the obstacle's course changes by more between two samples.
BACK_RAD = math.radians(120.0)  # A turn back: a corner with more than this.
BEFORE_TURN_S = 0.1  # The forecast that a turn is judged by was made this long before it.
BELIEF_M = (
    0.5  # a forecast or track belongs to an obstacle when its place is this close to the truth, in plan
)
CLIMB_S = 1.0  # Changes of the own depth are counted over this time before the end.
BEAM_M = 0.1  # A beam met the obstacle when its range agrees with the truth within this plus four sigma.
CROWD_S = 0.5  # A second moving obstacle counts when it came near in this time before the end.
NEAR_S = 1.5  # Any moving obstacle counts as near when it was so in this time before the end.
CHANCES_S = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0)
"""The last chance: the latest of these times before the end from which some velocity escaped."""
BLIND_S = 1.0
"""The own velocity is lost when mostly unknown this time before the end (heave, for floor and surface)."""
BREAK_S = 0.3  # A leaf that lost charge for no longer than this still counts as in charge.
LAST_S = 10.0  # Timeouts are judged by their last ten seconds.
EVADING = ("Evade", "BackOff")  # Leaves that give way to something.
WAITING, _WAIT = ("Hold",), ("Wait", "Yield", "Shelter")
"""leaves that stay in place on purpose, and how names of others begin that do"""


@dataclass
class Touched:
    name: str  # sphere, cylinder, box, wall, floor or surface; "" = nothing (timeout)
    slot: int | None = None
    moving: bool = False
    gap_m: float | None = None
    closing_m_s: float | None = None


class Scene:
    """Distances of the hull to everything over the window."""

    def __init__(self, history: History, obstacles: Obstacles, config: Config) -> None:
        self.h, self.obstacles, self.config = history, obstacles, config
        radius, half = config.vehicle.hull_radius_m, config.vehicle.hull_half_length_m
        R_wb = rotation(history.quat_wb)
        self.axis_w = R_wb[:, :, 0]
        self.gap, self.normal, self.along = hull_gaps(
            history.pos_w,
            self.axis_w,
            obstacles.kind,
            history.obstacle_w,
            obstacles.size,
            obstacles.yaw,
            radius,
            half,
        )
        self.wall = wall_gaps(history.pos_w, self.axis_w, config.world.tank, radius, half)
        self.floor, self.surface = floor_and_surface_gaps(
            history.pos_w, self.axis_w, config.world.tank, radius, half
        )
        vel_w = np.einsum("nij,nj->ni", R_wb, history.vel_b)
        swing_w = np.cross(np.einsum("nij,nj->ni", R_wb, history.rate_b), self.axis_w)
        point_vel = vel_w[:, None, :] + self.along[..., None] * swing_w[:, None, :]
        self.closing = ((point_vel - history.obstacle_vel_w) * self.normal).sum(-1)
        self.vel_w = vel_w

    def touched(self, outcome: str) -> Touched:
        rules, gap, closing = self.config.episode, self.gap[-1], self.closing[-1]
        if outcome == "ttc":
            approaching = closing > rules.ttc_closing_m_s
            time_left = np.where(
                approaching, np.maximum(gap, 0.0) / np.where(approaching, closing, 1.0), np.inf
            )
            return self._body(int(time_left.argmin()))
        nearest = int(gap.argmin())
        solids = {"wall": self.wall[-1], "floor": self.floor[-1], "surface": self.surface[-1]}
        excess = {
            name: float(value) - (rules.collision_clearance_m if name == "wall" else 0.0)
            for name, value in solids.items()
        }
        name = min(excess, key=lambda key: excess[key])
        if outcome != "out_of_tank" and gap[nearest] - rules.collision_clearance_m <= excess[name]:
            return self._body(nearest)
        return Touched(name, gap_m=_round(solids[name]))

    def _body(self, slot: int) -> Touched:
        return Touched(
            name=KIND_NAMES[int(self.obstacles.kind[slot])],
            slot=slot,
            moving=bool(self.obstacles.moving[slot]),
            gap_m=_round(self.gap[-1, slot]),
            closing_m_s=_round(self.closing[-1, slot]),
        )

    def facts(self, touched: Touched) -> dict[str, Any]:
        """What holds for every failure that has one."""
        h, moving = self.h, self.obstacles.moving
        others = moving & (np.arange(len(moving)) != (-1 if touched.slot is None else touched.slot))
        still = (self.obstacles.kind != NONE) & ~moving
        ago = h.t_s[-1] - h.t_s
        off = h.believed_pos_w[-1] - h.pos_w[-1]
        blind = h.vel_valid == 0 if touched.name in ("floor", "surface") else h.vel_valid != 1
        return {
            "place_error_m": _round(np.hypot(off[0], off[1])),
            "depth_error_m": _round(off[2]),
            "blind_share": _round(blind[ago <= BLIND_S].mean()),
            "climbed_m": _round(h.pos_w[-1, 2] - h.pos_w[int(np.abs(ago - CLIMB_S).argmin()), 2]),
            "age_s": _round(h.t_s[-1]),
            "leaf": h.leaf[-1],
            "leaf_s": _round(_lasting_s(ago, np.array([leaf == h.leaf[-1] for leaf in h.leaf]))),
            "evading_s": _round(_lasting_s(ago, np.array([leaf in EVADING for leaf in h.leaf]))),
            "warned_s": _round(_lasting_s(ago, h.conflict)),
            "own_speed_m_s": _round(np.linalg.norm(self.vel_w[-1])),
            "action": [_round(value) for value in h.action[-1]],
            "static_near_m": _round(min(self.wall[-1], self.gap[-1][still].min(initial=np.inf))),
            "map_clearance_m": _round(h.map_clearance_m[-1]),
            "moving_near_m": _least(self.gap[ago <= NEAR_S][:, moving]),
            "second_body_m": _least(self.gap[ago <= CROWD_S][:, others]),
        }


def _sight_facts(history: History, obstacles: Obstacles, slot: int, config: Config) -> dict[str, Any]:
    """When the sonar could reach what was touched, when it saw it, and what else it is."""
    sonar, kind, size = config.sensors.sonar, int(obstacles.kind[slot]), obstacles.size[slot]
    ago = history.t_s[-1] - history.t_s
    R_wb = rotation(history.quat_wb)
    late = history.ping_age_s[:, None]
    then_w = history.pos_w - np.einsum("nij,nj->ni", R_wb, history.vel_b) * late
    obstacle_then_w = history.obstacle_w[:, slot] - history.obstacle_vel_w[:, slot] * late
    yaw = np.arctan2(R_wb[:, 1, 0], R_wb[:, 0, 0]) - history.rate_b[:, 2] * history.ping_age_s
    entry = beam_entries(then_w, yaw, kind, obstacle_then_w, size, float(obstacles.yaw[slot]), sonar)
    reached = np.isfinite(entry)
    tolerance = (
        BEAM_M
        + 4 * (sonar.range_sigma_m + sonar.range_sigma_slope * np.where(reached, entry, 0.0))
        + sonar.range_jitter_m
    )
    met = reached & (np.abs(history.range_m - np.where(reached, entry, 0.0)) < tolerance)
    off_w = obstacle_then_w[:, :2] - then_w[:, :2]
    off = np.angle(np.exp(1j * (np.arctan2(off_w[:, 1], off_w[:, 0]) - yaw)))
    in_width = np.degrees(np.abs(off)) <= 0.5 * sonar.horizontal_aperture_deg
    in_fan, seen = np.asarray(reached.any(1)), np.asarray(met.any(1))
    before = (ago <= SIGHT_S[0]) & (ago >= SIGHT_S[1])
    return {
        "fan_ago_s": _last_ago(ago, in_fan),
        "width_ago_s": _last_ago(ago, in_width),
        "seen_ago_s": _last_ago(ago, seen),
        "fan_share": _round(in_fan[before].mean()) if before.any() else 0.0,
        "seen_share": _round(seen[before].sum() / max(1, in_fan[before].sum())),
        "vertical_gap_m": _round(
            vertical_gap(history.pos_w[-1:], kind, history.obstacle_w[-1:, slot], size)[0]
        ),
        "touched_speed_m_s": _round(np.linalg.norm(history.obstacle_vel_w[-1, slot])),
        "touched_radius_m": _round(size[0]),
        "full_height": bool(
            kind != BOX and size[2] > 0.49 * (config.world.tank.z_m[1] - config.world.tank.z_m[0])
        ),
        "circle_m": _round(abs(obstacles.circle_m[slot])) if obstacles.circle_m[slot] else None,
    }


def _belief_facts(history: History, slot: int, turned_ago_s: float | None, config: Config) -> dict[str, Any]:
    ago = history.t_s[-1] - history.t_s
    truth = history.obstacle_w[:, slot, :2]
    away = np.where(
        history.forecast_m >= 0, np.linalg.norm(history.forecast_w[:, :, 0] - truth[:, None], axis=-1), np.inf
    )
    belief, distance = away.argmin(1), away.min(1)
    believed = distance <= BELIEF_M
    tracked = np.linalg.norm(history.track_w - truth[:, None], axis=-1)
    at_rest = (np.where(history.track_moving == 0, tracked, np.inf) <= BELIEF_M).any(1)

    def error_of(back_s: float) -> float | None:
        """Error at the end of the forecast made ``back_s`` before it."""
        at = int(np.abs(ago - back_s).argmin())
        if not believed[at]:
            return None
        foreseen = _foreseen(
            history.forecast_w[at, belief[at]], float(ago[at]), config.tracking.forecast_dt_s
        )
        return _round(np.linalg.norm(foreseen - truth[-1]))

    return {
        "believed_ago_s": _last_ago(ago, believed),
        "belief_error_m": _round(distance[-1]) if believed[-1] else None,
        "believed_gap_m": _believed_gap(history, slot, int(belief[-1])) if believed[-1] else None,
        "forecast_error_m": error_of(LEAD_S),
        "turn_error_m": None if turned_ago_s is None else error_of(turned_ago_s + BEFORE_TURN_S),
        "taken_as_static_ago_s": _last_ago(ago, at_rest & ~believed),
    }


def _believed_gap(history: History, slot: int, track: int) -> float:
    """Vertical gap [m], as the vehicle believed at the end, to what was touched; 0 = may be level."""
    own, above = history.pos_w[-1, 2], history.obstacle_w[-1, slot, 2] > history.pos_w[-1, 2]
    low, high = history.forecast_below_w[-1, track], history.forecast_above_w[-1, track]
    return _round(max(0.0, high - own if above else own - low))


def _foreseen(forecast_w: Array, lead_s: float, dt_s: float) -> Array:
    """Position (2,) that a forecast (n_forecast, 2) gave for ``lead_s`` later (at most its horizon)."""
    steps = np.arange(len(forecast_w)) * dt_s
    return np.array([np.interp(lead_s, steps, forecast_w[:, axis]) for axis in range(2)])


def _course_facts(history: History, obstacles: Obstacles, slot: int, config: Config) -> dict[str, Any]:
    """When what was touched last turned a corner (circles have none), and how often there before in reach."""
    vel = history.obstacle_vel_w[:, slot, :2]
    turn = np.abs(np.angle(np.exp(1j * np.diff(np.arctan2(vel[:, 1], vel[:, 0])))))
    corner = (turn > TURN_RAD) & (obstacles.circle_m[slot] == 0)
    ago = _last_ago(history.t_s[-1] - history.t_s[1:], corner)
    if ago is None:
        return dict.fromkeys(("turned_ago_s", "turned_deg", "turns_in_reach_before"))
    return {
        "turned_ago_s": ago,
        "turned_deg": _round(np.degrees(turn[corner][-1])),
        "turns_in_reach_before": _turns_in_reach(history, obstacles, slot, ago, config),
    }


def _turns_in_reach(history: History, obstacles: Obstacles, slot: int, ago_s: float, config: Config) -> int:
    """Earlier passes, in the sonar's fan, of the corner turned ``ago_s`` before the end: was it to learn?"""
    turned_s = float(history.t_s[-1]) - ago_s
    place = history.obstacle_w[int(np.abs(history.t_s - turned_s).argmin()), slot]
    passes = np.arange(turned_s - obstacles.lap_s[slot], 0.0, -obstacles.lap_s[slot])
    here = np.stack(
        [np.interp(passes, history.coarse.t_s, history.coarse.pos_w[:, axis]) for axis in range(3)], -1
    )
    there = np.broadcast_to(place, here.shape)
    gap = np.abs(vertical_gap(here, int(obstacles.kind[slot]), there, obstacles.size[slot]))
    away = np.linalg.norm(here[:, :2] - place[:2], axis=1)
    sonar = config.sensors.sonar
    slope = math.tan(math.radians(sonar.vertical_half_aperture_deg))
    return int(((away <= sonar.max_range_m) & (gap <= away * slope)).sum())


def touched_facts(history: History, obstacles: Obstacles, slot: int, config: Config) -> dict[str, Any]:
    """What holds where a moving obstacle in this slot was touched."""
    course = _course_facts(history, obstacles, slot, config)
    beliefs = _belief_facts(history, slot, course["turned_ago_s"], config)
    sight = _sight_facts(history, obstacles, slot, config)
    return sight | course | beliefs | _escape_facts(history, obstacles, config)


def _escape_facts(history: History, obstacles: Obstacles, config: Config) -> dict[str, Any]:
    """Velocities that would have escaped from LEAD_S before the end, and when the last one was gone."""
    level, heaving = escapes(history, obstacles, config, LEAD_S)
    chances = (back for back in CHANCES_S if any(escapes(history, obstacles, config, back)))
    beyond = 0 if level or heaving else escapes_beyond_the_edge(history, obstacles, config, LEAD_S)
    return {
        "escapes": level,
        "escapes_by_heave": heaving,
        "escapes_beyond_edge": beyond,
        "last_chance_s": next(chances, None),
    }


def timeout_facts(coarse: CoarseHistory) -> dict[str, Any]:
    last = coarse.t_s >= coarse.t_s[-1] - LAST_S
    first = int(last.argmax())
    leaf = [name for name, counts in zip(coarse.leaf, last, strict=True) if counts]
    return {
        "age_s": _round(coarse.t_s[-1]),
        "leaf": coarse.leaf[-1],
        "goal_m": _round(coarse.goal_m[-1]),
        "progress_m": _round(coarse.goal_m[first] - coarse.goal_m[-1]),
        "driven_m": _round(np.linalg.norm(np.diff(coarse.pos_w[first:], axis=0), axis=1).sum()),
        "no_route_share": _round(1.0 - coarse.has_route[last].mean()),
        "waiting_share": _round(np.mean([name in WAITING or name.startswith(_WAIT) for name in leaf])),
        "evading_share": _round(np.mean([name in EVADING for name in leaf])),
    }


def _last_ago(ago: Array, holds: Array) -> float | None:
    """Time since ``holds`` was last true; None = not within the window."""
    return _round(ago[holds].min()) if holds.any() else None


def _lasting_s(ago: Array, holds: Array) -> float:
    """How long ``holds`` has been true up to the end, breaks up to ``BREAK_S`` forgiven; 0 = not lately."""
    begun, reached = 0.0, 0.0
    for since in ago[holds][::-1]:
        if since - reached > BREAK_S + 1e-6:
            break
        begun = reached = float(since)
    return begun


def _least(values: Array) -> float | None:
    return _round(values.min()) if values.size else None


def _round(value: Any) -> Any:
    return None if value is None or not np.isfinite(value) else round(float(value), 3)
