"""What a behaviour tree may hold, leaves with their ports, control nodes and decorators, and the codes of its
statuses: plain numbers, so that a tree can be read without Taichi."""

from __future__ import annotations

from dataclasses import dataclass

# statuses, numbered as in BehaviorTree.CPP
IDLE = 0
RUNNING = 1
SUCCESS = 2
FAILURE = 3

# kinds of nodes: sequences, fallbacks, decorators, leaves
SEQUENCE = 0
REACTIVE_SEQUENCE = 1
FALLBACK = 2
REACTIVE_FALLBACK = 3
INVERTER = 4
FORCE_SUCCESS = 5
FORCE_FAILURE = 6
CONDITION = 7
ACTION = 8

# leaves: conditions, then actions
EMERGENCY_TTC = 0
PREDICTED_CONFLICT = 1
ROUTE_BLOCKED = 2
STUCK = 3
HAS_ROUTE = 4
GOAL_NEAR = 5
SAFE_HERE = 6
BACK_OFF = 16
EVADE = 17
HOLD = 18
UNSTICK = 19
FOLLOW_ROUTE = 20
DRIVE_STRAIGHT = 21
FIRST_BASELINE = 32  # Codes from here on are local planners of the literature.
DYNAMIC_WINDOW = FIRST_BASELINE
PATH_INTEGRAL = 33

MAX_PORTS = 4  # Numbers that a leaf can be given.
MAX_NODES = 64  # Nodes of a tree, those of its subtrees included.


@dataclass(frozen=True)
class Leaf:
    """What a tree may contain as a leaf."""

    code: int
    kind: int
    ports: tuple[str, ...]
    meaning: str


def _condition(code: int, ports: str, meaning: str) -> Leaf:
    return Leaf(code, CONDITION, tuple(ports.split()), meaning)


def _action(code: int, ports: str, meaning: str) -> Leaf:
    return Leaf(code, ACTION, tuple(ports.split()), meaning)


LEAVES = {
    "EmergencyTtc": _condition(
        EMERGENCY_TTC, "ttc_s range_m", "sonar: contact sooner than ttc_s, or closing in within range_m"
    ),
    "PredictedConflict": _condition(
        PREDICTED_CONFLICT,
        "within_s hysteresis_s",
        "a forecast obstacle comes too close; holds hysteresis_s longer",
    ),
    "RouteBlocked": _condition(
        ROUTE_BLOCKED, "clearance_m", "mapped clearance on the way to the look-ahead point is too small"
    ),
    "Stuck": _condition(STUCK, "seconds", "hardly any motion for this long, away from the goal"),
    "HasRoute": _condition(HAS_ROUTE, "", "a route exists"),
    "GoalNear": _condition(GOAL_NEAR, "distance_m", "the goal is closer than distance_m"),
    "SafeHere": _condition(
        SAFE_HERE, "within_s", "stopping here conflicts with no forecast obstacle within within_s, or at all"
    ),
    "BackOff": _action(BACK_OFF, "speed_m_s", "retreat from the sensed threat"),
    "Evade": _action(EVADE, "", "drive the evasive velocity of least cost"),
    "Hold": _action(HOLD, "", "stay in place, away from mapped obstacles"),
    "Unstick": _action(UNSTICK, "seconds speed_m_s", "creep away from the nearest mapped obstacle"),
    "FollowRoute": _action(
        FOLLOW_ROUTE, "speed_m_s depth_guard", "pursue the look-ahead point; fails without a route"
    ),
    "DriveStraight": _action(DRIVE_STRAIGHT, "speed_m_s", "drive at the goal, blind"),
    "DynamicWindow": _action(
        DYNAMIC_WINDOW, "", "dynamic window approach along the route; fails without one"
    ),
    "PathIntegral": _action(PATH_INTEGRAL, "", "sampling MPC (MPPI) along the route; fails without one"),
}

CONTROLS = {
    "Sequence": SEQUENCE,
    "Fallback": FALLBACK,
    "ReactiveSequence": REACTIVE_SEQUENCE,
    "ReactiveFallback": REACTIVE_FALLBACK,
}
DECORATORS = {"Inverter": INVERTER, "ForceSuccess": FORCE_SUCCESS, "ForceFailure": FORCE_FAILURE}
