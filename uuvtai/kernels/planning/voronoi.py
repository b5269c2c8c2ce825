"""Global planner: the cheapest way along the medial axis of the traversable set, straightened, for the envs whose turn it is.

Cost (the paper, Sec. III-B): sum |dp| / max(clearance, eps_r), with every segment bounded by the map's cell. Should the skeleton not join
start and goal though the traversable set does, a second pass searches all traversable cells (counted). Only where that fails too, or an
end of the way is not traversable, the plan fails with a reason, and the host's RRT takes over.
"""

import taichi as ti

from uuvtai.config import ClearanceConfig, MappingConfig, RouteConfig, TankConfig, VoronoiConfig
from uuvtai.kernels.core.grid import centre_of, grid_origin
from uuvtai.kernels.core.signature import Const, In, Out, quick_launch, spread
from uuvtai.kernels.planning.chord import count_of_waypoints, path_cells, straightened_cost
from uuvtai.kernels.planning.medial import FOUND, NOT_FOUND, join_skeleton, search_cells
from uuvtai.kernels.planning.polyline import MAX_WIDENINGS, WIDENING, install_route
from uuvtai.kernels.planning.traversable import is_traversable, occupancy
from uuvtai.plan_codes import (
    FAIL_BUDGET,
    FAIL_DISCONNECTED,
    FAIL_FORECAST,
    FAIL_GOAL_OUTSIDE,
    FAIL_NONE,
    FAIL_START_OUTSIDE,
    PLANNER_VORONOI,
)
from uuvtai.state import (
    ClearanceState,
    ClockState,
    ForecastState,
    GridMask,
    MapState,
    MissionState,
    Proprioception,
    RouteState,
    VoronoiState,
)


@quick_launch
@ti.kernel
def plan_routes(
    voronoi: Out[VoronoiState],
    route: Out[RouteState],
    clearance: In[ClearanceState],
    grid_map: In[MapState],
    mask: In[GridMask],
    mission: In[MissionState],
    ego: In[Proprioception],
    forecast: In[ForecastState],
    clock: In[ClockState],
    cfg: Const[VoronoiConfig],
    route_cfg: Const[RouteConfig],
    clearance_cfg: Const[ClearanceConfig],
    mapping_cfg: Const[MappingConfig],
    tank_cfg: Const[TankConfig],
):
    """Plan for the queued envs; those for which it fails are listed in ``route.failed`` and keep their old route."""
    n = ti.static(voronoi.cost.shape[0])
    for slot, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0:
            item = slot
            while item < route.n_queue[None]:
                env = route.queue[item]
                start_w = ti.cast(ti.Vector([ego.pos_w[env][0], ego.pos_w[env][1]]), ti.f32)
                goal_w = ti.cast(ti.Vector([mission.goal_w[env][0], mission.goal_w[env][1]]), ti.f32)
                _weigh_cells(voronoi, clearance, grid_map, mask, slot, env, cfg, mapping_cfg)
                reason = _endpoint_reason(voronoi, slot, start_w, goal_w, tank_cfg, mapping_cfg)
                voronoi.pops[env] = 0
                if reason == FAIL_NONE:
                    if ti.static(cfg.avoid_forecast):
                        _block_forecast(voronoi, forecast, slot, env, start_w, cfg, tank_cfg, mapping_cfg)
                    start, goal = _cell(start_w, tank_cfg, mapping_cfg), _cell(goal_w, tank_cfg, mapping_cfg)
                    reason = _search_reason(
                        voronoi, route, clearance, grid_map, mask, slot, env, start, goal, cfg, clearance_cfg, mapping_cfg
                    )
                if reason == FAIL_NONE:
                    reason = _write_reason(voronoi, route, clock, slot, env, start_w, goal_w, route_cfg, tank_cfg, mapping_cfg)
                route.fallback_reason[env] = reason
                if reason != FAIL_NONE:
                    route.fallbacks[env, reason - 1] += 1
                item += n
    for _ in range(1):
        count = 0
        for item in range(route.n_queue[None]):
            if route.fallback_reason[route.queue[item]] != FAIL_NONE:
                route.failed[count] = route.queue[item]
                count += 1
        route.n_failed[None] = count


@ti.func
def _grid_position(pos_w, tank_cfg: Const[TankConfig], mapping_cfg: Const[MappingConfig]):
    """(x, y) in cells from the grid's outer corner."""
    x0, y0 = ti.static(grid_origin(tank_cfg, mapping_cfg.cell_m))
    return (pos_w - ti.Vector([x0, y0], dt=ti.f32)) / ti.static(mapping_cfg.cell_m)


