"""What the clearance on a CPU (``clearance.py``) and on a GPU (``clearance_cells.py``) share: keys, sites,
when it is due."""

import math

import taichi as ti

from uuvtai.kernels.core.bits import WORD
from uuvtai.kernels.core.signature import Bundle
from uuvtai.kernels.planning.bundles import ClearanceIO

# ---------------------------------------------------------- plain Python, evaluated when a kernel is compiled


def squared_limit(cfg, mapping):
    """[cells^2] largest squared distance that is not beyond ``max_m``."""
    return math.floor((cfg.max_m / mapping.cell_m) ** 2 + 1e-6)


def window_reach(cfg, mapping):
    """[cells] farthest row that can hold a site within ``max_m``."""
    return math.isqrt(squared_limit(cfg, mapping))


def offset_bits(cfg, mapping):
    """Bits of a key that hold the row offset. Raises ValueError where keys would not fit an int32."""
    bits = (2 * window_reach(cfg, mapping)).bit_length()
    if window_reach(cfg, mapping) >= WORD or 4 * (squared_limit(cfg, mapping) + 1) << bits >= 1 << 31:
        raise ValueError(f"clearance.max_m {cfg.max_m} is too many cells of {mapping.cell_m} m")
    return bits


def no_site(cfg, mapping):
    """Key of a cell without a site within ``max_m``: larger than that of any cell with one."""
    return 2 * (squared_limit(cfg, mapping) + 1) << offset_bits(cfg, mapping)


# ------------------------------------------------------------------------------------------------------ sites


@ti.func
def site_word(env, row, word, io: Bundle[ClearanceIO]):
    """Cells that are occupied or outside the tank."""
    sites = io.grid_map.static_occupied[env, row, word] | io.mask.outside_bits[row, word]
    if ti.static(io.voronoi_cfg.use == "fused"):
        sites |= io.grid_map.dynamic_occupied[env, row, word]
    return sites


@ti.func
def is_due(env, io: Bundle[ClearanceIO]):
    """1 where the clearance is computed in this step."""
    return ti.cast(
        io.clock.awake[env] == 1 and io.clock.step[env] % io.clearance_cfg.period_steps == 0, ti.i32
    )
