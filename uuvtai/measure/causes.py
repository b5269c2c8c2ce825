"""Why an episode failed: facts and one label from the truth of its last seconds. Pure NumPy, nothing runs here.

Every failed episode gets exactly one label, the first of ``CAUSES`` whose condition holds. The order asks what a developer would ask:
was there a chance at all, did the vehicle *know* of what killed it (sensing, tracking, forecast: the first half), and if it did, what
did the pilot make of it (the second half). The killer is what the referee stopped the episode for: the body with the least time to
collision of a ``ttc`` stop, otherwise what the hull touches. "Seen" means that a beam of a delivered scan met the body; "believed" that a
forecast lies within ``BELIEF_M`` of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from uuvtai.config import Config
from uuvtai.kernels.geometry import BOX, NONE
from uuvtai.measure import hindsight
from uuvtai.scenario import KIND_NAMES

Array = np.ndarray

WINDOW_S = 4.0
"""How far back the facts look; a time "ago" that is None lies farther back or never was."""
START_S = 2.0
"""A younger episode starts in danger: track, forecast and evasion take about a second, and bodies start 1.5 m away."""
UNSEEN_S = 0.3
"""Unseen: out of the sonar's vertical fan all through this time before the end (the design's measure: no track 0.3 s before)."""
TURN_S = 1.2
"""An unannounced turn lies within this before the end (7-methods.md)."""
TURN_RAD = math.radians(30.0)
"""A corner: the body's course changes by more between two samples."""
HIDDEN_S = (1.5, 0.5)
"""Hidden: within the fan, but behind something nearer in most samples of this interval before the end."""
TRACK_S = 0.5
"""Untracked: no belief this long before the end. Half a second is what the vehicle needs to get out of a body's way."""
LEAD_S = 1.0
"""Forecasts are judged by what they said this long before the end (or TRACK_S, where there was none yet)."""
BELIEF_M = 0.5
"""A forecast or track belongs to a body when its present position is this close to the truth, in the plane."""
MISS_M = 0.35
"""A forecast missed when it was farther off than the pilot's margin at one second (0.25 m + 0.1 m/s)."""
REACH_M = 0.4
"""Squeezed: something static is nearer to the hull at the end: no room to give way (hull 0.17 m + contact 0.1 m + margin)."""
CROWD_M = 0.6
"""Crowded: a second moving body comes nearer to the hull in the last CROWD_S."""
CROWD_S = 0.5
NEAR_M = 1.0
"""Contact with something static counts as squeezed when a moving body came this near to the hull in the last NEAR_S."""
NEAR_S = 1.5
REACT_S = 1.0
"""Late: evasion began less than this before the end, or never."""
BREAK_S = 0.3
"""A leaf that lost charge for no longer than this still counts as in charge."""
BEAM_M = 0.1
"""A beam met the body when its range agrees with the truth within this plus four sigma."""

LAST_S = 10.0
"""Timeouts are judged by their last ten seconds."""
PROGRESS_M = 1.0
"""A timeout that came this much nearer to the goal in that time was only slow."""
STUCK_M = 0.5
"""A vehicle that drove less in that time did not move."""

EVADING = ("Evade", "BackOff")
"""Leaves that give way to something."""
WAITING = ("Hold",)
"""Leaves that stay in place on purpose; further ones are recognised by a name that begins with Wait, Yield or Shelter."""

