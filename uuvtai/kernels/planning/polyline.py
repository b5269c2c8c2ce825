"""Writing a polyline into the route: waypoints at most a spacing apart, every corner kept, so that the
geometry never changes."""

import taichi as ti

from uuvtai.kernels.core.signature import In, Out
from uuvtai.state import ClockState, RouteState

_ROUNDING = 1.0e-4
"""A segment longer than the spacing by less than this share is not cut in two."""

WIDENING = 1.25
"""Where a route does not fit into n_way waypoints, its spacing grows by this factor until it does."""

MAX_WIDENINGS = 16


@ti.func
def count_after_segment(route: Out[RouteState], env, count, a, b, spacing, write):
    """Append the waypoints of the segment from a (already there) to b; returns the new count. ``write`` == 0
    only counts."""
    pieces = ti.max(1, ti.cast(ti.ceil((b - a).norm() / spacing - _ROUNDING), ti.i32))
    if write == 1:
        for i in range(pieces):
            route.way_w[env, count + i] = a + (b - a) * ((i + 1.0) / pieces)
        route.way_w[env, count + pieces - 1] = b
    return count + pieces


@ti.func
def install_route(route: Out[RouteState], clock: In[ClockState], env, n_way, cost, planner):
    """Declare the waypoints written to be the route: lengths left, foot at its start, who planned it."""
    route.n_way[env] = n_way
    route.cost[env] = cost
    route.planner[env] = planner
    route.plan_step[env] = clock.step[env]
    route.planned_by[env, planner - 1] += 1
    route.arc[env] = 0.0
    left = 0.0 * cost
    route.way_left_m[env, n_way - 1] = left
    for k in range(1, n_way):
        i = n_way - 1 - k
        left += (route.way_w[env, i + 1] - route.way_w[env, i]).norm()
        route.way_left_m[env, i] = left
