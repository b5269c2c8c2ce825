"""Codes of a behaviour tree's statuses, kinds of nodes and leaves: plain numbers, so that a tree can be read
without Taichi."""

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