@ti.func
def _cell(pos_w, tank_cfg: Const[TankConfig], mapping_cfg: Const[MappingConfig]):
    """(row, col)."""
    at = _grid_position(pos_w, tank_cfg, mapping_cfg)
    return ti.Vector([ti.cast(ti.floor(at[1]), ti.i32), ti.cast(ti.floor(at[0]), ti.i32)])


@ti.func
def _weigh_cells(
    voronoi: Out[VoronoiState],
    clearance: In[ClearanceState],
    grid_map: In[MapState],
    mask: In[GridMask],
    slot,
    env,
    cfg: Const[VoronoiConfig],
    mapping_cfg: Const[MappingConfig],
):
    """Weight of every cell, and forget the slot's last search."""
    for row in range(voronoi.weight.shape[1]):
        for col in range(voronoi.weight.shape[2]):
            weight = 0.0
            if is_traversable(clearance, grid_map, mask, env, row, col, cfg, mapping_cfg):
                weight = 1.0 / ti.max(clearance.clearance_m[env, row, col], ti.static(cfg.cost_epsilon_m))
            voronoi.weight[slot, row, col] = weight
            voronoi.cell[slot, row, col] = ti.cast(0, ti.u8)


@ti.func
def _endpoint_reason(voronoi: In[VoronoiState], slot, start_w, goal_w, tank_cfg: Const[TankConfig], mapping_cfg: Const[MappingConfig]):
    """FAIL_NONE where both ends are traversable."""
    reason = FAIL_NONE
    if _weight_at(voronoi, slot, _cell(start_w, tank_cfg, mapping_cfg)) <= 0:
        reason = FAIL_START_OUTSIDE
    elif _weight_at(voronoi, slot, _cell(goal_w, tank_cfg, mapping_cfg)) <= 0:
        reason = FAIL_GOAL_OUTSIDE
    return reason


@ti.func
def _weight_at(voronoi: In[VoronoiState], slot, cell):
    """Weight of a cell that may lie off the grid (0 there)."""
    n_row, n_col = ti.static(voronoi.weight.shape[1:])
    weight = ti.cast(0.0, ti.f32)
    if cell[0] >= 0 and cell[0] < n_row and cell[1] >= 0 and cell[1] < n_col:
        weight = voronoi.weight[slot, cell[0], cell[1]]
    return weight


@ti.func
def _block_forecast(
    voronoi: Out[VoronoiState],
    forecast: In[ForecastState],
    slot,
    env,
    start_w,
    cfg: Const[VoronoiConfig],
    tank_cfg: Const[TankConfig],
    mapping_cfg: Const[MappingConfig],
):
    """Close every cell that a moving body is expected to come closer to than d_min within the horizon; the own cell stays open."""
    own = _cell(start_w, tank_cfg, mapping_cfg)
    own_weight = voronoi.weight[slot, own[0], own[1]]
    n_row, n_col = ti.static(voronoi.weight.shape[1:])
    for track in range(forecast.radius_m.shape[1]):
        if forecast.radius_m[env, track, 0] >= 0:  # a track is forecast at all steps or at none
            for k in range(forecast.radius_m.shape[2]):
                pos_w = ti.cast(forecast.pos_w[env, track, k], ti.f32)
                reach = forecast.radius_m[env, track, k] + ti.static(cfg.min_clearance_m)
                low, high = _cell(pos_w - reach, tank_cfg, mapping_cfg), _cell(pos_w + reach, tank_cfg, mapping_cfg)
                for row in range(ti.max(low[0], 0), ti.min(high[0] + 1, n_row)):
                    for col in range(ti.max(low[1], 0), ti.min(high[1] + 1, n_col)):
                        away = centre_of(row, col, tank_cfg, mapping_cfg.cell_m) - pos_w
                        if away.dot(away) < reach**2:  # type: ignore[misc]
                            voronoi.weight[slot, row, col] = 0.0
    voronoi.weight[slot, own[0], own[1]] = own_weight


