"""Where things are along a route: the vehicle's foot, and points ahead of it. Lengths are measured back from
the goal (way_left_m)."""

import taichi as ti

from uuvtai.config import MappingConfig, RouteConfig
from uuvtai.kernels.core.signature import Const, In, Out
from uuvtai.state import RouteState


@ti.func
def level(v):
    """(x, y) of a three-vector."""
    return ti.Vector([v[0], v[1]])


@ti.func
def segment_of(route: In[RouteState], env, arc):
    """Index of the segment that a fractional waypoint index lies on."""
    return ti.math.clamp(ti.cast(ti.floor(arc), ti.i32), 0, ti.max(route.n_way[env] - 2, 0))


@ti.func
def foot_of(route: In[RouteState], env, arc):
    """Point at a fractional waypoint index [m]."""
    i = segment_of(route, env, arc)
    return route.way_w[env, i] + (route.way_w[env, i + 1] - route.way_w[env, i]) * (arc - i)


@ti.func
def left_of_foot(route: In[RouteState], env):
    """Route length from the foot to the goal [m]."""
    i = segment_of(route, env, route.arc[env])
    return route.way_left_m[env, i] + (route.way_left_m[env, i + 1] - route.way_left_m[env, i]) * (
        route.arc[env] - i
    )


@ti.func
def point_left(route: In[RouteState], env, first, left_m):
    """(point, its segment) with route length ``left_m`` still to go [m], from segment ``first`` on; beyond
    the goal: the goal."""
    i = first
    while i < route.n_way[env] - 2 and route.way_left_m[env, i + 1] > left_m:
        i += 1
    length = route.way_left_m[env, i] - route.way_left_m[env, i + 1]
    share = ti.math.clamp((route.way_left_m[env, i] - left_m) / ti.max(length, 1e-9), 0.0, 1.0)
    return route.way_w[env, i] + (route.way_w[env, i + 1] - route.way_w[env, i]) * share, i


@ti.func
def advanced_arc(route: In[RouteState], env, pos_w, route_cfg: Const[RouteConfig]):
    """Foot of the vehicle: the nearest point of the route from the last foot on, within progress_window_m. It
    never moves back."""
    arc = route.arc[env]
    first = segment_of(route, env, arc)
    nearest = (pos_w - foot_of(route, env, arc)).norm_sqr()
    out, i = arc, first
    while i < route.n_way[env] - 1 and route.way_left_m[env, first] - route.way_left_m[env, i] <= ti.static(
        route_cfg.progress_window_m
    ):
        a, along = route.way_w[env, i], route.way_w[env, i + 1] - route.way_w[env, i]
        share = ti.math.clamp((pos_w - a).dot(along) / ti.max(along.norm_sqr(), 1e-12), 0.0, 1.0)
        if i == first:
            share = ti.max(share, arc - first)
        gap = (pos_w - a - along * share).norm_sqr()
        if gap < nearest:
            nearest, out = gap, i + share
        i += 1
    return out


@ti.func
def look_along(
    route: Out[RouteState], env, pos_w, route_cfg: Const[RouteConfig], mapping_cfg: Const[MappingConfig]
):
    """Fill ``ahead_w``: points of the route one cell apart, from the foot to risk_horizon_m ahead or the
    goal. No route: own place."""
    route.ahead_w[env, 0] = pos_w
    route.n_ahead[env] = 1
    if route.n_way[env] > 0:
        left = left_of_foot(route, env)
        length = ti.min(left, ti.static(route_cfg.risk_horizon_m))
        count = ti.cast(ti.ceil(length / ti.static(mapping_cfg.cell_m) - 1e-3), ti.i32) + 1
        route.n_ahead[env] = ti.min(count, ti.static(route.ahead_w.shape[1]))
        i = segment_of(route, env, route.arc[env])
        for k in range(route.n_ahead[env]):
            point, i_found = point_left(
                route, env, i, left - ti.min(k * ti.static(mapping_cfg.cell_m), length)
            )
            route.ahead_w[env, k] = point
            i = i_found
