"""Codes of planning: why a plan was wanted, who planned, why the Voronoi planner failed. Names are what
reports and logs print."""

TRIGGERS = ("initial", "stuck", "safety", "intersection")
"""In order of priority: exactly one is counted per replan. Code = index + 1, counter's column = index."""
N_TRIGGER = len(TRIGGERS)
TRIGGER_NONE, TRIGGER_INITIAL, TRIGGER_STUCK, TRIGGER_SAFETY, TRIGGER_INTERSECTION = range(N_TRIGGER + 1)

PLANNERS = ("voronoi", "rrt", "own")
"""own = a planner that the user brought (``own``)"""
N_PLANNER = len(PLANNERS)
PLANNER_NONE, PLANNER_VORONOI, PLANNER_RRT, PLANNER_OWN = range(N_PLANNER + 1)

REASONS = ("start_outside", "goal_outside", "disconnected", "budget")
"""Why the Voronoi planner found nothing: the start or the goal is not traversable, the traversable set does
not join them (gaps below d_min), or the search ran out of pops or memory."""
N_REASON = len(REASONS)
FAIL_NONE, FAIL_START_OUTSIDE, FAIL_GOAL_OUTSIDE, FAIL_DISCONNECTED, FAIL_BUDGET = range(N_REASON + 1)
