"""What a tree may hold: leaves with their ports, control nodes and decorators."""

from __future__ import annotations

from dataclasses import dataclass

from uuvtai import tree_codes as codes

MAX_PORTS = 4
"""Numbers that a leaf can be given."""


@dataclass(frozen=True)
class Leaf:
    """What a tree may contain as a leaf."""

    code: int
    kind: int
    ports: tuple[str, ...]
    meaning: str


def _condition(code: int, ports: str, meaning: str) -> Leaf:
    return Leaf(code, codes.CONDITION, tuple(ports.split()), meaning)


def _action(code: int, ports: str, meaning: str) -> Leaf:
    return Leaf(code, codes.ACTION, tuple(ports.split()), meaning)


LEAVES = {
    "EmergencyTtc": _condition(
        codes.EMERGENCY_TTC, "ttc_s range_m", "sonar: contact sooner than ttc_s, or closing in within range_m"
    ),
    "PredictedConflict": _condition(
        codes.PREDICTED_CONFLICT, "within_s calm_s", "a forecast body comes too close; holds calm_s longer"
    ),
    "RouteBlocked": _condition(
        codes.ROUTE_BLOCKED, "clearance_m", "mapped clearance on the way to the look-ahead point is too small"
    ),
    "Stuck": _condition(codes.STUCK, "seconds", "hardly any motion for this long, away from the goal"),
    "HasRoute": _condition(codes.HAS_ROUTE, "", "a route exists"),
    "GoalNear": _condition(codes.GOAL_NEAR, "distance_m", "the goal is closer than distance_m"),
    "SafeHere": _condition(
        codes.SAFE_HERE,
        "within_s",
        "stopping here conflicts with no forecast body within within_s, or at all",
    ),
    "BackOff": _action(codes.BACK_OFF, "speed_m_s", "retreat from the sensed threat"),
    "Evade": _action(codes.EVADE, "", "drive the evasive velocity of least cost"),
    "Hold": _action(codes.HOLD, "", "stay in place, away from mapped obstacles"),
    "Unstick": _action(codes.UNSTICK, "seconds speed_m_s", "creep away from the nearest mapped obstacle"),
    "FollowRoute": _action(
        codes.FOLLOW_ROUTE, "speed_m_s depth_guard", "pursue the look-ahead point; fails without a route"
    ),
    "DriveStraight": _action(codes.DRIVE_STRAIGHT, "speed_m_s", "drive at the goal, blind"),
}

CONTROLS = {
    "Sequence": codes.SEQUENCE,
    "Fallback": codes.FALLBACK,
    "ReactiveSequence": codes.REACTIVE_SEQUENCE,
    "ReactiveFallback": codes.REACTIVE_FALLBACK,
}
DECORATORS = {
    "Inverter": codes.INVERTER,
    "ForceSuccess": codes.FORCE_SUCCESS,
    "ForceFailure": codes.FORCE_FAILURE,
}
