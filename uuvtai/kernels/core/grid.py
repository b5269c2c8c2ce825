"""The map's grid: cell [row, col] with row along y and col along x, padded by cells outside the tank on every
side.

Columns are padded to a multiple of the packet width, rows by two on each side, so that packets need no
special cases at the border and the border's cells are the sites of the known bounds.
"""

import taichi as ti

from uuvtai.common.enums import FULL
from uuvtai.config import ClearanceConfig, TankConfig
from uuvtai.kernels.core.simd import LANES
from uuvtai.kernels.core.stage import Const, In, Out
from uuvtai.state import VoronoiState

_ROW_BORDER = 2


def _tank_cells(tank, cell_m):
    return round((tank.x_m[1] - tank.x_m[0]) / cell_m), round((tank.y_m[1] - tank.y_m[0]) / cell_m)


def grid_shape(tank, cell_m):
    """(n_row, n_col) of the padded grid; ``tank`` is a TankConfig, ``cell_m`` the edge of a cell [m]."""
    across, along = _tank_cells(tank, cell_m)
    return along + 2 * _ROW_BORDER, LANES * -(-(across + 2) // LANES)


def grid_origin(tank, cell_m):
    """World (x, y) [m] of the outer corner of cell [0, 0]."""
    across, _ = _tank_cells(tank, cell_m)
    border_col = (grid_shape(tank, cell_m)[1] - across) // 2
    return tank.x_m[0] - border_col * cell_m, tank.y_m[0] - _ROW_BORDER * cell_m


def outside_cells(tank, cell_m):
    """Rows of booleans [n_row][n_col]: True where the cell's centre lies outside the tank."""
    n_row, n_col = grid_shape(tank, cell_m)
    x0, y0 = grid_origin(tank, cell_m)
    return [
        [not _inside(tank, x0 + (col + 0.5) * cell_m, y0 + (row + 0.5) * cell_m) for col in range(n_col)]
        for row in range(n_row)
    ]


def _inside(tank, x, y):
    if tank.shape == "circle":
        dx, dy = x - 0.5 * (tank.x_m[0] + tank.x_m[1]), y - 0.5 * (tank.y_m[0] + tank.y_m[1])
        return dx * dx + dy * dy < tank.radius_m**2
    return tank.x_m[0] < x < tank.x_m[1] and tank.y_m[0] < y < tank.y_m[1]


@ti.func
def cell_of(pos_w, tank_cfg: Const[TankConfig], cell_m: Const[float]):
    """(row, col) of a world position [m]; may lie off the grid."""
    x0, y0 = ti.static(grid_origin(tank_cfg, cell_m))
    return ti.Vector(
        [
            ti.cast(ti.floor((pos_w[1] - y0) / cell_m), ti.i32),
            ti.cast(ti.floor((pos_w[0] - x0) / cell_m), ti.i32),
        ]
    )


@ti.func
def centre_of(row, col, tank_cfg: Const[TankConfig], cell_m: Const[float]):
    """World (x, y) [m] of a cell's centre."""
    x0, y0 = ti.static(grid_origin(tank_cfg, cell_m))
    return ti.Vector([x0 + (col + 0.5) * cell_m, y0 + (row + 0.5) * cell_m])


@ti.func
def occupancy_of(kept):
    """Occupancy in [0, 1] of what a layer of the map keeps of a cell."""
    return ti.cast(kept, ti.f32) * ti.static(1.0 / FULL)


@ti.func
def away_of(site):
    """(rows, columns) to the site that the clearance keeps of a cell, or of each of a packet's cells."""
    return ti.cast(site, ti.i32) >> 8, (ti.cast(site, ti.i32) << 24) >> 25


@ti.func
def clearance_of(site, clearance_cfg: Const[ClearanceConfig], cell_m: Const[float]):
    """Distance [m] to it, exact up to ``max_m``, which stands for "at least"."""
    rows, cols = away_of(site)
    found = ti.sqrt(ti.cast(rows * rows + cols * cols, ti.f32)) * cell_m
    if ti.static(clearance_cfg.inflate_m > 0):
        found = ti.select(ti.cast(site, ti.i32) & 1 == 1, ti.max(found - clearance_cfg.inflate_m, 0.0), found)
    return ti.min(found, clearance_cfg.max_m)


# ------------------------------------------------------------------------------------------------------------
# Binary min-heap of cells, one per slot. Old entries of a cell stay until they surface.
#
# An entry is one number that sorts as it should: the key's bits (those of a float32 that is not negative are
# in its order), then the cell.


@ti.func
def entry_of(cell, key):
    """Entry of a cell with a key >= 0."""
    return (ti.cast(ti.bit_cast(ti.cast(key, ti.f32), ti.u32), ti.u64) << 32) | ti.cast(cell, ti.u64)


@ti.func
def top_cell(voronoi: In[VoronoiState], slot):
    """Cell with the smallest key; of equal keys, the smallest cell."""
    return ti.cast(voronoi.heap[slot, 0] & ti.u64(0xFFFFFFFF), ti.i32)


@ti.func
def heap_after_push(voronoi: Out[VoronoiState], slot, size, cell, key):
    """Insert; returns the new size. The caller makes sure that there is room."""
    put_rising(voronoi, slot, size, entry_of(cell, key))
    return size + 1


@ti.func
def heap_after_pop(voronoi: Out[VoronoiState], slot, size):
    """Remove the top (read it before); returns the new size.

    The hole sinks to the bottom along the smaller children without asking where the last entry would stop: it
    almost always belongs down there, and a comparison that cannot be predicted costs more than a step up
    again.
    """
    # Bottom-up heapsort's sift (Wegener 1993, Theoretical Computer Science 118)
    last = size - 1
    moved = voronoi.heap[slot, last]
    place, below = 0, 1
    while below < last:
        left, right = (
            voronoi.heap[slot, below],
            voronoi.heap[slot, below + 1],
        )  # at the end of the heap right is ``moved``: harmless
        below += ti.cast(right < left, ti.i32)
        voronoi.heap[slot, place] = ti.min(left, right)
        place = below
        below = 2 * place + 1
    put_rising(voronoi, slot, place, moved)
    return last


@ti.func
def put_rising(voronoi: Out[VoronoiState], slot, hole, entry):
    """Put an entry into a hole at the bottom or above, where it belongs."""
    place = hole
    rising = 1
    while rising == 1 and place > 0:
        above = (place - 1) // 2
        upper = voronoi.heap[slot, above]
        if entry < upper:
            voronoi.heap[slot, place] = upper
            place = above
        else:
            rising = 0
    voronoi.heap[slot, place] = entry
