"""The map's grid: cell [row, col] with row along y and col along x, padded by cells outside the tank on every
side.

Columns are padded to a multiple of the packet width, rows by two on each side, so that packets need no
special cases at the border and the border's cells are the sites of the known bounds.
"""

import taichi as ti

from uuvtai.config import TankConfig
from uuvtai.kernels.core.lanes import LANES
from uuvtai.kernels.core.signature import Const

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
