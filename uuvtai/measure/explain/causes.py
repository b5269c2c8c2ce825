"""Why an episode failed: one label from the facts of its last seconds, and remarks. Pure NumPy, nothing runs
here.

Every failed episode gets exactly one label, the first of ``CAUSES`` whose condition holds. The order asks
what a developer would ask: was there a chance at all, did the vehicle *know* of what killed it (sensing,
tracking, forecast: the first half), and if it did, what did the pilot make of it (the second half). Remarks
add what may have contributed; any number of them may hold.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from uuvtai.config import Config
from uuvtai.measure.explain.facts import (
    BACK_RAD,
    BLIND_S,
    CLIMB_S,
    LAST_S,
    LEAD_S,
    Killer,
    Scene,
    killer_facts,
    timeout_facts,
)
from uuvtai.measure.explain.history import Bodies, History

START_S = 2.0
"""A younger episode starts in danger: track, forecast and evasion take about a second, and bodies start 1.5 m
away."""
UNSEEN_S = 0.3
"""Unseen: out of the sonar's fan all through this time before the end (the design's measure: no
track 0.3 s before)."""
TURN_S = 1.2
"""An unannounced turn lies within this before the end (7-methods.md), and the forecast made just before it
was off by more than MISS_M at the end, or there was none."""
CLEAR_M = 0.1
"""A body that is remembered farther above or below than this counts as clear of the own depth (what the
referee calls contact)."""
LATELY_S = 2.5
"""Remarks look back this far."""
MISS_M = 0.35
"""A forecast missed when it was farther off than the pilot's margin at one second (0.25 m + 0.1 m/s)."""
REACH_M = 0.4
"""Squeezed: something static is nearer to the hull at the end: no room to give way (hull 0.17 m + contact 0.1
m + margin)."""
CROWD_M = 0.6
"""Crowded: a second moving body came nearer to the hull in the last CROWD_S."""
NEAR_M = 1.0
"""Contact with something static is no accident of its own when a moving body came this near to the hull in
the last NEAR_S."""
PLACE_M = 0.1
"""Lost its place: the own position was farther off than the pilot's margin from what stands still
(``teacher.static_margin_m``)."""
DEPTH_M = 0.05
"""Took floor or surface for farther than it was: the own depth was off by more, towards it; the pilot keeps
the hull 0.03 m off and three standard deviations of the depth."""
CLIMB_M = 0.15
"""Changed its depth: moved by more, upwards or downwards, in the last second."""
PROGRESS_M = 1.0
"""A timeout that came this much nearer to the goal in that time was only slow."""
STUCK_M = 0.5
"""A vehicle that drove less in that time did not move."""