CAUSES: dict[str, str] = {
    "out_of_tank": "left the tank",
    "hit_floor": "touched the floor",
    "hit_surface": "touched the surface",
    "hit_static": "touched a static obstacle with no moving body near",
    "hit_wall": "touched a side wall with no moving body near",
    "pushed_into_static": f"touched a static or wall while evading, or with a moving body within {NEAR_M:g} m",
    "start_in_danger": f"killed in the first {START_S:g} s",
    "unseen_above": f"killer above the sonar's fan all through the last {UNSEEN_S:g} s",
    "unseen_below": f"killer below the sonar's fan all through the last {UNSEEN_S:g} s",
    "unannounced_turn": f"killer turned a corner (> {math.degrees(TURN_RAD):.0f} deg) in the last {TURN_S:g} s",
    "hidden": f"killer was behind something else until {HIDDEN_S[1]:g} s before the end",
    "untracked": f"killer within the fan, but no forecast of it {TRACK_S:g} s before the end",
    "curving": f"killer on a circle, and the forecast {LEAD_S:g} s before missed by > {MISS_M:g} m",
    "forecast_missed": f"the forecast {LEAD_S:g} s before missed by > {MISS_M:g} m without a turn",
    "squeezed_by_static": f"forecast right, but a static or wall within {REACH_M:g} m left no room",
    "crowded": f"forecast right, but a second moving body came within {CROWD_M:g} m",
    "late": f"forecast right and room, but evasion began < {REACT_S:g} s before the end, or never",
    "fast_crossing": "forecast right and evading in time, but it closed in faster than the vehicle can go",
    "caught_evading": "forecast right, evading in time, killer slow: the evasion chose badly",
    "no_route": f"timeout: no route in most of the last {LAST_S:g} s",
    "too_slow": f"timeout: still came > {PROGRESS_M:g} m nearer to the goal in the last {LAST_S:g} s",
    "waiting": f"timeout: waited on purpose in most of the last {LAST_S:g} s",
    "kept_away": f"timeout: evaded in most of the last {LAST_S:g} s",
    "stuck": f"timeout: drove < {STUCK_M:g} m in the last {LAST_S:g} s",
    "circling": f"timeout: drove on without coming nearer in the last {LAST_S:g} s",
}
"""Every label with its meaning, in order of precedence."""


@dataclass(frozen=True)
class Bodies:
    """What stays the same over an episode: its bodies. Arrays have one entry per slot."""

    kind: Array
    size: Array
    yaw: Array
    speed_m_s: Array
    """nominal; 0 = at rest"""
    circle_m: Array
    """radius of the circle it drives on; 0 = a polyline or at rest"""

    @property
    def moving(self) -> Array:
        """Slots with a body that moves."""
        return (self.kind != NONE) & (self.speed_m_s > 0.01)


@dataclass(frozen=True)
class History:
    """The last seconds of an episode, oldest sample first, the end last; ``diary`` is a coarse account of all of it."""

    t_s: Array
    """(n,) since the start"""
    pos_w: Array
    quat_wb: Array
    vel_b: Array
    rate_b: Array
    body_w: Array
    """(n, nb, 3)"""
    body_vel_w: Array
    ping_age_s: Array
    """(n,) age of the newest delivered scan"""
    range_m: Array
    """(n, n_ray) that scan; no return = maximum range"""
    track_moving: Array
    """(n, n_track) 1 = confirmed, 0 = taken to be static, -1 = empty slot"""
    track_w: Array
    """(n, n_track, 2)"""
    forecast_w: Array
    """(n, n_track, n_forecast, 2)"""
    forecast_m: Array
    """(n, n_track) present radius, negative = no forecast"""
    conflict: Array
    """(n,) bool: the pilot foresees a conflict"""
    leaf: list[str]
    """type of the leaf in charge, "" = none"""
    action: Array
    """(n, 4)"""
    map_clearance_m: Array
    """(n,) what the vehicle's own map says"""
    diary: Diary


@dataclass(frozen=True)
class Diary:
    """The whole episode at a coarse rate."""

    t_s: Array
    pos_w: Array
    goal_m: Array
    """3-D distance to the goal"""
    has_route: Array
    leaf: list[str]


@dataclass
class Killer:
    """What ended the episode."""

    name: str
    """sphere, cylinder, box, wall, floor or surface; "" = nothing (timeout)"""
    slot: int | None = None
    moving: bool = False
    gap_m: float | None = None
    closing_m_s: float | None = None


@dataclass
class Explanation:
    """Label and facts of one failed episode."""

    label: str
    killer: Killer
    facts: dict[str, Any] = field(default_factory=dict)


