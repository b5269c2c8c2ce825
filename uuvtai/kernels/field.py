"""What other stages ask of the map and the clearance: fused occupancy, risk, and clearance at a point."""

import taichi as ti

from uuvtai.config import ClearanceConfig, TankConfig
from uuvtai.kernels.grid import cell_of
from uuvtai.kernels.signature import Const, In
from uuvtai.state import ClearanceState, MapState


@ti.func
def occupancy_at(env, row, col, grid_map: In[MapState]):
    """Fused occupancy M = max(M^s, M^d) of a cell."""
    return ti.max(grid_map.static_occ[env, row, col], grid_map.dynamic_occ[env, row, col])


@ti.func
def is_occupied(env, row, col, grid_map: In[MapState], occupied: Const[float]):
    """1 where the fused occupancy of a cell reaches tau_occ (``mapping.occupied``)."""
    return ti.cast(occupancy_at(env, row, col, grid_map) >= occupied, ti.i32)


@ti.func
def risk_at(env, row, col, grid_map: In[MapState], clearance: In[ClearanceState], clearance_cfg: Const[ClearanceConfig]):
    """Risk R of a cell: alpha_m M^s + alpha_d M^d + alpha_delta / (delta + eps)."""
    near = clearance_cfg.risk_clearance / (clearance.clearance_m[env, row, col] + clearance_cfg.risk_epsilon_m)
    layers = (
        clearance_cfg.risk_static * grid_map.static_occ[env, row, col] + clearance_cfg.risk_dynamic * grid_map.dynamic_occ[env, row, col]
    )
    return layers + near


@ti.func
def clearance_at(env, pos_w, clearance: In[ClearanceState], tank: Const[TankConfig], cell_m: Const[float]):
    """[m] clearance of the cell that holds a world point; 0 off the grid."""
    n_row, n_col = ti.static(clearance.clearance_m.shape[1:])
    cell = cell_of(pos_w, tank, cell_m)
    found = 0.0
    if cell[0] >= 0 and cell[0] < n_row and cell[1] >= 0 and cell[1] < n_col:
        found = clearance.clearance_m[env, cell[0], cell[1]]
    return found