CAUSES: dict[str, str] = {
    "out_of_tank": "left the tank",
    "depth_misjudged": f"touched floor or surface, the own depth off by > {DEPTH_M:g} m towards it",
    "lost_place": f"touched a static or wall, the own position off by > {PLACE_M:g} m",
    "velocity_lost": "touched floor, surface, a static or wall, the own velocity unknown in most of the last "
    f"{BLIND_S:g} s",
    "hit_floor": "touched the floor",
    "hit_surface": "touched the surface",
    "pushed_into_static": f"touched a static or wall while evading, or with a moving body within {NEAR_M:g} "
    "m",
    "hit_static": "touched a static obstacle, no moving body near",
    "hit_wall": "touched a side wall, no moving body near",
    "start_in_danger": f"killed in the first {START_S:g} s",
    "unseen_beside": f"killer beside or behind the sonar's fan all through the last {UNSEEN_S:g} s",
    "depth_change": f"killer above or below the sonar's fan all through the last {UNSEEN_S:g} s, and the own "
    f"depth changed towards it by > {CLIMB_M:g} m in the last {CLIMB_S:g} s",
    "unseen_above": f"killer above the sonar's fan all through the last {UNSEEN_S:g} s",
    "unseen_below": f"killer below the sonar's fan all through the last {UNSEEN_S:g} s",
    "turned_back": f"killer turned back in the last {TURN_S:g} s and the forecast before it was wrong",
    "unannounced_turn": f"killer turned a corner in the last {TURN_S:g} s and the forecast before it was "
    "wrong",
    "seen_late": f"killer came into the sonar's fan less than {LEAD_S:g} s before the end",
    "hidden": f"killer was behind something else until {LEAD_S:g} s before the end",
    "untracked": f"killer seen, but no forecast of it {LEAD_S:g} s before the end",
    "curving": f"killer on a circle, forecast off by > {MISS_M:g} m",
    "forecast_missed": f"killer on a straight course, forecast off by > {MISS_M:g} m",
    "late": "forecast right, but evasion began after the last chance to escape, or never",
    "wrong_evasion": "forecast right and evading before the last chance to escape: it chose the wrong way",
    "needs_heave": "forecast right, but only a change of depth would have escaped",
    "depth_edge": "forecast right, only below the floor or above the surface was there a way out",
    "squeezed_by_static": f"forecast right, no way out: static or wall within {REACH_M:g} m",
    "crowded": f"forecast right, no way out: a second moving body within {CROWD_M:g} m",
    "fast_crossing": "forecast right, no way out: the killer is too fast to give way to",
    "no_route": f"timeout: no route in most of the last {LAST_S:g} s",
    "too_slow": f"timeout: still came > {PROGRESS_M:g} m nearer to the goal in the last {LAST_S:g} s",
    "waiting": f"timeout: waited on purpose in most of the last {LAST_S:g} s",
    "kept_away": f"timeout: evaded in most of the last {LAST_S:g} s",
    "stuck": f"timeout: drove < {STUCK_M:g} m in the last {LAST_S:g} s",
    "circling": f"timeout: drove on without coming nearer in the last {LAST_S:g} s",
}
"""Every label with its meaning, in order of precedence (forecasts are judged LEAD_S before the end, escapes
too)."""


Fact = dict[str, Any]

REMARKS: dict[str, Callable[[Fact], bool]] = {
    "second body near": lambda f: _within(f["second_body_m"], CROWD_M),
    "static near": lambda f: f["static_near_m"] < REACH_M,
    "turned lately": lambda f: _within(f["turned_ago_s"], LATELY_S),
    "corner passed in reach before": lambda f: (
        _within(f["turned_ago_s"], TURN_S) and bool(f["turns_in_reach_before"])
    ),
    "changed its depth": lambda f: abs(f["climbed_m"]) > CLIMB_M,
    "remembered to the end": lambda f: _is_unseen(f) and f["belief_error_m"] is not None,
    "remembered clear of the own depth": lambda f: _is_unseen(f) and (f["believed_gap_m"] or 0.0) > CLEAR_M,
    "taken as static": lambda f: _within(f["taken_as_static_ago_s"], LATELY_S),
    "backed off before the last chance": lambda f: (
        f["leaf"] == "BackOff" and f["leaf_s"] > (f["last_chance_s"] or 0.0)
    ),
    "only heave escaped": lambda f: not f["escapes"] and bool(f["escapes_by_heave"]),
}
"""What may have contributed, where the killer moves. "Corner passed in reach before": the turn could have
been learnt."""

_IMPLIED = {
    ("unannounced_turn", "turned lately"),
    ("turned_back", "turned lately"),
    ("depth_change", "changed its depth"),
    ("needs_heave", "only heave escaped"),
    ("squeezed_by_static", "static near"),
    ("crowded", "second body near"),
}
"""Remarks that a label says already."""


@dataclass
class Explanation:
    """Label, facts and remarks of one failed episode."""

    label: str
    killer: Killer
    facts: Fact = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)


