"""The route from the vehicle's view: look-ahead point, heading and cross-track error, length left, risk of
what lies ahead."""

import taichi as ti

from uuvtai.kernels.core.geometry import wrapped_angle
from uuvtai.kernels.core.signature import Bundle, FloatMatrix, spread
from uuvtai.kernels.planning.along import foot_of, left_of_foot, level, look_along, point_left, segment_of
from uuvtai.kernels.planning.bundles import RouteIO
from uuvtai.kernels.planning.path_risk import cell_on_grid, risk_at
from uuvtai.kernels.planning.polyline import MAX_WIDENINGS, WIDENING, count_after_segment, install_route
from uuvtai.native.launch import quick_launch
from uuvtai.plan_codes import N_PLANNER, N_REASON, N_TRIGGER

_LONG_AGO = -(1 << 20)
"""Step at which no trigger has been served yet."""


@quick_launch
@ti.kernel
def reset_route(io: Bundle[RouteIO]):
    """No route, no history, in the awake rows."""
    n = ti.static(io.clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and io.clock.awake[env] == 1:
            for field in ti.static(
                (
                    io.route.n_way,
                    io.route.cost,
                    io.route.planner,
                    io.route.trigger,
                    io.route.fired,
                    io.route.want_plan,
                    io.route.fallback_reason,
                    io.route.plan_step,
                    io.route.kept,
                    io.route.second_passes,
                    io.route.n_ahead,
                    io.route.arc,
                    io.route.heading_error,
                    io.route.cross_track_m,
                    io.route.remaining_m,
                    io.route.path_risk,
                    io.route.stuck_steps,
                )
            ):
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
    """Path-relative terms of the awake rows, from the foot that ``fire_triggers`` moved or from the start of
    a route planned since."""
    n = ti.static(io.clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and io.clock.awake[env] == 1:
            if io.route.want_plan[env] == 1:  # else ``fire_triggers`` has just looked along the same route
                _look_again(env, io)
            if io.route.n_way[env] > 0:
                _aim(env, io)
            else:
                _hover(env, io)


@ti.func
def _look_again(env, io: Bundle[RouteIO]):
    """What lies ahead on a route planned since, and its mean risk."""
    look_along(io.route, env, level(io.ego.pos_w[env]), io.route_cfg, io.mapping_cfg)
    risk = 0.0
    for k in range(io.route.n_ahead[env]):
        cell = cell_on_grid(io.route.ahead_w[env, k], io.clearance, io.tank_cfg, io.mapping_cfg)
        risk += risk_at(env, cell, io.clearance, io.grid_map, io.clearance_cfg)
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
            cell = cell_on_grid(a + along * ((k + 0.5) / pieces), io.clearance, io.tank_cfg, io.mapping_cfg)
            room = ti.max(
                io.clearance.clearance_m[env, cell[0], cell[1]], ti.static(io.voronoi_cfg.cost_epsilon_m)
            )
            cost += along.norm() / pieces / room
    return cost


@ti.kernel
def keep_route(io: Bundle[RouteIO], env: int):
    """Both planners failed: the last valid route stays (or none), and that is counted."""
    io.route.kept[env] += 1
