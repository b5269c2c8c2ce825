"""The route from the vehicle's view: look-ahead point, heading and cross-track error, length left, risk of
what lies ahead."""

import taichi as ti

from uuvtai.common.enums import N_PLANNER, N_REASON, N_TRIGGER
from uuvtai.compile.launch import quick_launch
from uuvtai.kernels.core.geometry import foot_on, wrapped_angle
from uuvtai.kernels.core.grid import cell_of, occupancy_of
from uuvtai.kernels.core.stage import Bundle, FloatMatrix, In, n_envs
from uuvtai.kernels.planning.io import RouteIO
from uuvtai.kernels.planning.medial_axis import (
    MAX_WIDENINGS,
    WIDENING,
    count_after_segment,
    install_route,
    room_at,
)
from uuvtai.state import RouteState

# ------------------------------------------------------------------------------------------------------------
# Where things are along a route: the vehicle's foot, and points ahead of it. Lengths are measured back from
# the goal (way_left_m).

_WINDOW_M = 1.5  # How far ahead of the last foot the new one is looked for.


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
def advanced_arc(route: In[RouteState], env, pos_w):
    """Foot of the vehicle: the nearest point of the route from the last foot on, within _WINDOW_M. It never
    moves back."""
    arc = route.arc[env]
    first = segment_of(route, env, arc)
    nearest = (pos_w - foot_of(route, env, arc)).norm_sqr()
    out, i = arc, first
    while i < route.n_way[env] - 1 and route.way_left_m[env, first] - route.way_left_m[env, i] <= _WINDOW_M:
        a, along = route.way_w[env, i], route.way_w[env, i + 1] - route.way_w[env, i]
        share, gap = foot_on(pos_w, a, along, arc - first if i == first else 0.0)
        if gap < nearest:
            nearest, out = gap, i + share
        i += 1
    return out


@ti.func
def look_along(env, pos_w, io: Bundle[RouteIO]):
    """Fill ``ahead_w``: points of the route one cell apart, from the foot to risk_horizon_m ahead or the
    goal. No route: own place."""
    io.route.ahead_w[env, 0] = pos_w
    io.route.n_ahead[env] = 1
    if io.route.n_way[env] > 0:
        left = left_of_foot(io.route, env)
        length = ti.min(left, ti.static(io.route_cfg.risk_horizon_m))
        count = ti.cast(ti.ceil(length / ti.static(io.mapping_cfg.cell_m) - 1e-3), ti.i32) + 1
        io.route.n_ahead[env] = ti.min(count, ti.static(io.route.ahead_w.shape[1]))
        i = segment_of(io.route, env, io.route.arc[env])
        for k in range(io.route.n_ahead[env]):
            point, i_found = point_left(
                io.route, env, i, left - ti.min(k * ti.static(io.mapping_cfg.cell_m), length)
            )
            io.route.ahead_w[env, k] = point
            i = i_found


# ------------------------------------------------------------------------------------------------------------
# The paper's risk R of a place, for those who look along the route.


@ti.func
def cell_on_grid(pos_w, io: Bundle[RouteIO]):
    """(row, col), off-grid positions held at the edge."""
    cell = cell_of(pos_w, io.tank_cfg, io.mapping_cfg.cell_m)
    n_row, n_col = ti.static(io.clearance.site.shape[1:])
    return ti.Vector([ti.math.clamp(cell[0], 0, n_row - 1), ti.math.clamp(cell[1], 0, n_col - 1)])


@ti.func
def risk_at(env, cell, room, io: Bundle[RouteIO]):
    """R: alpha_m M^s + alpha_d M^d + alpha_delta / (clearance + eps), of a cell with its clearance [m]."""
    row, col = cell[0], cell[1]
    occupied = ti.static(io.clearance_cfg.risk_static) * occupancy_of(io.grid_map.static_occ[env, row, col])
    moving = ti.static(io.clearance_cfg.risk_dynamic) * occupancy_of(io.grid_map.dynamic_occ[env, row, col])
    return (
        occupied
        + moving
        + ti.static(io.clearance_cfg.risk_clearance) / (room + ti.static(io.clearance_cfg.risk_epsilon_m))
    )


# ------------------------------------------------------------------------------------------------------------


_LONG_AGO = -(1 << 20)  # Step at which no trigger has been served yet.


@quick_launch
@ti.kernel
def reset_route(io: Bundle[RouteIO]):
    """No route, no history, in the active rows."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
            for field in ti.static((
                io.route.n_way, io.route.cost, io.route.planner, io.route.trigger, io.route.fired,
                io.route.want_plan, io.route.fallback_reason, io.route.plan_step, io.route.kept,
                io.route.second_passes, io.route.n_ahead, io.route.arc, io.route.heading_error,
                io.route.cross_track_m, io.route.remaining_m, io.route.path_risk, io.route.stuck_steps,
            )):  # fmt: skip
                field[env] = 0
            io.route.lookahead_w[env] = ti.Vector([0.0, 0.0, 0.0])
            for i in range(io.route.way_w.shape[1]):
                io.route.way_w[env, i] = ti.Vector([0.0, 0.0])
                io.route.way_left_m[env, i] = 0.0
            for i in range(io.route.ahead_w.shape[1]):
                io.route.ahead_w[env, i] = ti.Vector([0.0, 0.0])
            for i in range(N_TRIGGER):
                io.route.replans[env, i] = 0
                io.route.served_step[env, i] = _LONG_AGO
            for i in range(N_PLANNER):
                io.route.planned_by[env, i] = 0
            for i in range(N_REASON):
                io.route.fallbacks[env, i] = 0


@quick_launch
@ti.kernel
def follow_route(io: Bundle[RouteIO]):
    """Path-relative terms of the active rows, from the foot that ``fire_triggers`` moved or from the start of
    a route planned since."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
            if io.route.want_plan[env] == 1:  # else ``fire_triggers`` has just looked along the same route
                _look_again(env, io)
            if io.route.n_way[env] > 0:
                _aim(env, io)
            else:
                _hover(env, io)


