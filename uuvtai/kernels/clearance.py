"""Clearance delta = min(d_occ, d_bnd): exact Euclidean distance transform, truncated at ``max_m``, with the nearest site of every cell.

Sites are the occupied cells and the cells outside the tank, so one transform gives the minimum of both distances. Two passes (the
separation of Felzenszwalb and Huttenlocher): the nearest site within each row, then the best row of each cell's window, sixteen columns at
a time (rows are the short way across the tank, and packets of one column range stay aligned). Both carry one integer key per cell that
orders candidates by distance and holds the site, so that taking the smallest key settles everything:

    key = (2 * d^2 + right) << bits | row offset + reach      [cells]; right = 1 where the site's column is the larger one

Equally near sites: one to the left (or straight above or below) wins over one to the right, then the one in the lower row.
"""

import math

import taichi as ti

from uuvtai.config import ClearanceConfig, MappingConfig, VoronoiConfig
from uuvtai.kernels.lanes import LANES
from uuvtai.kernels.signature import Const, In, Out
from uuvtai.state import ClearanceState, ClockState, GridMask, MapState

_FAR_COLS = 1 << 12
"""[cells] stands for "no site in this row yet"; its square fits an int32."""

_OFFSETS_PER_CHECK = 2
"""Row offsets between two tests whether the window can end (the test costs as much as an offset)."""


# ----------------------------------------------------------------------------------- plain Python, evaluated when a kernel is compiled


def squared_limit(cfg, mapping):
    """[cells^2] largest squared distance that is not beyond ``max_m``."""
    return math.floor((cfg.max_m / mapping.cell_m) ** 2 + 1e-6)


def window_reach(cfg, mapping):
    """[cells] farthest row that can hold a site within ``max_m``."""
    return math.isqrt(squared_limit(cfg, mapping))


def offset_bits(cfg, mapping):
    """Bits of a key that hold the row offset. Raises ValueError where keys would not fit an int32."""
    bits = (2 * window_reach(cfg, mapping)).bit_length()
    if 4 * (squared_limit(cfg, mapping) + 1) << bits >= 1 << 31:
        raise ValueError(f"clearance.max_m {cfg.max_m} is too many cells of {mapping.cell_m} m")
    return bits


def no_site(cfg, mapping):
    """Key of a cell without a site within ``max_m``: larger than that of any cell with one."""
    return 2 * (squared_limit(cfg, mapping) + 1) << offset_bits(cfg, mapping)


# ----------------------------------------------------------------------------------------------------------------------- passes


@ti.func
def is_site(env, row, col, grid_map: In[MapState], mask: In[GridMask], mapping: Const[MappingConfig], voronoi: Const[VoronoiConfig]):
    """True where the cell is occupied or outside the tank."""
    occ = grid_map.static_occ[env, row, col]
    if ti.static(voronoi.use == "fused"):
        occ = ti.max(occ, grid_map.dynamic_occ[env, row, col])
    return occ >= mapping.occupied or mask.outside[row, col] == 1


