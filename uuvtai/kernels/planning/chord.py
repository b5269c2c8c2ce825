"""Straightening a path of cells: chords that stay traversable and cost less replace runs of cells.

Positions here are in cells, (col, row) = (x, y) from the grid's outer corner. The cost of a line is the
integral of the weight 1 / max(clearance, eps) of the cells it passes: the paper's sum with every segment
bounded by one cell, so that long hops cannot cheat it.
"""

import taichi as ti

from uuvtai.kernels.core.geometry import FAR_M
from uuvtai.kernels.core.grid import grid_origin
from uuvtai.kernels.core.signature import Bundle
from uuvtai.kernels.planning.bundles import VoronoiIO
from uuvtai.kernels.planning.medial import next_direction, step_of
from uuvtai.kernels.planning.polyline import count_after_segment

STRIDE = 4
"""A chord may begin and end at every fourth cell of the path."""

_CORNER = 0.01
"""[cells] a line that passes a corner of the grid this closely must find both cells beside it traversable."""

_NEVER = 2.0
"""Beyond the end of a line, whose parameter runs from 0 to 1."""

_GAIN = 1.0e-4
"""A chord must not cost more than the cells it replaces, up to this share (rounding on a straight run)."""


@ti.func
def chord_cost(slot, a, b, bound, io: Bundle[VoronoiIO]):
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
def path_cells(slot, start, goal, io: Bundle[VoronoiIO]):
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
def _point(slot, i, n_cell, start_at, goal_at, io: Bundle[VoronoiIO]):
    """Position of the path's i-th cell: its centre, but the ends lie where the vehicle and the goal are."""
    n_col = ti.static(io.voronoi.cost.shape[2])
    cell = io.voronoi.path_cell[slot, i]
    centre = ti.Vector([cell % n_col + 0.5, cell // n_col + 0.5])
    return ti.select(i == 0, start_at, ti.select(i == n_cell - 1, goal_at, centre))


@ti.func
def _cost_to_go(slot, i, io: Bundle[VoronoiIO]):
    n_col = ti.static(io.voronoi.cost.shape[2])
    cell = io.voronoi.path_cell[slot, i]
    return io.voronoi.cost[slot, cell // n_col, cell % n_col]


@ti.func
def _cells_cost(slot, i, j, n_cell, start_at, goal_at, io: Bundle[VoronoiIO]):
    """Cost of going along the cells from path index i to j. At the ends the way to the cell's centre is
    added: an upper bound."""
    cost = _cost_to_go(slot, i, io) - _cost_to_go(slot, j, io)
    if i == 0:
        cost += _detour(slot, start_at, io)
    if j == n_cell - 1:
        cost += _detour(slot, goal_at, io)
    return cost


@ti.func
def _detour(slot, at, io: Bundle[VoronoiIO]):
    row, col = ti.cast(ti.floor(at[1]), ti.i32), ti.cast(ti.floor(at[0]), ti.i32)
    return (at - ti.Vector([col + 0.5, row + 0.5])).norm() * io.voronoi.weight[slot, row, col]


@ti.func
def straightened_cost(slot, n_cell, start_at, goal_at, io: Bundle[VoronoiIO]):
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
def count_of_waypoints(slot, env, n_cell, start_at, goal_at, spacing, write, io: Bundle[VoronoiIO]):
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