def explain(outcome: str, history: History, bodies: Bodies, config: Config) -> Explanation:
    """Label and facts of an episode that ended with ``outcome`` (collision, ttc, out_of_tank or timeout)."""
    if outcome == "timeout":
        facts = _timeout_facts(history.diary)
        return Explanation(timeout_label(facts), Killer(""), facts)
    scene = _Scene(history, bodies, config)
    killer = scene.killer(outcome)
    facts = scene.facts(killer)
    if killer.moving and killer.slot is not None:
        facts |= _sight_facts(history, bodies, killer.slot, config) | _belief_facts(history, killer.slot, config)
        facts |= _course_facts(history, bodies, killer.slot)
    return Explanation(label_of(outcome, killer, facts, config), killer, facts)


# -------------------------------------------------------------------------------------------------------------------- labels


def label_of(outcome: str, killer: Killer, facts: dict[str, Any], config: Config) -> str:
    """The first cause that holds; its order and meaning are ``CAUSES``."""
    if outcome == "out_of_tank":
        return "out_of_tank"
    if killer.name in ("floor", "surface"):
        return f"hit_{killer.name}"
    if not killer.moving:
        pushed = facts["evading_s"] > 0 or _within(facts["moving_near_m"], NEAR_M)
        return "pushed_into_static" if pushed else "hit_wall" if killer.name == "wall" else "hit_static"
    return _knowledge_label(facts) or _pilot_label(killer, facts, config)


def _knowledge_label(facts: dict[str, Any]) -> str | None:
    """What kept the vehicle from knowing where the killer would be; None = it knew."""
    if facts["age_s"] < START_S:
        return "start_in_danger"
    if facts["fan_ago_s"] is None or facts["fan_ago_s"] >= UNSEEN_S:
        return "unseen_above" if facts["vertical_gap_m"] > 0 else "unseen_below"
    if _within(facts["turned_ago_s"], TURN_S):
        return "unannounced_turn"
    if facts["hidden_share"] > 0.5:
        return "hidden"
    if facts["forecast_error_m"] is None:
        return "untracked"
    if facts["forecast_error_m"] > MISS_M:
        return "curving" if facts["circle_m"] else "forecast_missed"
    return None


def _pilot_label(killer: Killer, facts: dict[str, Any], config: Config) -> str:
    """What the pilot made of what it knew."""
    if facts["static_near_m"] < REACH_M:
        return "squeezed_by_static"
    if _within(facts["second_body_m"], CROWD_M):
        return "crowded"
    if facts["evading_s"] < REACT_S:
        return "late"
    return "fast_crossing" if (killer.closing_m_s or 0.0) > config.teacher.evade_m_s else "caught_evading"


def timeout_label(facts: dict[str, Any]) -> str:
    """Why an episode ran out of time."""
    if facts["no_route_share"] > 0.5:
        return "no_route"
    if facts["progress_m"] > PROGRESS_M:
        return "too_slow"
    if facts["waiting_share"] > 0.5:
        return "waiting"
    if facts["evading_share"] > 0.5:
        return "kept_away"
    return "stuck" if facts["driven_m"] < STUCK_M else "circling"


def is_waiting(leaf: str) -> bool:
    """Whether a leaf of this type stays in place on purpose."""
    return leaf in WAITING or leaf.startswith(("Wait", "Yield", "Shelter"))


def _within(value: float | None, limit: float) -> bool:
    return value is not None and value <= limit


# --------------------------------------------------------------------------------------------------------------------- facts