@ti.func
def scan_row(
    env,
    row,
    clearance: Out[ClearanceState],
    grid_map: In[MapState],
    mask: In[GridMask],
    cfg: Const[ClearanceConfig],
    mapping: Const[MappingConfig],
    voronoi: Const[VoronoiConfig],
):
    """Keys of the nearest site in the same row: rightwards with the distance to the left, then leftwards with the smaller of both."""
    n_col = ti.static(clearance.clearance_m.shape[2])
    reach, bits = ti.static(window_reach(cfg, mapping), offset_bits(cfg, mapping))
    left = _FAR_COLS
    for col in range(n_col):
        left = ti.select(is_site(env, row, col, grid_map, mask, mapping, voronoi), 0, ti.min(left + 1, _FAR_COLS))
        clearance.row_key[env, row, col // LANES][col % LANES] = left
    right = _FAR_COLS
    for back in range(n_col):
        col = n_col - 1 - back
        to_left = clearance.row_key[env, row, col // LANES][col % LANES]
        right = ti.select(to_left == 0, 0, ti.min(right + 1, _FAR_COLS))
        gap = ti.min(to_left, right)
        key = ((2 * gap * gap + ti.cast(right < to_left, ti.i32)) << bits) + reach
        clearance.row_key[env, row, col // LANES][col % LANES] = ti.select(gap <= reach, key, ti.static(no_site(cfg, mapping)))


@ti.func
def keys_at(env, row, packet, offset, clearance: In[ClearanceState], cfg: Const[ClearanceConfig], mapping: Const[MappingConfig]):
    """Keys of the rows ``offset`` below and above; beyond the grid its last row stands in, taken for farther than it is."""
    last = ti.static(clearance.clearance_m.shape[1] - 1)
    farther = 2 * offset * offset << ti.static(offset_bits(cfg, mapping))
    below = clearance.row_key[env, ti.max(row - offset, 0), packet] + (farther - offset)
    above = clearance.row_key[env, ti.min(row + offset, last), packet] + (farther + offset)
    return below, above


@ti.func
def best_keys(env, row, packet, clearance: In[ClearanceState], cfg: Const[ClearanceConfig], mapping: Const[MappingConfig]):
    """Smallest keys over the window of rows; it ends where no farther row can be better for any of the sixteen cells."""
    reach, bits = ti.static(window_reach(cfg, mapping), offset_bits(cfg, mapping))
    best = clearance.row_key[env, row, packet]
    worst = best.max()
    offset = 1
    while offset <= reach and 2 * offset * offset << bits <= worst:
        for more in ti.static(range(_OFFSETS_PER_CHECK)):
            below, above = keys_at(env, row, packet, ti.min(offset + more, reach), clearance, cfg, mapping)
            for i in ti.static(range(LANES)):
                best[i] = ti.min(best[i], below[i], above[i])
        worst = best.max()
        offset += _OFFSETS_PER_CHECK
    return best


@ti.func
def write_packet(env, row, packet, clearance: Out[ClearanceState], cfg: Const[ClearanceConfig], mapping: Const[MappingConfig]):
    """Distance and site of sixteen cells, decoded from their keys."""
    reach, bits, limit = ti.static(window_reach(cfg, mapping), offset_bits(cfg, mapping), squared_limit(cfg, mapping))
    key = best_keys(env, row, packet, clearance, cfg, mapping)
    squared = key >> (bits + 1)
    rows = (key & ti.static((1 << bits) - 1)) - reach
    cols = ti.cast(ti.sqrt(ti.cast(squared - rows * rows, ti.f32)), ti.i32)
    signed_cols = cols * (2 * ((key >> bits) & 1) - 1)
    for i in ti.static(range(LANES)):
        distance = ti.sqrt(ti.cast(squared[i], ti.f32)) * mapping.cell_m
        clearance.clearance_m[env, row, packet * LANES + i] = ti.select(squared[i] <= limit, distance, cfg.max_m)
    for i in ti.static(range(LANES)):
        clearance.site_row[env, row, packet * LANES + i] = ti.cast(ti.select(squared[i] <= limit, row + rows[i], -1), ti.i16)
    for i in ti.static(range(LANES)):
        col = packet * LANES + i + signed_cols[i]
        clearance.site_col[env, row, packet * LANES + i] = ti.cast(ti.select(squared[i] <= limit, col, -1), ti.i16)


# ----------------------------------------------------------------------------------------------------------------------- kernel


@ti.func
def is_due(env, clock: In[ClockState], cfg: Const[ClearanceConfig]):
    """1 where the clearance is computed in this step."""
    return ti.cast(clock.awake[env] == 1 and clock.step[env] % cfg.period_steps == 0, ti.i32)


@ti.kernel
def compute_clearance(
    clearance: Out[ClearanceState],
    grid_map: In[MapState],
    mask: In[GridMask],
    clock: In[ClockState],
    cfg: Const[ClearanceConfig],
    mapping: Const[MappingConfig],
    voronoi: Const[VoronoiConfig],
):
    """Clearance of every cell from the layer that the planner must avoid (``voronoi.use``), where it is due."""
    n_env, n_row, n_col = ti.static(clearance.clearance_m.shape)
    for env, row in ti.ndrange(n_env, n_row):
        if row == 0 and clock.awake[env] == 1:
            clearance.fresh[env] = is_due(env, clock, cfg)
        if is_due(env, clock, cfg) == 1:
            scan_row(env, row, clearance, grid_map, mask, cfg, mapping, voronoi)
    for env, row in ti.ndrange(n_env, n_row):
        if is_due(env, clock, cfg) == 1:
            for packet in range(ti.static(n_col // LANES)):
                write_packet(env, row, packet, clearance, cfg, mapping)