@ti.func
def _search_reason(
    voronoi: Out[VoronoiState],
    route: Out[RouteState],
    clearance: In[ClearanceState],
    grid_map: In[MapState],
    mask: In[GridMask],
    slot,
    env,
    start,
    goal,
    cfg: Const[VoronoiConfig],
    clearance_cfg: Const[ClearanceConfig],
    mapping_cfg: Const[MappingConfig],
):
    """Search the skeleton, then everything, then (where the forecast was avoided) everything as if nothing moved, to name the reason."""
    status, attempt, attempts, reason = NOT_FOUND, 0, ti.static(3 if cfg.avoid_forecast else 2), FAIL_NONE
    while status == NOT_FOUND and attempt < attempts:
        if attempt == 0:
            join_skeleton(voronoi, clearance, slot, env, start, goal, cfg, clearance_cfg)
        elif attempt == 1:
            route.second_passes[env] += 1
            _forget_search(voronoi, slot)
        else:
            _weigh_cells(voronoi, clearance, grid_map, mask, slot, env, cfg, mapping_cfg)
        status = search_cells(voronoi, clearance, slot, env, start, goal, attempt, cfg, clearance_cfg)
        attempt += 1
    if status == NOT_FOUND:
        reason = FAIL_DISCONNECTED
    elif status != FOUND:
        reason = FAIL_BUDGET
    elif attempt == 3:
        reason = FAIL_FORECAST
    return reason


@ti.func
def _forget_search(voronoi: Out[VoronoiState], slot):
    for row in range(voronoi.cell.shape[1]):
        for col in range(voronoi.cell.shape[2]):
            voronoi.cell[slot, row, col] = ti.cast(0, ti.u8)


@ti.func
def _write_reason(
    voronoi: Out[VoronoiState],
    route: Out[RouteState],
    clock: In[ClockState],
    slot,
    env,
    start_w,
    goal_w,
    route_cfg: Const[RouteConfig],
    tank_cfg: Const[TankConfig],
    mapping_cfg: Const[MappingConfig],
):
    """Turn the search's result into waypoints; FAIL_BUDGET where they do not fit."""
    x0, y0 = ti.static(grid_origin(tank_cfg, mapping_cfg.cell_m))
    origin, cell_m, room = ti.Vector([x0, y0], dt=ti.f32), ti.static(mapping_cfg.cell_m), ti.static(route.way_w.shape[1])
    start_at, goal_at = _grid_position(start_w, tank_cfg, mapping_cfg), _grid_position(goal_w, tank_cfg, mapping_cfg)
    start, goal = _cell(start_w, tank_cfg, mapping_cfg), _cell(goal_w, tank_cfg, mapping_cfg)
    n_cell = path_cells(voronoi, slot, start, goal)
    spacing, writing, tries, reason = ti.cast(ti.static(route_cfg.spacing_m), ti.f32), 0, 0, FAIL_BUDGET
    cost = 0.0
    if n_cell > 0:
        cost = straightened_cost(voronoi, slot, n_cell, start_at, goal_at) * cell_m
    while n_cell > 0 and tries < MAX_WIDENINGS:  # count, widen the spacing until it fits, then write
        count = count_of_waypoints(route, voronoi, slot, env, n_cell, start_at, goal_at, origin, cell_m, spacing, writing)
        tries += 1
        if writing == 1:
            install_route(route, clock, env, count, cost, PLANNER_VORONOI)
            reason, tries = FAIL_NONE, MAX_WIDENINGS
        elif count <= room:
            writing = 1
        else:
            spacing *= WIDENING
    return reason


@ti.kernel
def overlay_clearance(
    clearance: In[ClearanceState],
    grid_map: In[MapState],
    mask: In[GridMask],
    forecast: In[ForecastState],
    out: ti.types.ndarray(dtype=ti.f32, ndim=2),  # type: ignore[valid-type]
    env: int,
    cfg: Const[VoronoiConfig],
    mapping_cfg: Const[MappingConfig],
    tank_cfg: Const[TankConfig],
):
    """Clearance (n_row, n_col) [m] of one env for the host's fallback: 0 where occupied or outside, lowered by the forecast if avoided."""
    for row, col in ti.ndrange(out.shape[0], out.shape[1]):
        room = clearance.clearance_m[env, row, col]
        if occupancy(grid_map, env, row, col, cfg) >= ti.static(mapping_cfg.occupied) or mask.outside[row, col] == 1:
            room = 0.0
        if ti.static(cfg.avoid_forecast):
            centre = centre_of(row, col, tank_cfg, mapping_cfg.cell_m)
            for track in range(forecast.radius_m.shape[1]):
                for k in range(forecast.radius_m.shape[2]):
                    if forecast.radius_m[env, track, k] >= 0:
                        gap = (centre - forecast.pos_w[env, track, k]).norm() - forecast.radius_m[env, track, k]
                        room = ti.max(ti.min(room, gap), 0.0)
        out[row, col] = room
