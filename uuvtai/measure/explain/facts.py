"""What was true in the last seconds of a failed episode, as numbers with names. Pure NumPy; ``causes.py``
makes labels of them.

The killer is what the referee stopped the episode for: the body with the least time to collision of a ``ttc``
stop, otherwise what the hull touches. "Seen" means that a beam of a delivered scan met the body, "believed"
that a forecast lies within ``BELIEF_M`` of it. Facts that end in ``_ago_s`` count back from the end; None =
not within ``WINDOW_S``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from uuvtai.closed_form import KIND_NAMES
from uuvtai.config import Config
from uuvtai.kernels.core.geometry import BOX, NONE
from uuvtai.measure.explain import hindsight
from uuvtai.measure.explain.escape import escapes, escapes_beyond_the_edge
from uuvtai.measure.explain.history import Array, Bodies, CoarseHistory, History

WINDOW_S = 4.0
"""How far back the facts look; a time "ago" that is None lies farther back or never was."""
LEAD_S = 1.0
"""Forecasts are judged by what they said this long before the end: half a second to react, half a second to
get out of the way."""
SIGHT_S = (1.5, 0.5)
"""Without a forecast LEAD_S before the end, this interval tells why: mostly out of the fan, mostly hidden, or
seen but not tracked."""
TURN_RAD = math.radians(30.0)
"""A corner: the body's course changes by more between two samples."""
BACK_RAD = math.radians(120.0)
"""A turn back: a corner with more than this."""
BEFORE_TURN_S = 0.1
"""The forecast that a turn is judged by was made this long before it."""
BELIEF_M = 0.5
"""A forecast or track belongs to a body when its present position is this close to the truth, in the
plane."""
CLIMB_S = 1.0
"""Changes of the own depth are counted over this time before the end."""
BEAM_M = 0.1
"""A beam met the body when its range agrees with the truth within this plus four sigma."""
CROWD_S = 0.5
"""A second moving body counts when it came near in this time before the end."""
NEAR_S = 1.5
"""Any moving body counts as near when it was so in this time before the end."""
CHANCES_S = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0)
"""The last chance is the latest of these times before the end from which some velocity still escaped
(``escape.py``)."""
BLIND_S = 1.0
"""The own velocity is lost when it was unknown in most of this time before the end; for floor and surface
heave is enough."""
BREAK_S = 0.3
"""A leaf that lost charge for no longer than this still counts as in charge."""
LAST_S = 10.0
"""Timeouts are judged by their last ten seconds."""
EVADING = ("Evade", "BackOff")
"""Leaves that give way to something."""
WAITING = ("Hold",)
"""Leaves that stay in place on purpose; further ones are recognised by a name that begins with Wait, Yield or
Shelter."""


@dataclass
class Killer:
    """What ended the episode."""

    name: str
    """sphere, cylinder, box, wall, floor or surface; "" = nothing (timeout)"""
    slot: int | None = None
    moving: bool = False
    gap_m: float | None = None
    closing_m_s: float | None = None


def is_waiting(leaf: str) -> bool:
    """Whether a leaf of this type stays in place on purpose."""
    return leaf in WAITING or leaf.startswith(("Wait", "Yield", "Shelter"))


class Scene:
    """Distances of the hull to everything over the window."""

    def __init__(self, history: History, bodies: Bodies, config: Config) -> None:
        self.h, self.bodies, self.config = history, bodies, config
        radius, half = config.vehicle.hull_radius_m, config.vehicle.hull_half_length_m
        R_wb = hindsight.rotation(history.quat_wb)
        self.axis_w = R_wb[:, :, 0]
        self.gap, self.normal, self.along = hindsight.hull_gaps(
            history.pos_w, self.axis_w, bodies.kind, history.body_w, bodies.size, bodies.yaw, radius, half
        )
        self.wall = hindsight.wall_gaps(history.pos_w, self.axis_w, config.world.tank, radius, half)
        self.floor, self.surface = hindsight.floor_and_surface_gaps(
            history.pos_w, self.axis_w, config.world.tank, radius, half
        )
        vel_w = np.einsum("nij,nj->ni", R_wb, history.vel_b)
        swing_w = np.cross(np.einsum("nij,nj->ni", R_wb, history.rate_b), self.axis_w)
        point_vel = vel_w[:, None, :] + self.along[..., None] * swing_w[:, None, :]
        self.closing = ((point_vel - history.body_vel_w) * self.normal).sum(-1)
        self.vel_w = vel_w

    def killer(self, outcome: str) -> Killer:
        """What the referee stopped the episode for."""
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
        off = h.believed_pos_w[-1] - h.pos_w[-1]
        blind = h.vel_valid == 0 if killer.name in ("floor", "surface") else h.vel_valid != 1
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


