"""Global planner: the cheapest way along the medial axis of the traversable set, straightened, for the envs
whose turn it is.

Cost (the paper, Sec. III-B): sum |dp| / max(clearance, eps_r), with every segment bounded by the map's cell.
Should the skeleton not join start and goal though the traversable set does, a second pass searches all
traversable cells (counted). Only where that fails too, or an end of the way is not traversable, the plan
fails with a reason, and the host's RRT takes over.
"""

import taichi as ti

from uuvtai.common.enums import (
    FAIL_BUDGET,
    FAIL_DISCONNECTED,
    FAIL_GOAL_OUTSIDE,
    FAIL_NONE,
    FAIL_START_OUTSIDE,
    PLANNER_VORONOI,
)
from uuvtai.compile.launch import quick_launch
from uuvtai.kernels.core.grid import clearance_of, grid_origin
from uuvtai.kernels.core.simd import filled, filled_int, n_lane
from uuvtai.kernels.core.stage import Bundle, FloatMatrix, loop_end
from uuvtai.kernels.planning.io import RouteIO
from uuvtai.kernels.planning.medial_axis import (
    FOUND,
    MAX_WIDENINGS,
    NOT_FOUND,
    WIDENING,
    count_of_waypoints,
    install_route,
    is_traversable,
    join_skeleton,
    occupancy,
    path_cells,
    room_at,
    search_cells,
    straightened_cost,
    widest_m,
)


@quick_launch
@ti.kernel
def plan_routes(io: Bundle[RouteIO]):
    """Plan for the queued envs; those for which it fails are listed in ``route.failed`` and keep their old
    route."""
    n = ti.static(io.voronoi.cost.shape[0])
    io.route.n_failed[None] = 0
    for slot in range(loop_end(n, io.clock)):
        item = slot
        while item < io.route.n_queue[None]:
            _plan(slot, io.route.queue[item], io)
            item += n


@ti.func
def _plan(slot, env, io: Bundle[RouteIO]):
    """Plan for one env in a slot of the scratch memory; why it failed is kept and counted."""
    start_w = ti.cast(ti.Vector([io.ego.pos_w[env][0], io.ego.pos_w[env][1]]), ti.f32)
    goal_w = ti.cast(ti.Vector([io.mission.goal_w[env][0], io.mission.goal_w[env][1]]), ti.f32)
    _weigh_cells(slot, env, io)
    reason = _endpoint_reason(slot, start_w, goal_w, io)
    io.voronoi.pops[env] = 0
    if reason == FAIL_NONE:
        start, goal = _cell(start_w, io), _cell(goal_w, io)
        reason = _search_reason(slot, env, start, goal, io)
    if reason == FAIL_NONE:
        reason = _write_reason(slot, env, start_w, goal_w, io)
    io.route.fallback_reason[env] = reason
    if reason != FAIL_NONE:
        io.route.fallbacks[env, reason - 1] += 1
        io.route.failed[ti.atomic_add(io.route.n_failed[None], 1)] = env


@ti.func
def _grid_position(pos_w, io: Bundle[RouteIO]):
    """(x, y) in cells from the grid's outer corner."""
    x0, y0 = ti.static(grid_origin(io.tank_cfg, io.mapping_cfg.cell_m))
    return (pos_w - ti.Vector([x0, y0], dt=ti.f32)) / ti.static(io.mapping_cfg.cell_m)


@ti.func
def _cell(pos_w, io: Bundle[RouteIO]):
    """(row, col)."""
    at = _grid_position(pos_w, io)
    return ti.Vector([ti.cast(ti.floor(at[1]), ti.i32), ti.cast(ti.floor(at[0]), ti.i32)])