@ti.func
def _look_again(env, io: Bundle[RouteIO]):
    """What lies ahead on a route planned since, and its mean risk."""
    look_along(env, level(io.ego.pos_w[env]), io)
    risk = 0.0
    for k in range(io.route.n_ahead[env]):
        cell = cell_on_grid(io.route.ahead_w[env, k], io)
        risk += risk_at(env, cell, room_at(env, cell[0], cell[1], io), io)
    io.route.path_risk[env] = risk / io.route.n_ahead[env]


@ti.func
def _aim(env, io: Bundle[RouteIO]):
    """Look-ahead point and errors against the route. The depth runs straight from the present one to the
    goal's over the length left, so that it arrives in time from wherever an evasion has left the vehicle."""
    pos, goal, arc = io.ego.pos_w[env], io.mission.goal_w[env], io.route.arc[env]
    i = segment_of(io.route, env, arc)
    left = left_of_foot(io.route, env)
    point, _i = point_left(io.route, env, i, left - ti.static(io.route_cfg.lookahead_m))
    depth = pos[2] + (goal[2] - pos[2]) * ti.min(
        1.0, ti.static(io.route_cfg.lookahead_m) / ti.max(left, 1e-6)
    )
    io.route.lookahead_w[env] = ti.Vector([point[0], point[1], depth])
    ahead = point - level(pos)
    io.route.heading_error[env] = 0.0
    if ahead.norm_sqr() > 1e-12:
        io.route.heading_error[env] = wrapped_angle(ti.atan2(ahead[1], ahead[0]) - io.ego.rpy[env][2])
    along = io.route.way_w[env, i + 1] - io.route.way_w[env, i]
    off = level(pos) - foot_of(io.route, env, arc)
    io.route.cross_track_m[env] = ti.select(
        along[0] * off[1] - along[1] * off[0] >= 0, off.norm(), -off.norm()
    )
    io.route.remaining_m[env] = left


@ti.func
def _hover(env, io: Bundle[RouteIO]):
    """Without a route: steer at one's own place; what is left is the straight distance."""
    io.route.lookahead_w[env] = io.ego.pos_w[env]
    io.route.heading_error[env] = 0.0
    io.route.cross_track_m[env] = 0.0
    io.route.remaining_m[env] = level(io.mission.goal_w[env] - io.ego.pos_w[env]).norm()


@ti.kernel
def load_route(io: Bundle[RouteIO], way_w: FloatMatrix, env: int, planner: int):
    """Take the host's path (n >= 2 corners, (n, 2) [m]) as the env's route, spaced and counted like the
    kernel's own; ``planner``: who made it (plan_codes.PLANNER_RRT, PLANNER_OWN)."""
    for _ in range(1):
        spacing, writing, tries, room = (
            ti.static(io.route_cfg.spacing_m) * 1.0,
            0,
            0,
            ti.static(io.route.way_w.shape[1]),
        )
        while tries < MAX_WIDENINGS:
            count = 1
            for i in range(1, way_w.shape[0]):
                a, b = ti.Vector([way_w[i - 1, 0], way_w[i - 1, 1]]), ti.Vector([way_w[i, 0], way_w[i, 1]])
                if writing == 1 and i == 1:
                    io.route.way_w[env, 0] = a
                count = count_after_segment(io.route, env, count, a, b, spacing, writing)
            tries += 1
            if writing == 1:
                cost = _route_cost(env, count, io)
                install_route(io.route, io.clock, env, count, cost, planner)
                tries = MAX_WIDENINGS
            elif count <= room:
                writing = 1
            else:
                spacing *= WIDENING


@ti.func
def _route_cost(env, n_way, io: Bundle[RouteIO]):
    """Integral of 1 / max(clearance, eps) along the waypoints, in pieces of at most half a cell."""
    cost = 0.0
    for i in range(n_way - 1):
        a, along = io.route.way_w[env, i], io.route.way_w[env, i + 1] - io.route.way_w[env, i]
        pieces = ti.cast(ti.ceil(along.norm() / ti.static(0.5 * io.mapping_cfg.cell_m)), ti.i32)
        for k in range(pieces):  # type: ignore[arg-type]
            cell = cell_on_grid(a + along * ((k + 0.5) / pieces), io)
            room = ti.max(room_at(env, cell[0], cell[1], io), ti.static(io.voronoi_cfg.cost_epsilon_m))
            cost += along.norm() / pieces / room
    return cost


@ti.kernel
def keep_route(io: Bundle[RouteIO], env: int):
    """Both planners failed: the last valid route stays (or none), and that is counted."""
    io.route.kept[env] += 1