def _sight_facts(history: History, bodies: Bodies, slot: int, config: Config) -> dict[str, Any]:
    """When the sonar could reach the killer, when it saw it, and what else it is."""
    sonar, kind, size = config.sensors.sonar, int(bodies.kind[slot]), bodies.size[slot]
    ago = history.t_s[-1] - history.t_s
    R_wb = hindsight.rotation(history.quat_wb)
    late = history.ping_age_s[:, None]
    then_w = history.pos_w - np.einsum("nij,nj->ni", R_wb, history.vel_b) * late
    body_then_w = history.body_w[:, slot] - history.body_vel_w[:, slot] * late
    yaw = np.arctan2(R_wb[:, 1, 0], R_wb[:, 0, 0]) - history.rate_b[:, 2] * history.ping_age_s
    entry = hindsight.beam_entries(then_w, yaw, kind, body_then_w, size, float(bodies.yaw[slot]), sonar)
    reached = np.isfinite(entry)
    tolerance = (
        BEAM_M
        + 4 * (sonar.range_sigma_m + sonar.range_sigma_slope * np.where(reached, entry, 0.0))
        + sonar.range_jitter_m
    )
    met = reached & (np.abs(history.range_m - np.where(reached, entry, 0.0)) < tolerance)
    off_w = body_then_w[:, :2] - then_w[:, :2]
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
            hindsight.vertical_gap(history.pos_w[-1:], kind, history.body_w[-1:, slot], size)[0]
        ),
        "killer_speed_m_s": _round(np.linalg.norm(history.body_vel_w[-1, slot])),
        "killer_radius_m": _round(size[0]),
        "full_height": bool(
            kind != BOX and size[2] > 0.49 * (config.world.tank.z_m[1] - config.world.tank.z_m[0])
        ),
        "circle_m": _round(abs(bodies.circle_m[slot])) if bodies.circle_m[slot] else None,
    }


def _belief_facts(history: History, slot: int, turned_ago_s: float | None, config: Config) -> dict[str, Any]:
    """What the vehicle believed about the killer."""
    ago = history.t_s[-1] - history.t_s
    truth = history.body_w[:, slot, :2]
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
    """Vertical gap [m] that the vehicle believed in at the end, on the side where the killer was; 0 = it may
    be level."""
    own, above = history.pos_w[-1, 2], history.body_w[-1, slot, 2] > history.pos_w[-1, 2]
    return _round(
        max(
            0.0,
            history.forecast_above_w[-1, track] - own if above else own - history.forecast_below_w[-1, track],
        )
    )


def _foreseen(forecast_w: Array, lead_s: float, dt_s: float) -> Array:
    """Position (2,) that a forecast (n_forecast, 2) gave for ``lead_s`` after it was made (at most its
    horizon)."""
    steps = np.arange(len(forecast_w)) * dt_s
    return np.array([np.interp(lead_s, steps, forecast_w[:, axis]) for axis in range(2)])


def _course_facts(history: History, bodies: Bodies, slot: int, config: Config) -> dict[str, Any]:
    """When the killer last turned a corner (a circle has none), and how often it had turned there before
    within the sonar's reach."""
    vel = history.body_vel_w[:, slot, :2]
    turn = np.abs(np.angle(np.exp(1j * np.diff(np.arctan2(vel[:, 1], vel[:, 0])))))
    corner = (turn > TURN_RAD) & (bodies.circle_m[slot] == 0)
    ago = _last_ago(history.t_s[-1] - history.t_s[1:], corner)
    return {
        "turned_ago_s": ago,
        "turned_deg": None if ago is None else _round(np.degrees(turn[corner][-1])),
        "turns_in_reach_before": None if ago is None else _turns_in_reach(history, bodies, slot, ago, config),
    }


def _turns_in_reach(history: History, bodies: Bodies, slot: int, ago_s: float, config: Config) -> int:
    """Earlier passes of the corner turned ``ago_s`` before the end that lay within the sonar's fan: could it
    have been learnt?"""
    turned_s = float(history.t_s[-1]) - ago_s
    place = history.body_w[int(np.abs(history.t_s - turned_s).argmin()), slot]
    passes = np.arange(turned_s - bodies.lap_s[slot], 0.0, -bodies.lap_s[slot])
    here = np.stack(
        [np.interp(passes, history.coarse.t_s, history.coarse.pos_w[:, axis]) for axis in range(3)], -1
    )
    gap = np.abs(
        hindsight.vertical_gap(
            here, int(bodies.kind[slot]), np.broadcast_to(place, here.shape), bodies.size[slot]
        )
    )
    away = np.linalg.norm(here[:, :2] - place[:2], axis=1)
    sonar = config.sensors.sonar
    return int(
        (
            (away <= sonar.max_range_m)
            & (gap <= away * math.tan(math.radians(sonar.vertical_half_aperture_deg)))
        ).sum()
    )


def killer_facts(history: History, bodies: Bodies, slot: int, config: Config) -> dict[str, Any]:
    """What holds where a moving body in this slot was the killer."""
    course = _course_facts(history, bodies, slot, config)
    beliefs = _belief_facts(history, slot, course["turned_ago_s"], config)
    return (
        _sight_facts(history, bodies, slot, config)
        | course
        | beliefs
        | _escape_facts(history, bodies, config)
    )


def _escape_facts(history: History, bodies: Bodies, config: Config) -> dict[str, Any]:
    """Velocities that would have escaped from LEAD_S before the end, and when the last one was gone."""
    level, heaving = escapes(history, bodies, config, LEAD_S)
    chances = (back for back in CHANCES_S if any(escapes(history, bodies, config, back)))
    beyond = 0 if level or heaving else escapes_beyond_the_edge(history, bodies, config, LEAD_S)
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
