"""The medial axis as a graph: which cells are on it, and the cheapest way along it (A* with a binary heap).

A cell is on the skeleton when the nearest site of a neighbour is more than ``site_gap_cells`` away from its
own, never by which obstacle the sites belong to: walls with baffles are one obstacle, yet have a medial axis.
Cells farther than clearance.max_m from everything form plateaus that belong to the skeleton. Neighbours are
the eight around a cell; a diagonal step needs both cells beside it (no corner is cut).
"""

import taichi as ti

from uuvtai.common.enums import NO_SITE
from uuvtai.kernels.core.geometry import FAR_M
from uuvtai.kernels.core.grid import (
    away_of,
    clearance_of,
    grid_origin,
    heap_after_pop,
    heap_after_push,
    occupancy_of,
    top_cell,
)
from uuvtai.kernels.core.stage import Bundle, In, Out
from uuvtai.kernels.planning.io import RouteIO
from uuvtai.state import ClockState, RouteState

# bits of VoronoiState.cell; bits 4 to 6 hold the direction of the next cell towards the goal
KNOWN = 1
SKELETON = 2
REACHED = 4
JOINED = 8
"""off the skeleton, but on a way from the start or the goal to it"""
CLOSED = 128
"""taken from the heap: its cost is final (the stretched estimate could reopen cells again and again)"""
_NEXT_SHIFT = 4

FOUND = 1
NOT_FOUND = 0
OUT_OF_BUDGET = -1

_STRETCH = 1.02
"""The estimate is stretched by this, so that of the many nearly equal ways over open water few are followed
up (cost at most + 2 %)."""

_BETTER = 1.0 - 1.0e-6
"""A way must be cheaper by more than rounding to replace another: equal ways would fill the heap."""

_FLAT_M = 1.0e-4  # Clearances within this of clearance.max_m are saturated.


def widest_m(clearance, quiet, voronoi):
    """[m] clearance beyond which more is worth nothing to the planner; plain Python."""
    return max(min(clearance.max_m, quiet.room_m), voronoi.cost_epsilon_m)


