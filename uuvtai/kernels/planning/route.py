"""The route from the vehicle's view: look-ahead point, heading and cross-track error, length left, risk of what lies ahead."""

import taichi as ti

from uuvtai.config import ClearanceConfig, MappingConfig, RouteConfig, TankConfig, VoronoiConfig
from uuvtai.kernels.core.geometry import wrapped_angle
from uuvtai.kernels.core.grid import cell_of
from uuvtai.kernels.core.signature import Const, In, Out, quick_launch, spread
from uuvtai.kernels.planning.along import foot_of, left_of_foot, level, look_along, point_left, segment_of
from uuvtai.kernels.planning.polyline import MAX_WIDENINGS, WIDENING, count_after_segment, install_route
from uuvtai.plan_codes import (
    N_PLANNER,
    N_REASON,
    N_TRIGGER,
    PLANNER_RRT,
)
from uuvtai.state import ClearanceState, ClockState, MapState, MissionState, Proprioception, RouteState

_LONG_AGO = -(1 << 20)
"""Step at which no trigger has been served yet."""


@quick_launch
@ti.kernel
def reset_route(route: Out[RouteState], clock: In[ClockState]):
    """No route, no history, in the awake rows."""
    n = ti.static(clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and clock.awake[env] == 1:
            for field in ti.static(
                (
                    route.n_way,
                    route.cost,
                    route.planner,
                    route.trigger,
                    route.fired,
                    route.want_plan,
                    route.fallback_reason,
                    route.plan_step,
                    route.kept,
                    route.second_passes,
                    route.n_ahead,
                    route.arc,
                    route.heading_error,
                    route.cross_track_m,
                    route.remaining_m,
                    route.path_risk,
                    route.stuck_steps,
                )
            ):
                field[env] = 0
            route.lookahead_w[env] = ti.Vector([0.0, 0.0, 0.0])
            for i in range(route.way_w.shape[1]):
                route.way_w[env, i] = ti.Vector([0.0, 0.0])
                route.way_left_m[env, i] = 0.0
            for i in range(route.ahead_w.shape[1]):
                route.ahead_w[env, i] = ti.Vector([0.0, 0.0])
            for i in range(N_TRIGGER):
                route.replans[env, i] = 0
                route.served_step[env, i] = _LONG_AGO
            for i in range(N_PLANNER):
                route.planned_by[env, i] = 0
            for i in range(N_REASON):
                route.fallbacks[env, i] = 0


@quick_launch
@ti.kernel
def follow_route(
    route: Out[RouteState],
    clearance: In[ClearanceState],
    grid_map: In[MapState],
    ego: In[Proprioception],
    mission: In[MissionState],
    clock: In[ClockState],
    cfg: Const[RouteConfig],
    clearance_cfg: Const[ClearanceConfig],
    mapping_cfg: Const[MappingConfig],
    tank_cfg: Const[TankConfig],
):
    """Path-relative terms of the awake rows, from the foot that ``fire_triggers`` moved or from the start of a route planned since."""
    n = ti.static(clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and clock.awake[env] == 1:
            look_along(route, env, level(ego.pos_w[env]), cfg, mapping_cfg)
            if route.n_way[env] > 0:
                _aim(env, route, ego, mission, cfg)
            else:
                _hover(env, route, ego, mission)
            risk = 0.0
            for k in range(route.n_ahead[env]):
                risk += _risk(env, route.ahead_w[env, k], clearance, grid_map, clearance_cfg, mapping_cfg, tank_cfg)
            route.path_risk[env] = risk / route.n_ahead[env]


@ti.func
def _aim(env, route: Out[RouteState], ego: In[Proprioception], mission: In[MissionState], cfg: Const[RouteConfig]):
    """Look-ahead point and errors against the route. The depth runs straight from the present one to the goal's over the length left,
    so that it arrives in time from wherever an evasion has left the vehicle."""
    pos, goal, arc = ego.pos_w[env], mission.goal_w[env], route.arc[env]
    i = segment_of(route, env, arc)
    left = left_of_foot(route, env)
    point, _i = point_left(route, env, i, left - ti.static(cfg.lookahead_m))
    depth = pos[2] + (goal[2] - pos[2]) * ti.min(1.0, ti.static(cfg.lookahead_m) / ti.max(left, 1e-6))
    route.lookahead_w[env] = ti.Vector([point[0], point[1], depth])
    ahead = point - level(pos)
    route.heading_error[env] = 0.0
    if ahead.norm_sqr() > 1e-12:
        route.heading_error[env] = wrapped_angle(ti.atan2(ahead[1], ahead[0]) - ego.rpy[env][2])
    along = route.way_w[env, i + 1] - route.way_w[env, i]
    off = level(pos) - foot_of(route, env, arc)
    route.cross_track_m[env] = ti.select(along[0] * off[1] - along[1] * off[0] >= 0, off.norm(), -off.norm())
    route.remaining_m[env] = left


@ti.func
def _hover(env, route: Out[RouteState], ego: In[Proprioception], mission: In[MissionState]):
    """Without a route: steer at one's own place; what is left is the straight distance."""
    route.lookahead_w[env] = ego.pos_w[env]
    route.heading_error[env] = 0.0
    route.cross_track_m[env] = 0.0
    route.remaining_m[env] = level(mission.goal_w[env] - ego.pos_w[env]).norm()


@ti.func
def _cell_on_grid(pos_w, clearance: In[ClearanceState], mapping_cfg: Const[MappingConfig], tank_cfg: Const[TankConfig]):
    """(row, col), off-grid positions held at the edge."""
    cell = cell_of(pos_w, tank_cfg, mapping_cfg.cell_m)
    n_row, n_col = ti.static(clearance.clearance_m.shape[1:])
    return ti.Vector([ti.math.clamp(cell[0], 0, n_row - 1), ti.math.clamp(cell[1], 0, n_col - 1)])


@ti.func
def _risk(
    env,
    pos_w,
    clearance: In[ClearanceState],
    grid_map: In[MapState],
    cfg: Const[ClearanceConfig],
    mapping_cfg: Const[MappingConfig],
    tank_cfg: Const[TankConfig],
):
    """The paper's risk R: alpha_m M^s + alpha_d M^d + alpha_delta / (clearance + eps)."""
    cell = _cell_on_grid(pos_w, clearance, mapping_cfg, tank_cfg)
    occupied = ti.static(cfg.risk_static) * grid_map.static_occ[env, cell[0], cell[1]]
    moving = ti.static(cfg.risk_dynamic) * grid_map.dynamic_occ[env, cell[0], cell[1]]
    room = clearance.clearance_m[env, cell[0], cell[1]] + ti.static(cfg.risk_epsilon_m)
    return occupied + moving + ti.static(cfg.risk_clearance) / room


@ti.kernel
def load_route(
    route: Out[RouteState],
    clearance: In[ClearanceState],
    clock: In[ClockState],
    way_w: ti.types.ndarray(dtype=ti.f32, ndim=2),  # type: ignore[valid-type]
    env: int,
    cfg: Const[RouteConfig],
    voronoi_cfg: Const[VoronoiConfig],
    mapping_cfg: Const[MappingConfig],
    tank_cfg: Const[TankConfig],
):
    """Take the host's path (n >= 2 corners, (n, 2) [m]) as the env's route, spaced and counted like the kernel's own, planner RRT."""
    for _ in range(1):
        spacing, writing, tries, room = ti.static(cfg.spacing_m) * 1.0, 0, 0, ti.static(route.way_w.shape[1])
        while tries < MAX_WIDENINGS:
            count = 1
            for i in range(1, way_w.shape[0]):
                a, b = ti.Vector([way_w[i - 1, 0], way_w[i - 1, 1]]), ti.Vector([way_w[i, 0], way_w[i, 1]])
                if writing == 1 and i == 1:
                    route.way_w[env, 0] = a
                count = count_after_segment(route, env, count, a, b, spacing, writing)
            tries += 1
            if writing == 1:
                cost = _route_cost(env, count, route, clearance, voronoi_cfg, mapping_cfg, tank_cfg)
                install_route(route, clock, env, count, cost, PLANNER_RRT)
                tries = MAX_WIDENINGS
            elif count <= room:
                writing = 1
            else:
                spacing *= WIDENING


@ti.func
def _route_cost(
    env,
    n_way,
    route: In[RouteState],
    clearance: In[ClearanceState],
    voronoi_cfg: Const[VoronoiConfig],
    mapping_cfg: Const[MappingConfig],
    tank_cfg: Const[TankConfig],
):
    """Integral of 1 / max(clearance, eps) along the waypoints, in pieces of at most half a cell."""
    cost = 0.0
    for i in range(n_way - 1):
        a, along = route.way_w[env, i], route.way_w[env, i + 1] - route.way_w[env, i]
        pieces = ti.cast(ti.ceil(along.norm() / ti.static(0.5 * mapping_cfg.cell_m)), ti.i32)
        for k in range(pieces):  # type: ignore[arg-type]
            cell = _cell_on_grid(a + along * ((k + 0.5) / pieces), clearance, mapping_cfg, tank_cfg)
            room = ti.max(clearance.clearance_m[env, cell[0], cell[1]], ti.static(voronoi_cfg.cost_epsilon_m))
            cost += along.norm() / pieces / room
    return cost


@ti.kernel
def keep_route(route: Out[RouteState], env: int):
    """Both planners failed: the last valid route stays (or none), and that is counted."""
    route.kept[env] += 1
