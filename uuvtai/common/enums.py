"""Codes for kernels, and their names for logs, results and tables: outcomes, plans, maps, forecasts, sets."""

from typing import Any

OUTCOMES = ("running", "success", "collision", "ttc", "out_of_tank", "timeout")  # names by code
RUNNING, SUCCESS, COLLISION, TTC, OUT_OF_TANK, TIMEOUT = range(len(OUTCOMES))

FINAL_OUTCOMES = OUTCOMES[1:]  # exclusive; every finished episode has one
COLLIDED = ("collision", "ttc", "out_of_tank")
"""what counts as a collision in every rate: contact, a stop by time to collision, leaving the tank"""
LETTERS: dict[str, str] = dict(zip(FINAL_OUTCOMES, "scxot", strict=True))
"""of the endings, for a row of episodes as one word"""


# ---- Codes of planning: why a plan was wanted, who planned, why the Voronoi planner failed. Names are what
# reports and logs print.

TRIGGERS = ("initial", "stuck", "safety", "intersection")
"""In order of priority: exactly one is counted per replan. Code = index + 1, counter's column = index."""
N_TRIGGER = len(TRIGGERS)
TRIGGER_NONE, TRIGGER_INITIAL, TRIGGER_STUCK, TRIGGER_SAFETY, TRIGGER_INTERSECTION = range(N_TRIGGER + 1)

PLANNERS = ("voronoi", "rrt", "own")  # own = a planner that the user brought (``own``)
N_PLANNER = len(PLANNERS)
PLANNER_NONE, PLANNER_VORONOI, PLANNER_RRT, PLANNER_OWN = range(N_PLANNER + 1)

REASONS = ("start_outside", "goal_outside", "disconnected", "budget")
"""Why the Voronoi planner found nothing: the start or the goal is not traversable, the traversable set does
not join them (gaps below d_min), or the search ran out of pops or memory."""
N_REASON = len(REASONS)
FAIL_NONE, FAIL_START_OUTSIDE, FAIL_GOAL_OUTSIDE, FAIL_DISCONNECTED, FAIL_BUDGET = range(N_REASON + 1)


FULL = 65535  # an occupancy of 1, as a layer of the map keeps it


def occupancy(layer: Any) -> Any:
    """Occupancies in [0, 1], float32, of an array of a layer as the map keeps it."""
    return (layer / FULL).astype("float32")


NO_SITE = 127 << 8  # no site in reach, as the clearance keeps it: farther away than any that is


def clearance_m(site: Any, config: Any) -> Any:
    """Clearance [m], float32, of an int16 array of sites as the clearance keeps them."""
    rows, cols = site >> 8, site << 8 >> 9
    found = (rows * rows + cols * cols).astype("float32") ** 0.5 * config.mapping.cell_m
    inflation = (site & 1).astype("float32") * config.clearance.inflate_m
    return (found - inflation).clip(0, config.clearance.max_m)


# ---- What a learned forecast is told and what it says, in numbers: read by its kernels and by what learns.

PACKET = 16  # columns and units come in whole packets (``kernels.core.simd.LANES``)

N_PAST, PAST_S = 9, 0.3  # places remembered of each track, and the time between them
N_BEND = 4  # turns remembered of each track
LENGTH_M, FAR = 4.0, 2.0
AHEAD_STEPS = (5, 10, 15, 20, 25)  # samples of the forecast that are told
N_FRAME = 5
N_MOTION, N_AHEAD = 13, 9
COLUMNS = N_MOTION + N_AHEAD + 2 * len(AHEAD_STEPS) + 3 * N_BEND + 2 * N_PAST + 1
N_COLUMN = PACKET * -(-COLUMNS // PACKET)  # with padding, which is 0
SIDE_COLUMNS = (
    2,
    N_MOTION + 6,
    *(N_MOTION + N_AHEAD + 2 * i + 1 for i in range(len(AHEAD_STEPS))),
    *(N_MOTION + N_AHEAD + 2 * len(AHEAD_STEPS) + 3 * i + 1 for i in range(N_BEND)),
    *(COLUMNS - 2 - 2 * i for i in range(N_PAST)),
)
"""columns that change their sign in a mirror along the course"""
FAR_COLUMNS = ((N_MOTION + 2, N_MOTION + 3),)
"""pairs of columns that change their places in it: the walls to the left and to the right"""


N_MODE, ANCHORS, ANCHOR_S = 6, 5, 0.5
N_HIDDEN = 64
N_TOLD = N_MODE * (1 + 2 * ANCHORS)
N_SAID = PACKET * -(-N_TOLD // PACKET)  # with padding
N_SPREAD = 2 * ANCHORS * N_MODE  # the trained network says spreads too, which the kernel leaves out
MIDDLE = (1 + N_COLUMN) * N_HIDDEN
LAST = MIDDLE + (1 + N_HIDDEN) * N_HIDDEN
N_WEIGHT = LAST + (1 + N_HIDDEN) * N_SAID  # of the three layers: biases, then a row for each input


# ---- What only the simulator knows.


class Truth:
    """Base of structs and sections that no stage of the stack may name, nor be handed:
    ``tests/repository/test_architecture.py`` reads it."""


# ---- A policy over a set of obstacles in numbers: widths of what it is told, and of the rule that lays its
# wish on the hull. Read by kernels, by what learns, and by what is exported without them.

HOLD_STEPS, DECISION_S = 5, 0.1  # control steps that the surrogate holds a decision, and how long that is
N_OBSTACLE = 9  # moving obstacles that the policy sees, the nearest ones
OBSTACLE_WIDTH = 22  # columns of an obstacle
OWN_WIDTH = 22  # columns of the vehicle, its route and its goal
N_RAY = 24  # rays of free distance around the vehicle
EGO_COLUMNS = OWN_WIDTH + N_RAY  # columns of the vehicle's own, rays included

TURN_GAIN = 2.5  # [1/s] yaw rate by the angle that is still to turn
LEAST_SPEED_M_S = 0.1  # below it the vehicle keeps its heading


class Safety:
    """Numbers of the safety filter (``surrogate/safety.py``)."""

    STEP_S, LAG_S = 0.1, 0.3  # the hull's velocity follows a wish like a lag of the first order, in steps
    REACHED = 0.85  # part of the fastest velocity that it reaches: its diagonal has to turn to the motion
    HULL_M, SPARE_M = 0.24, 0.06  # radius of the hull, and what is kept beyond it
    SPARE_S = 0.08  # kept beyond the time to collision that ends an episode
    WALL_HORIZON_S, WALL_S, WALL_M = 1.0, 0.1, 0.05  # the same of walls and static obstacles, as ends of rays
    SIGHT_M = 1.4  # so far away no wall is reached by then
    DIRECTIONS = 16  # wishes that are tried: none, and these at full and at half speed
    LACK_COST = 100.0  # a missing metre of clearance counts as this square of a change of the wish
