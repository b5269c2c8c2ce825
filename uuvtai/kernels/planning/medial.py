"""The medial axis as a graph: which cells are on it, and the cheapest way along it (A* with a binary heap).

A cell is on the skeleton when the nearest site of a neighbour is more than ``site_gap_cells`` away from its
own, never by which obstacle the sites belong to: walls with baffles are one obstacle, yet have a medial axis.
Cells farther than clearance.max_m from everything form plateaus that belong to the skeleton. Neighbours are
the eight around a cell; a diagonal step needs both cells beside it (no corner is cut).
"""

import taichi as ti

from uuvtai.kernels.core.heap import heap_after_pop, heap_after_push, top_cell
from uuvtai.kernels.core.signature import Bundle
from uuvtai.kernels.planning.bundles import VoronoiIO

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

_FLAT_M = 1.0e-4
"""Clearances within this of clearance.max_m are saturated."""


def widest_m(clearance, quiet, voronoi):
    """[m] clearance beyond which more is worth nothing to the planner; plain Python."""
    return max(min(clearance.max_m, quiet.room_m), voronoi.cost_epsilon_m)


@ti.func
def step_of(direction):
    """(row, col) step of direction 0..7; the opposite of d is 7 - d."""
    place = direction + ti.cast(direction >= 4, ti.i32)
    return ti.Vector([place // 3 - 1, place % 3 - 1])


@ti.func
def bits_at(slot, row, col, io: Bundle[VoronoiIO]):
    return ti.cast(io.voronoi.cell[slot, row, col], ti.i32)


@ti.func
def next_direction(slot, row, col, io: Bundle[VoronoiIO]):
    """Direction of the next cell towards the goal."""
    return bits_at(slot, row, col, io) >> _NEXT_SHIFT & 7


@ti.func
def on_skeleton(slot, env, row, col, io: Bundle[VoronoiIO]):
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
def _is_medial(env, row, col, io: Bundle[VoronoiIO]):
    """True on a plateau and where a neighbour's nearest site is far from the own one."""
    # The integer medial axis (Hesselink and Roerdink 2008, IEEE PAMI 30): where the nearest site jumps by
    # more than a threshold from one cell to the next, the two cells lie on either side of the axis.
    medial = io.clearance.clearance_m[env, row, col] >= ti.static(
        widest_m(io.clearance_cfg, io.quiet_cfg, io.voronoi_cfg) - _FLAT_M
    )
    site_row = ti.cast(io.clearance.site_row[env, row, col], ti.i32)
    site_col = ti.cast(io.clearance.site_col[env, row, col], ti.i32)
    for k in range(4):
        step = step_of(ti.select(k < 2, 1 + 2 * k, 2 * k))  # the four sides: 1, 3, 4, 6
        other_row = ti.cast(io.clearance.site_row[env, row + step[0], col + step[1]], ti.i32)
        other_col = ti.cast(io.clearance.site_col[env, row + step[0], col + step[1]], ti.i32)
        gap = ti.cast((other_row - site_row) ** 2 + (other_col - site_col) ** 2, ti.f32)
        if other_row >= 0 and site_row >= 0 and gap > ti.static(io.voronoi_cfg.site_gap_cells**2):
            medial = True
    return medial


@ti.func
def _step_is_open(slot, row, col, step, io: Bundle[VoronoiIO]):
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
def join_skeleton(slot, env, start, goal, io: Bundle[VoronoiIO]):
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
def _uphill(slot, env, row, col, io: Bundle[VoronoiIO]):
    """Direction of the open neighbour with the largest clearance, -1 on a summit."""
    best, best_m = -1, io.clearance.clearance_m[env, row, col]
    for k in range(8):
        step = step_of(k)
        higher = io.clearance.clearance_m[env, row + step[0], col + step[1]]
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
def search_cells(slot, env, start, goal, everywhere, io: Bundle[VoronoiIO]):
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
def _size_after_expansion(slot, env, size, row, col, start, everywhere, floor_weight, io: Bundle[VoronoiIO]):
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