def explain(outcome: str, history: History, bodies: Bodies, config: Config) -> Explanation:
    """Label and facts of an episode that ended with ``outcome`` (collision, ttc, out_of_tank or timeout)."""
    if outcome == "timeout":
        facts = timeout_facts(history.coarse)
        return Explanation(timeout_label(facts), Killer(""), facts)
    scene = Scene(history, bodies, config)
    killer = scene.killer(outcome)
    facts, remarks = scene.facts(killer), []
    if killer.moving and killer.slot is not None:
        facts |= killer_facts(history, bodies, killer.slot, config)
    label = label_of(outcome, killer, facts)
    if killer.moving:
        remarks = [name for name, holds in REMARKS.items() if holds(facts) and (label, name) not in _IMPLIED]
    if label == "start_in_danger":
        remarks.insert(0, f"else {label_of(outcome, killer, facts | {'age_s': START_S})}")
    return Explanation(label, killer, facts, remarks)


# ----------------------------------------------------------------------------------------------------- labels


def label_of(outcome: str, killer: Killer, facts: Fact) -> str:
    """The first cause that holds; its order and meaning are ``CAUSES``."""
    if outcome == "out_of_tank":
        return "out_of_tank"
    if killer.name in ("floor", "surface"):
        towards = facts["depth_error_m"] * (1 if killer.name == "floor" else -1)
        if towards > DEPTH_M:
            return "depth_misjudged"
        return "velocity_lost" if facts["blind_share"] > 0.5 else f"hit_{killer.name}"
    if not killer.moving:
        if facts["place_error_m"] > PLACE_M:
            return "lost_place"
        if facts["blind_share"] > 0.5:
            return "velocity_lost"
        pushed = facts["evading_s"] > 0 or _within(facts["moving_near_m"], NEAR_M)
        return "pushed_into_static" if pushed else "hit_wall" if killer.name == "wall" else "hit_static"
    return _knowledge_label(facts) or _pilot_label(facts)


def _knowledge_label(facts: Fact) -> str | None:
    """What kept the vehicle from knowing where the killer would be; None = it knew."""
    if facts["age_s"] < START_S:
        return "start_in_danger"
    if _is_unseen(facts):
        if facts["width_ago_s"] is None or facts["width_ago_s"] >= UNSEEN_S:
            return "unseen_beside"
        above = facts["vertical_gap_m"] > 0
        if facts["climbed_m"] * (1 if above else -1) > CLIMB_M:
            return "depth_change"
        return "unseen_above" if above else "unseen_below"
    if _within(facts["turned_ago_s"], TURN_S) and not _within(facts["turn_error_m"], MISS_M):
        return "turned_back" if _turned_back(facts) else "unannounced_turn"
    if facts["forecast_error_m"] is None:
        return (
            "seen_late"
            if facts["fan_share"] < 0.5
            else "hidden"
            if facts["seen_share"] < 0.5
            else "untracked"
        )
    if facts["forecast_error_m"] > MISS_M:
        return "curving" if facts["circle_m"] else "forecast_missed"
    return None


def _pilot_label(facts: Fact) -> str:
    """What the pilot made of what it knew; where nothing could be made of it, what stood in the way."""
    if facts["escapes"]:
        return "late" if facts["evading_s"] < facts["last_chance_s"] else "wrong_evasion"
    if facts["escapes_by_heave"]:
        return "needs_heave"
    if facts["escapes_beyond_edge"]:
        return "depth_edge"
    if facts["static_near_m"] < REACH_M:
        return "squeezed_by_static"
    return "crowded" if _within(facts["second_body_m"], CROWD_M) else "fast_crossing"


def timeout_label(facts: Fact) -> str:
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


def _turned_back(facts: Fact) -> bool:
    return _within(facts["turned_ago_s"], TURN_S) and facts["turned_deg"] > math.degrees(BACK_RAD)


def _is_unseen(facts: Fact) -> bool:
    return facts["fan_ago_s"] is None or facts["fan_ago_s"] >= UNSEEN_S


def _within(value: float | None, limit: float) -> bool:
    return value is not None and value <= limit