@ti.func
def _weigh_cells(slot, env, io: Bundle[RouteIO]):
    """Weight of every cell, and forget the slot's last search."""
    lanes = ti.static(n_lane())
    least = ti.static(io.voronoi_cfg.cost_epsilon_m)
    widest = ti.static(widest_m(io.clearance_cfg, io.quiet_cfg, io.voronoi_cfg))
    for row in range(io.voronoi.weight.shape[1]):
        for packet in range(io.voronoi.weight.shape[2] // lanes):
            first = packet * lanes
            site, is_open = filled_int(0, lanes), filled(0.0, lanes)
            for i in ti.static(range(lanes)):
                site[i] = ti.cast(io.clearance.site[env, row, first + i], ti.i32)
            room = clearance_of(site, io.clearance_cfg, io.mapping_cfg.cell_m)
            for i in ti.static(range(lanes)):
                wide = room[i]  # type: ignore[index]
                if is_traversable(env, row, first + i, wide, io):
                    is_open[i] = 1.0
            narrow = ti.select(room < widest, room, widest)
            weight = 1.0 / ti.select(narrow > least, narrow, least)
            for i in ti.static(range(lanes)):
                value = weight[i]  # type: ignore[index]
                io.voronoi.weight[slot, row, first + i] = ti.select(is_open[i] > 0.0, value, 0.0)
                io.voronoi.cell[slot, row, first + i] = ti.cast(0, ti.u8)


@ti.func
def _endpoint_reason(slot, start_w, goal_w, io: Bundle[RouteIO]):
    """FAIL_NONE where both ends are traversable."""
    reason = FAIL_NONE
    if _weight_at(slot, _cell(start_w, io), io) <= 0:
        reason = FAIL_START_OUTSIDE
    elif _weight_at(slot, _cell(goal_w, io), io) <= 0:
        reason = FAIL_GOAL_OUTSIDE
    return reason


@ti.func
def _weight_at(slot, cell, io: Bundle[RouteIO]):
    """Weight of a cell that may lie off the grid (0 there)."""
    n_row, n_col = ti.static(io.voronoi.weight.shape[1:])
    weight = ti.cast(0.0, ti.f32)
    if cell[0] >= 0 and cell[0] < n_row and cell[1] >= 0 and cell[1] < n_col:
        weight = io.voronoi.weight[slot, cell[0], cell[1]]
    return weight


@ti.func
def _search_reason(slot, env, start, goal, io: Bundle[RouteIO]):
    """Search the skeleton, then everything; why nothing was found."""
    status, attempt, reason = NOT_FOUND, 0, FAIL_NONE
    while status == NOT_FOUND and attempt < 2:
        if attempt == 0:
            join_skeleton(slot, env, start, goal, io)
        else:
            io.route.second_passes[env] += 1
            _forget_search(slot, io)
        status = search_cells(slot, env, start, goal, attempt, io)
        attempt += 1
    if status == NOT_FOUND:
        reason = FAIL_DISCONNECTED
    elif status != FOUND:
        reason = FAIL_BUDGET
    return reason


@ti.func
def _forget_search(slot, io: Bundle[RouteIO]):
    for row in range(io.voronoi.cell.shape[1]):
        for col in range(io.voronoi.cell.shape[2]):
            io.voronoi.cell[slot, row, col] = ti.cast(0, ti.u8)


@ti.func
def _write_reason(slot, env, start_w, goal_w, io: Bundle[RouteIO]):
    """Turn the search's result into waypoints; FAIL_BUDGET where they do not fit."""
    room = ti.static(io.route.way_w.shape[1])
    start_at, goal_at = _grid_position(start_w, io), _grid_position(goal_w, io)
    start, goal = _cell(start_w, io), _cell(goal_w, io)
    n_cell = path_cells(slot, start, goal, io)
    spacing, writing, tries, reason = ti.cast(ti.static(io.route_cfg.spacing_m), ti.f32), 0, 0, FAIL_BUDGET
    cost = 0.0
    if n_cell > 0:
        cost = straightened_cost(slot, n_cell, start_at, goal_at, io) * io.mapping_cfg.cell_m
    while n_cell > 0 and tries < MAX_WIDENINGS:  # count, widen the spacing until it fits, then write
        count = count_of_waypoints(slot, env, n_cell, start_at, goal_at, spacing, writing, io)
        tries += 1
        if writing == 1:
            install_route(io.route, io.clock, env, count, cost, PLANNER_VORONOI)
            reason, tries = FAIL_NONE, MAX_WIDENINGS
        elif count <= room:
            writing = 1
        else:
            spacing *= WIDENING
    return reason


@ti.kernel
def overlay_clearance(io: Bundle[RouteIO], out: FloatMatrix, env: int):
    """Clearance (n_row, n_col) [m] of one env for the host's fallback: 0 where occupied or outside."""
    for row, col in ti.ndrange(out.shape[0], out.shape[1]):
        room = room_at(env, row, col, io)
        if (
            occupancy(env, row, col, io) >= ti.static(io.mapping_cfg.occupied)
            or io.mask.outside[row, col] == 1
        ):
            room = 0.0
        out[row, col] = room