class _Scene:
    """Distances of the hull to everything over the window."""

    def __init__(self, h: History, bodies: Bodies, config: Config) -> None:
        self.h, self.bodies, self.config = h, bodies, config
        radius, half = config.vehicle.hull_radius_m, config.vehicle.hull_half_length_m
        R_wb = hindsight.rotation(h.quat_wb)
        self.axis_w = R_wb[:, :, 0]
        self.gap, self.normal, self.along = hindsight.hull_gaps(
            h.pos_w, self.axis_w, bodies.kind, h.body_w, bodies.size, bodies.yaw, radius, half
        )
        self.wall = hindsight.wall_gaps(h.pos_w, self.axis_w, config.world.tank, radius, half)
        self.floor, self.surface = hindsight.floor_and_surface_gaps(h.pos_w, self.axis_w, config.world.tank, radius, half)
        vel_w = np.einsum("nij,nj->ni", R_wb, h.vel_b)
        swing_w = np.cross(np.einsum("nij,nj->ni", R_wb, h.rate_b), self.axis_w)
        point_vel = vel_w[:, None, :] + self.along[..., None] * swing_w[:, None, :]
        self.closing = ((point_vel - h.body_vel_w) * self.normal).sum(-1)
        self.vel_w = vel_w

    def killer(self, outcome: str) -> Killer:
        """What the referee stopped the episode for."""
        rules, gap, closing = self.config.episode, self.gap[-1], self.closing[-1]
        if outcome == "ttc":
            approaching = closing > rules.ttc_closing_m_s
            time_left = np.where(approaching, np.maximum(gap, 0.0) / np.where(approaching, closing, 1.0), np.inf)
            return self._body(int(time_left.argmin()))
        nearest = int(gap.argmin())
        solids = {"wall": self.wall[-1], "floor": self.floor[-1], "surface": self.surface[-1]}
        excess = {name: float(value) - (rules.collision_clearance_m if name == "wall" else 0.0) for name, value in solids.items()}
        name = min(excess, key=lambda key: excess[key])
        if outcome != "out_of_tank" and gap[nearest] - rules.collision_clearance_m <= excess[name]:
            return self._body(nearest)
        return Killer(name, gap_m=_round(solids[name]))

    def _body(self, slot: int) -> Killer:
        return Killer(
            name=KIND_NAMES[int(self.bodies.kind[slot])],
            slot=slot,
            moving=bool(self.bodies.moving[slot]),
            gap_m=_round(self.gap[-1, slot]),
            closing_m_s=_round(self.closing[-1, slot]),
        )

    def facts(self, killer: Killer) -> dict[str, Any]:
        """What holds for every failure that has a killer."""
        h, moving = self.h, self.bodies.moving
        others = moving & (np.arange(len(moving)) != (-1 if killer.slot is None else killer.slot))
        still = (self.bodies.kind != NONE) & ~moving
        ago = h.t_s[-1] - h.t_s
        return {
            "age_s": _round(h.t_s[-1]),
            "leaf": h.leaf[-1],
            "evading_s": _round(_lasting_s(ago, np.array([leaf in EVADING for leaf in h.leaf]))),
            "warned_s": _round(_lasting_s(ago, h.conflict)),
            "own_speed_m_s": _round(np.linalg.norm(self.vel_w[-1])),
            "action": [_round(value) for value in h.action[-1]],
            "static_near_m": _round(min(self.wall[-1], self.gap[-1][still].min(initial=np.inf))),
            "map_clearance_m": _round(h.map_clearance_m[-1]),
            "moving_near_m": _least(self.gap[ago <= NEAR_S][:, moving]),
            "second_body_m": _least(self.gap[ago <= CROWD_S][:, others]),
        }


def _sight_facts(h: History, bodies: Bodies, slot: int, config: Config) -> dict[str, Any]:
    """When the sonar could reach the killer, when it saw it, and what else it is."""
    sonar, kind, size = config.sensors.sonar, int(bodies.kind[slot]), bodies.size[slot]
    ago = h.t_s[-1] - h.t_s
    R_wb = hindsight.rotation(h.quat_wb)
    late = h.ping_age_s[:, None]
    then_w = h.pos_w - np.einsum("nij,nj->ni", R_wb, h.vel_b) * late
    body_then_w = h.body_w[:, slot] - h.body_vel_w[:, slot] * late
    yaw = np.arctan2(R_wb[:, 1, 0], R_wb[:, 0, 0]) - h.rate_b[:, 2] * h.ping_age_s
    entry = hindsight.beam_entries(then_w, yaw, kind, body_then_w, size, float(bodies.yaw[slot]), sonar)
    reached = np.isfinite(entry)
    tolerance = BEAM_M + 4 * (sonar.range_sigma_m + sonar.range_sigma_slope * np.where(reached, entry, 0.0)) + sonar.range_jitter_m
    met = reached & (np.abs(h.range_m - np.where(reached, entry, 0.0)) < tolerance)
    in_fan, seen = reached.any(1), met.any(1)
    before = (ago <= HIDDEN_S[0]) & (ago >= HIDDEN_S[1])
    return {
        "fan_ago_s": _last_ago(ago, in_fan),
        "seen_ago_s": _last_ago(ago, seen),
        "hidden_share": _round((in_fan & ~seen)[before].mean() if before.any() else 0.0),
        "vertical_gap_m": _round(hindsight.vertical_gap(h.pos_w[-1:], kind, h.body_w[-1:, slot], size)[0]),
        "killer_speed_m_s": _round(np.linalg.norm(h.body_vel_w[-1, slot])),
        "killer_radius_m": _round(size[0]),
        "full_height": bool(kind != BOX and size[2] > 0.49 * (config.world.tank.z_m[1] - config.world.tank.z_m[0])),
        "circle_m": _round(abs(bodies.circle_m[slot])) if bodies.circle_m[slot] else None,
    }


