"""The paper's risk R of a place, for those who look along the route."""

import taichi as ti

from uuvtai.config import ClearanceConfig, MappingConfig, TankConfig
from uuvtai.kernels.core.grid import cell_of
from uuvtai.kernels.core.signature import Const, In
from uuvtai.state import ClearanceState, MapState


@ti.func
def cell_on_grid(
    pos_w, clearance: In[ClearanceState], tank_cfg: Const[TankConfig], mapping_cfg: Const[MappingConfig]
):
    """(row, col), off-grid positions held at the edge."""
    cell = cell_of(pos_w, tank_cfg, mapping_cfg.cell_m)
    n_row, n_col = ti.static(clearance.clearance_m.shape[1:])
    return ti.Vector([ti.math.clamp(cell[0], 0, n_row - 1), ti.math.clamp(cell[1], 0, n_col - 1)])


@ti.func
def risk_at(
    env, cell, clearance: In[ClearanceState], grid_map: In[MapState], clearance_cfg: Const[ClearanceConfig]
):
    """R: alpha_m M^s + alpha_d M^d + alpha_delta / (clearance + eps)."""
    occupied = ti.static(clearance_cfg.risk_static) * grid_map.static_occ[env, cell[0], cell[1]]
    moving = ti.static(clearance_cfg.risk_dynamic) * grid_map.dynamic_occ[env, cell[0], cell[1]]
    room = clearance.clearance_m[env, cell[0], cell[1]] + ti.static(clearance_cfg.risk_epsilon_m)
    return occupied + moving + ti.static(clearance_cfg.risk_clearance) / room
