"""Exposure to moving bodies: how much of the time something is expected, or was seen, to move at a place.

Two parts, each with a weight of its own (``quiet``), make a metre of a route dearer. What is expected before
anything is seen follows from the tank: a body that goes back and forth or around, wherever that fits between
the side walls, passes the middle more often than the walls. What was seen is the dynamic layer of the map,
averaged over time in blocks of cells: bodies that circle or shuttle come back.
"""

import math

import taichi as ti

from uuvtai.config import MappingConfig, TankConfig, TrafficConfig
from uuvtai.kernels.core.bits import WORD, lowest_bit, without_lowest
from uuvtai.kernels.core.grid import centre_of
from uuvtai.kernels.core.signature import Bundle, Const, spread
from uuvtai.kernels.perception.mapping import map_period_s
from uuvtai.kernels.planning.bundles import ExposureIO, VoronoiIO
from uuvtai.native.launch import quick_launch

BLOCK = 5
"""[cells] edge of a block"""


# ---------------------------------------------------------- plain Python, evaluated when a kernel is compiled


def block_shape(shape, quiet):
    """(rows, columns) of blocks that cover a grid of (rows, columns) cells; (1, 1) where none is averaged."""
    n_row, n_col = shape
    return (-(-n_row // BLOCK), -(-n_col // BLOCK)) if quiet.weight_seen > 0 else (1, 1)


def widest_m(clearance, quiet, voronoi):
    """[m] clearance beyond which more is worth nothing to the planner."""
    return max(min(clearance.max_m, quiet.room_m), voronoi.cost_epsilon_m)


def deep_m(tank, traffic):
    """[m] from the side walls on, traffic is as dense as in the middle."""
    half = 0.5 * min(tank.x_m[1] - tank.x_m[0], tank.y_m[1] - tank.y_m[0])
    return min(half, traffic.leg_m[1])


# ---------------------------------------------------------------------------------------------------- average


@quick_launch
@ti.kernel
def reset_exposure(io: Bundle[ExposureIO]):
    """Nothing has moved yet, in the awake rows."""
    n_env, n_row, n_col = ti.static(io.exposure.share.shape)
    for env, row in ti.ndrange(n_env, n_row):
        if io.clock.awake[env] == 1:
            for col in range(n_col):
                io.exposure.share[env, row, col] = 0.0


@quick_launch
@ti.kernel
def average_traffic(io: Bundle[ExposureIO]):
    """Take the dynamic layer into the average, in the awake rows whose map is new."""
    n_env, n_row = ti.static(io.exposure.share.shape[0], io.exposure.share.shape[1])
    for env, pad in ti.ndrange(n_env, ti.static(spread(n_env))):
        if pad == 0 and io.clock.awake[env] == 1 and io.grid_map.map_step[env] == io.clock.step[env]:
            for row in range(n_row):
                _average_row(env, row, io)


@ti.func
def _average_row(env, row, io: Bundle[ExposureIO]):
    """One row of blocks: all fade, those with an occupied cell rise."""
    n_row, n_word = ti.static(io.grid_map.dynamic_occupied.shape[1:])
    period_s = ti.static(map_period_s(io.mapping_cfg, io.sonar_cfg, io.episode_cfg))
    kept = ti.static(math.exp(-period_s / io.quiet_cfg.memory_s))
    for col in range(ti.static(io.exposure.share.shape[2])):
        io.exposure.share[env, row, col] *= kept
    last = -1
    for word in range(n_word):
        found = ti.cast(0, ti.u64)
        for cell_row in range(row * BLOCK, ti.min((row + 1) * BLOCK, n_row)):
            found |= io.grid_map.dynamic_occupied[env, cell_row, word]
        while found != 0:
            col = (word * WORD + lowest_bit(found)) // BLOCK
            found = without_lowest(found)
            if col != last:
                io.exposure.share[env, row, col] += 1.0 - kept
            last = col


# ---------------------------------------------------------------------------------------------------- reading


def is_dear(quiet_cfg):
    """Whether any water is dearer than other; plain Python."""
    return quiet_cfg.weight_prior > 0 or quiet_cfg.weight_seen > 0


@ti.func
def dearness(env, row, col, io: Bundle[VoronoiIO]):
    """Factor >= 1 by which a metre in a cell is dearer than in quiet water."""
    factor = 1.0
    if ti.static(io.quiet_cfg.weight_prior > 0):
        factor += ti.static(io.quiet_cfg.weight_prior) * expected_traffic(
            row, col, io.tank_cfg, io.traffic_cfg, io.mapping_cfg
        )
    if ti.static(io.quiet_cfg.weight_seen > 0):
        factor += ti.static(io.quiet_cfg.weight_seen) * _seen_traffic(env, row, col, io)
    return factor


@ti.func
def expected_traffic(
    row,
    col,
    tank_cfg: Const[TankConfig],
    traffic_cfg: Const[TrafficConfig],
    mapping_cfg: Const[MappingConfig],
):
    """Density of bodies in a cell before any is seen, 1 = that of the middle, 0 at the side walls."""
    # Between walls 2 a apart, the density of random ways falls off as 1 - (x / a)^2 from the middle
    # (Bettstetter et al. 2003, random waypoint model); lines and circles that fit between the walls have it
    # too, within a few per cent.
    at = centre_of(row, col, tank_cfg, mapping_cfg.cell_m)
    short = 1.0 - ti.math.clamp(
        _wall_gap(at, tank_cfg) * ti.static(1.0 / deep_m(tank_cfg, traffic_cfg)), 0.0, 1.0
    )
    return 1.0 - short * short


@ti.func
def _wall_gap(at, tank_cfg: Const[TankConfig]):
    """[m] to the nearest side wall, negative beyond it."""
    x0, x1, y0, y1 = ti.static(tank_cfg.x_m[0], tank_cfg.x_m[1], tank_cfg.y_m[0], tank_cfg.y_m[1])
    gap = ti.min(ti.min(at[0] - x0, x1 - at[0]), ti.min(at[1] - y0, y1 - at[1]))
    if ti.static(tank_cfg.shape == "circle"):
        gap = tank_cfg.radius_m - (at - ti.Vector([0.5 * (x0 + x1), 0.5 * (y0 + y1)])).norm()
    return gap


@ti.func
def _seen_traffic(env, row, col, io: Bundle[VoronoiIO]):
    """The average at a cell, between the centres of the four blocks around it."""
    n_row, n_col = ti.static(io.exposure.share.shape[1:])
    y = ti.math.clamp((row + 0.5) / BLOCK - 0.5, 0.0, n_row - 1.0)
    x = ti.math.clamp((col + 0.5) / BLOCK - 0.5, 0.0, n_col - 1.0)
    lower, left = ti.cast(y, ti.i32), ti.cast(x, ti.i32)
    upper, right = ti.min(lower + 1, n_row - 1), ti.min(left + 1, n_col - 1)
    v, u = y - lower, x - left
    low = (1.0 - u) * io.exposure.share[env, lower, left] + u * io.exposure.share[env, lower, right]
    high = (1.0 - u) * io.exposure.share[env, upper, left] + u * io.exposure.share[env, upper, right]
    return (1.0 - v) * low + v * high
