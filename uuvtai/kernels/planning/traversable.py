"""The traversable set: cells that are not occupied, lie inside the tank and keep d_min (the paper's
Omega)."""

import taichi as ti

from uuvtai.config import MappingConfig, VoronoiConfig
from uuvtai.kernels.core.signature import Const, In
from uuvtai.state import ClearanceState, GridMask, MapState

_SLACK_M = 1.0e-5
"""A cell exactly d_min away counts; rounding of the root must not decide. Distances on the grid differ by far
more than this."""


@ti.func
def occupancy(grid_map: In[MapState], env, row, col, voronoi_cfg: Const[VoronoiConfig]):
    """Occupancy in [0, 1] of the layer that routes avoid."""
    value = grid_map.static_occ[env, row, col]
    if ti.static(voronoi_cfg.use == "fused"):
        value = ti.max(value, grid_map.dynamic_occ[env, row, col])
    return value


@ti.func
def is_traversable(
    clearance: In[ClearanceState],
    grid_map: In[MapState],
    mask: In[GridMask],
    env,
    row,
    col,
    voronoi_cfg: Const[VoronoiConfig],
    mapping_cfg: Const[MappingConfig],
):
    """True where a route may pass. The map may be newer than the clearance, so both are asked."""
    wide = clearance.clearance_m[env, row, col] >= ti.static(voronoi_cfg.min_clearance_m - _SLACK_M)
    free = occupancy(grid_map, env, row, col, voronoi_cfg) < ti.static(mapping_cfg.occupied)
    return wide and free and mask.outside[row, col] == 0