@ti.func
def step_of(direction):
    """(row, col) step of direction 0..7; the opposite of d is 7 - d."""
    place = direction + ti.cast(direction >= 4, ti.i32)
    return ti.Vector([place // 3 - 1, place % 3 - 1])


@ti.func
def bits_at(slot, row, col, io: Bundle[RouteIO]):
    return ti.cast(io.voronoi.cell[slot, row, col], ti.i32)


@ti.func
def next_direction(slot, row, col, io: Bundle[RouteIO]):
    """Direction of the next cell towards the goal."""
    return bits_at(slot, row, col, io) >> _NEXT_SHIFT & 7


@ti.func
def on_skeleton(slot, env, row, col, io: Bundle[RouteIO]):
    """True for skeleton cells; found out once per plan and kept. The cell must be traversable (so it is not
    at the grid's edge)."""
    bits = bits_at(slot, row, col, io)
    if bits & KNOWN == 0:
        bits |= KNOWN
        if _is_medial(env, row, col, io):
            bits |= SKELETON
        io.voronoi.cell[slot, row, col] = ti.cast(bits, ti.u8)
    return bits & SKELETON != 0


@ti.func
def _is_medial(env, row, col, io: Bundle[RouteIO]):
    """True on a plateau and where a neighbour's nearest site is far from the own one."""
    # The integer medial axis (Hesselink and Roerdink 2008, IEEE PAMI 30): where the nearest site jumps by
    # more than a threshold from one cell to the next, the two cells lie on either side of the axis.
    site = io.clearance.site[env, row, col]
    rows, cols = away_of(site)
    medial = clearance_of(site, io.clearance_cfg, io.mapping_cfg.cell_m) >= ti.static(
        widest_m(io.clearance_cfg, io.quiet_cfg, io.voronoi_cfg) - _FLAT_M
    )
    for k in range(4):
        step = step_of(ti.select(k < 2, 1 + 2 * k, 2 * k))  # the four sides: 1, 3, 4, 6
        other = io.clearance.site[env, row + step[0], col + step[1]]
        other_rows, other_cols = away_of(other)
        gap = ti.cast((step[0] + other_rows - rows) ** 2 + (step[1] + other_cols - cols) ** 2, ti.f32)
        if ti.max(site, other) < NO_SITE and gap > ti.static(io.voronoi_cfg.site_gap_cells**2):
            medial = True
    return medial


@ti.func
def _step_is_open(slot, row, col, step, io: Bundle[RouteIO]):
    """True where a step may be made: the cell is traversable, and so are both beside a diagonal step."""
    is_open = io.voronoi.weight[slot, row + step[0], col + step[1]] > 0
    if step[0] != 0 and step[1] != 0:
        is_open = (
            is_open
            and io.voronoi.weight[slot, row + step[0], col] > 0
            and io.voronoi.weight[slot, row, col + step[1]] > 0
        )
    return is_open


@ti.func
def join_skeleton(slot, env, start, goal, io: Bundle[RouteIO]):
    """Join both ends to the skeleton: one way uphill in clearance, and eight straight ways, so that the
    search chooses the side."""
    for joint in range(18):
        way = joint % 9
        row, col = ti.select(joint < 9, start[0], goal[0]), ti.select(joint < 9, start[1], goal[1])
        walking = True
        while walking:
            io.voronoi.cell[slot, row, col] = ti.cast(bits_at(slot, row, col, io) | JOINED, ti.u8)
            direction = way
            if way == 8:
                direction = _uphill(slot, env, row, col, io)
            walking = direction >= 0
            if walking:
                step = step_of(direction)
                walking = _step_is_open(slot, row, col, step, io)
                row += step[0]
                col += step[1]
                if walking:
                    walking = not on_skeleton(slot, env, row, col, io)


@ti.func
def _uphill(slot, env, row, col, io: Bundle[RouteIO]):
    """Direction of the open neighbour with the largest clearance, -1 on a summit."""
    best, best_m = -1, room_at(env, row, col, io)
    for k in range(8):
        step = step_of(k)
        higher = room_at(env, row + step[0], col + step[1], io)
        if higher > best_m and _step_is_open(slot, row, col, step, io):
            best, best_m = k, higher
    return best


@ti.func
def _estimate(cost, row, col, start_row, start_col, floor_weight):
    """Cost-to-go plus the least cost from the start: octile distance through the widest water."""
    d_row, d_col = ti.abs(row - start_row), ti.abs(col - start_col)
    octile = ti.max(d_row, d_col) + 0.41421356 * ti.min(d_row, d_col)
    return ti.cast(cost + floor_weight * octile, ti.f32)


@ti.func
def search_cells(slot, env, start, goal, everywhere, io: Bundle[RouteIO]):
    """Cheapest way from the goal back to the start (so that the next cell leads to the goal), along the
    skeleton or ``everywhere``.

    An edge costs its length times the mean weight of its two cells [cells / m]: the paper's sum with segments
    bounded by the cells. Returns FOUND, NOT_FOUND or OUT_OF_BUDGET.
    """
    n_col = ti.static(io.voronoi.cost.shape[2])
    floor_weight = ti.static(_STRETCH / widest_m(io.clearance_cfg, io.quiet_cfg, io.voronoi_cfg))
    # A* with the estimate stretched by w = _STRETCH (Pohl 1970): what it finds costs at most w times the
    # least.
    size, status, budget = 0, NOT_FOUND, io.voronoi.pops[env] + ti.static(io.voronoi_cfg.max_pops)
    if io.voronoi.weight[slot, goal[0], goal[1]] > 0:
        io.voronoi.cost[slot, goal[0], goal[1]] = 0.0
        io.voronoi.cell[slot, goal[0], goal[1]] = ti.cast(
            bits_at(slot, goal[0], goal[1], io) | REACHED, ti.u8
        )
        key = _estimate(0.0, goal[0], goal[1], start[0], start[1], floor_weight)
        size = heap_after_push(io.voronoi, slot, size, goal[0] * n_col + goal[1], key)
    while size > 0 and status == NOT_FOUND:
        top = top_cell(io.voronoi, slot)
        row, col = top // n_col, top % n_col
        size = heap_after_pop(io.voronoi, slot, size)
        if row == start[0] and col == start[1]:
            status = FOUND
        elif io.voronoi.pops[env] > budget or size + 8 > ti.static(io.voronoi.heap.shape[1]):
            status = OUT_OF_BUDGET
        elif bits_at(slot, row, col, io) & CLOSED == 0:
            io.voronoi.cell[slot, row, col] = ti.cast(bits_at(slot, row, col, io) | CLOSED, ti.u8)
            io.voronoi.pops[env] += 1
            size = _size_after_expansion(slot, env, size, row, col, start, everywhere, floor_weight, io)
    return status


@ti.func
def _size_after_expansion(slot, env, size, row, col, start, everywhere, floor_weight, io: Bundle[RouteIO]):
    """Offer a cell to its eight neighbours as their next; returns the heap's new size."""
    n_col = ti.static(io.voronoi.cost.shape[2])
    here, weight = io.voronoi.cost[slot, row, col], io.voronoi.weight[slot, row, col]
    new_size = size
    for k in range(8):
        # The integral of the weight along the edge by the trapezoid rule: length x mean of both weights. Off
        # the skeleton a cell counts only on a way that joins an end to it, or where everywhere is searched.
        step = step_of(k)
        to_row, to_col = row + step[0], col + step[1]
        known = bits_at(slot, to_row, to_col, io)
        if known & CLOSED == 0 and (known & KNOWN == 0 or everywhere > 0 or known & (SKELETON | JOINED) != 0):
            if _step_is_open(slot, row, col, step, io):
                medial = on_skeleton(slot, env, to_row, to_col, io)
                bits = bits_at(slot, to_row, to_col, io)
                length = ti.select(step[0] != 0 and step[1] != 0, 1.41421356, 1.0)
                offer = ti.cast(
                    here + 0.5 * length * (weight + io.voronoi.weight[slot, to_row, to_col]), ti.f32
                )
                better = bits & REACHED == 0 or offer < _BETTER * io.voronoi.cost[slot, to_row, to_col]
                if better and (everywhere > 0 or medial or bits & JOINED != 0):
                    io.voronoi.cost[slot, to_row, to_col] = offer
                    kept = bits & (KNOWN | SKELETON | JOINED)
                    io.voronoi.cell[slot, to_row, to_col] = ti.cast(
                        kept | REACHED | ((7 - k) << _NEXT_SHIFT), ti.u8
                    )
                    key = _estimate(offer, to_row, to_col, start[0], start[1], floor_weight)
                    new_size = heap_after_push(io.voronoi, slot, new_size, to_row * n_col + to_col, key)
    return new_size


# ------------------------------------------------------------------------------------------------------------
# The traversable set: cells that are not occupied, lie inside the tank and keep d_min (the paper's Omega).


_SLACK_M = 1.0e-5
"""A cell exactly d_min away counts; rounding of the root must not decide. Distances on the grid differ by far
more than this."""


@ti.func
def occupancy(env, row, col, io: Bundle[RouteIO]):
    """Occupancy in [0, 1] of the layer that routes avoid."""
    value = io.grid_map.static_occ[env, row, col]
    if ti.static(io.voronoi_cfg.use == "fused"):
        value = ti.max(value, io.grid_map.dynamic_occ[env, row, col])
    return occupancy_of(value)


@ti.func
def room_at(env, row, col, io: Bundle[RouteIO]):
    """Clearance of a cell [m]."""
    return clearance_of(io.clearance.site[env, row, col], io.clearance_cfg, io.mapping_cfg.cell_m)


@ti.func
def is_traversable(env, row, col, room, io: Bundle[RouteIO]):
    """True where a route may pass: a cell with its clearance. The map may be newer, so both are asked."""
    wide = room >= ti.static(io.voronoi_cfg.min_clearance_m - _SLACK_M)
    free = occupancy(env, row, col, io) < ti.static(io.mapping_cfg.occupied)
    return wide & free & (io.mask.outside[row, col] == 0)


# ------------------------------------------------------------------------------------------------------------
# Writing a polyline into the route: waypoints at most a spacing apart, every corner kept, so that the
# geometry never changes.


_ROUNDING = 1.0e-4  # A segment longer than the spacing by less than this share is not cut in two.

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


# ------------------------------------------------------------------------------------------------------------
# Straightening a path of cells: chords that stay traversable and cost less replace runs of cells.
#
# Positions here are in cells, (col, row) = (x, y) from the grid's outer corner. The cost of a line is the
# integral of the weight 1 / max(clearance, eps) of the cells it passes: the paper's sum with every segment
# bounded by one cell, so that long hops cannot cheat it.


STRIDE = 4
"""A chord may begin and end at every fourth cell of the path."""

_CORNER = 0.01
"""[cells] a line that passes a corner of the grid this closely must find both cells beside it traversable."""

_NEVER = 2.0  # Beyond the end of a line, whose parameter runs from 0 to 1.

_GAIN = 1.0e-4
"""A chord must not cost more than the cells it replaces, up to this share (rounding on a straight run)."""


@ti.func
def chord_cost(slot, a, b, bound, io: Bundle[RouteIO]):
    """Cost [cells / m] of the straight line a to b, cell by cell; FAR_M where it leaves the traversable cells
    or exceeds ``bound``."""
    # Cell by cell along a line (Amanatides and Woo 1987, A fast voxel traversal algorithm): ``to_col``,
    # ``to_row`` are the parameters of the line, 0 at a and 1 at b, at the next border of a column and of a
    # row, ``per_col``, ``per_row`` from one border to the next. The nearer border is crossed; the part before
    # it costs length x weight.
    along = b - a
    length = along.norm()
    row, col = ti.cast(ti.floor(a[1]), ti.i32), ti.cast(ti.floor(a[0]), ti.i32)
    end_row, end_col = ti.cast(ti.floor(b[1]), ti.i32), ti.cast(ti.floor(b[0]), ti.i32)
    step_row, step_col = ti.select(along[1] > 0, 1, -1), ti.select(along[0] > 0, 1, -1)
    per_col, per_row, to_col, to_row = _NEVER, _NEVER, _NEVER, _NEVER
    if ti.abs(along[0]) > 1e-9:
        per_col = 1.0 / ti.abs(along[0])
        to_col = ti.select(step_col > 0, col + 1.0 - a[0], a[0] - col) * per_col
    if ti.abs(along[1]) > 1e-9:
        per_row = 1.0 / ti.abs(along[1])
        to_row = ti.select(step_row > 0, row + 1.0 - a[1], a[1] - row) * per_row
    near_corner = _CORNER / ti.max(length, 1e-9)
    cost, at, open_cells = 0.0, 0.0, 1
    weight = io.voronoi.weight[slot, row, col]
    walking = ti.cast(weight > 0, ti.i32)
    open_cells = walking
    while walking == 1:
        to = ti.min(ti.min(to_col, to_row), 1.0)
        cost += (to - at) * length * weight
        at = to
        if to >= 1.0 or (row == end_row and col == end_col):
            cost += (1.0 - at) * length * weight
            walking = 0
        else:
            at_corner = ti.abs(to_col - to_row) < near_corner
            if at_corner and (
                io.voronoi.weight[slot, row + step_row, col] <= 0
                or io.voronoi.weight[slot, row, col + step_col] <= 0
            ):
                open_cells = 0
            if to_col <= to_row:
                col += step_col
                to_col += per_col
            else:
                row += step_row
                to_row += per_row
            weight = io.voronoi.weight[slot, row, col]
            if weight <= 0:
                open_cells = 0
            if open_cells == 0 or cost > bound:
                walking = 0
    return ti.select(open_cells == 1 and cost <= bound, cost, FAR_M)


@ti.func
def path_cells(slot, start, goal, io: Bundle[RouteIO]):
    """Write the cells from start to goal; returns how many (at least 2: both ends may be the same cell), 0
    where they do not fit."""
    n_col, room = ti.static(io.voronoi.cost.shape[2], io.voronoi.path_cell.shape[1])
    row, col = start[0], start[1]
    io.voronoi.path_cell[slot, 0] = row * n_col + col
    count = 1
    while (row != goal[0] or col != goal[1]) and count < room:
        step = step_of(next_direction(slot, row, col, io))
        row += step[0]
        col += step[1]
        io.voronoi.path_cell[slot, count] = row * n_col + col
        count += 1
    if row != goal[0] or col != goal[1]:
        count = 0
    elif count == 1:
        io.voronoi.path_cell[slot, 1] = row * n_col + col
        count = 2
    return count


@ti.func
def _point(slot, i, n_cell, start_at, goal_at, io: Bundle[RouteIO]):
    """Position of the path's i-th cell: its centre, but the ends lie where the vehicle and the goal are."""
    n_col = ti.static(io.voronoi.cost.shape[2])
    cell = io.voronoi.path_cell[slot, i]
    centre = ti.Vector([cell % n_col + 0.5, cell // n_col + 0.5])
    return ti.select(i == 0, start_at, ti.select(i == n_cell - 1, goal_at, centre))


@ti.func
def _cost_to_go(slot, i, io: Bundle[RouteIO]):
    n_col = ti.static(io.voronoi.cost.shape[2])
    cell = io.voronoi.path_cell[slot, i]
    return io.voronoi.cost[slot, cell // n_col, cell % n_col]


@ti.func
def _cells_cost(slot, i, j, n_cell, start_at, goal_at, io: Bundle[RouteIO]):
    """Cost of going along the cells from path index i to j. At the ends the way to the cell's centre is
    added: an upper bound."""
    cost = _cost_to_go(slot, i, io) - _cost_to_go(slot, j, io)
    if i == 0:
        cost += _detour(slot, start_at, io)
    if j == n_cell - 1:
        cost += _detour(slot, goal_at, io)
    return cost


@ti.func
def _detour(slot, at, io: Bundle[RouteIO]):
    row, col = ti.cast(ti.floor(at[1]), ti.i32), ti.cast(ti.floor(at[0]), ti.i32)
    return (at - ti.Vector([col + 0.5, row + 0.5])).norm() * io.voronoi.weight[slot, row, col]


@ti.func
def straightened_cost(slot, n_cell, start_at, goal_at, io: Bundle[RouteIO]):
    """Choose for every node of the path (every fourth cell) the best continuation by dynamic programming from
    the goal; total cost."""
    # Backwards from the goal: J(n) = min over spans s of cost(n, n + s) + J(n + s), where s = 0 stands for
    # the cells up to the next node. Only spans 1, 2, 4, ... and the whole rest are tried: n log n lines, not
    # n^2.
    last = (n_cell - 2) // STRIDE + 1
    io.voronoi.node_cost[slot, last] = 0.0
    for back in range(last):
        node = last - 1 - back
        i = node * STRIDE
        here = _point(slot, i, n_cell, start_at, goal_at, io)
        j = ti.min(i + STRIDE, n_cell - 1)
        best = (1.0 + _GAIN) * _cells_cost(slot, i, j, n_cell, start_at, goal_at, io) + io.voronoi.node_cost[
            slot, node + 1
        ]
        chosen, span = 0, 1
        while span > 0:
            k = ti.min((node + span) * STRIDE, n_cell - 1)
            there = _point(slot, k, n_cell, start_at, goal_at, io)
            rest = io.voronoi.node_cost[slot, node + span]
            total = rest + chord_cost(slot, here, there, best - rest, io)
            if total <= best:
                best, chosen = total, span
            span = _next_span(span, last - node)
        io.voronoi.node_cost[slot, node] = best
        io.voronoi.node_next[slot, node] = chosen
    return io.voronoi.node_cost[slot, 0]


@ti.func
def _next_span(span, longest):
    """1, 2, 4, 8, ... and last of all the whole rest; 0 = no more."""
    doubled = ti.min(2 * span, longest)
    return ti.select(span == longest, 0, doubled)


@ti.func
def count_of_waypoints(slot, env, n_cell, start_at, goal_at, spacing, write, io: Bundle[RouteIO]):
    """Go along the chosen chords and cells; returns the number of waypoints, and writes them where ``write``
    is 1."""
    x0, y0 = ti.static(grid_origin(io.tank_cfg, io.mapping_cfg.cell_m))
    origin, cell_m = ti.Vector([x0, y0], dt=ti.f32), ti.static(io.mapping_cfg.cell_m)
    last = (n_cell - 2) // STRIDE + 1
    at = origin + start_at * cell_m
    if write == 1:
        io.route.way_w[env, 0] = at
    count, node = 1, 0
    while node < last:
        span = io.voronoi.node_next[slot, node]
        i = node * STRIDE
        j = ti.min((node + ti.max(span, 1)) * STRIDE, n_cell - 1)
        i = ti.select(span > 0, j - 1, i)  # a chord goes to its end at once, otherwise cell by cell
        while i < j:
            i += 1
            to = origin + _point(slot, i, n_cell, start_at, goal_at, io) * cell_m
            count = count_after_segment(io.route, env, count, at, to, spacing, write)
            at = to
        node += ti.max(span, 1)
    return count