def _belief_facts(h: History, slot: int, config: Config) -> dict[str, Any]:
    """What the vehicle believed about the killer."""
    ago = h.t_s[-1] - h.t_s
    truth = h.body_w[:, slot, :2]
    away = np.where(h.forecast_m >= 0, np.linalg.norm(h.forecast_w[:, :, 0] - truth[:, None], axis=-1), np.inf)
    belief, distance = away.argmin(1), away.min(1)
    believed = distance <= BELIEF_M
    tracked = np.where(h.track_moving >= 0, np.linalg.norm(h.track_w - truth[:, None], axis=-1), np.inf)
    still = (np.where(h.track_moving == 0, tracked, np.inf) <= BELIEF_M).any(1)
    error, lead = None, None
    for back in (LEAD_S, TRACK_S):
        at = int(np.abs(ago - back).argmin())
        if believed[at]:
            lead = float(ago[at])
            error = float(np.linalg.norm(_foreseen(h.forecast_w[at, belief[at]], lead, config.tracking.forecast_dt_s) - truth[-1]))
            break
    return {
        "believed_ago_s": _last_ago(ago, believed),
        "belief_error_m": _round(distance[-1]) if believed[-1] else None,
        "forecast_lead_s": _round(lead),
        "forecast_error_m": _round(error),
        "taken_as_static_ago_s": _last_ago(ago, still & ~believed),
    }


def _foreseen(forecast_w: Array, lead_s: float, dt_s: float) -> Array:
    """Position (2,) that a forecast (n_forecast, 2) gave for ``lead_s`` after it was made."""
    steps = np.arange(len(forecast_w)) * dt_s
    return np.array([np.interp(lead_s, steps, forecast_w[:, axis]) for axis in range(2)])


def _course_facts(h: History, bodies: Bodies, slot: int) -> dict[str, Any]:
    """When the killer last turned a corner; a circle has none."""
    vel = h.body_vel_w[:, slot, :2]
    turn = np.abs(np.angle(np.exp(1j * np.diff(np.arctan2(vel[:, 1], vel[:, 0])))))
    corner = (turn > TURN_RAD) & (bodies.circle_m[slot] == 0)
    return {"turned_ago_s": _last_ago(h.t_s[-1] - h.t_s[1:], corner)}


def _timeout_facts(diary: Diary) -> dict[str, Any]:
    last = diary.t_s >= diary.t_s[-1] - LAST_S
    first = int(last.argmax())
    leaf = [name for name, counts in zip(diary.leaf, last, strict=True) if counts]
    return {
        "age_s": _round(diary.t_s[-1]),
        "leaf": diary.leaf[-1],
        "goal_m": _round(diary.goal_m[-1]),
        "progress_m": _round(diary.goal_m[first] - diary.goal_m[-1]),
        "driven_m": _round(np.linalg.norm(np.diff(diary.pos_w[first:], axis=0), axis=1).sum()),
        "no_route_share": _round(1.0 - diary.has_route[last].mean()),
        "waiting_share": _round(np.mean([is_waiting(name) for name in leaf])),
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
