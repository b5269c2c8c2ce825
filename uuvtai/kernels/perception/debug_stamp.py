"""Debugging aid: writes moving bodies into the dynamic layer from the truth. Never part of a preset: it breaks observation-only sensing.

Launched only where ``mapping.stamp`` > 0 (default 0).
"""

import taichi as ti

from uuvtai.config import MappingConfig, TankConfig
from uuvtai.kernels.core.bits import put_bit
from uuvtai.kernels.core.geometry import BOX, NONE, turned_z
from uuvtai.kernels.core.grid import centre_of
from uuvtai.kernels.core.signature import Const, In, Out
from uuvtai.state import ClockState, MapState, WorldState


@ti.func
def covers(env, body, point, world: In[WorldState]):
    """True where a moving body lies over or under a horizontal point."""
    offset = point - ti.Vector([world.pos_w[env, body][0], world.pos_w[env, body][1]])
    size = world.size[env, body]
    inside = offset.norm() <= size[0]
    if world.kind[env, body] == BOX:
        local = turned_z(offset, -world.yaw[env, body])
        inside = ti.abs(local[0]) <= size[0] and ti.abs(local[1]) <= size[1]
    return inside and world.kind[env, body] != NONE and world.vel_w[env, body].norm() > 0.0


@ti.kernel
def stamp_truth(
    grid_map: Out[MapState], world: In[WorldState], clock: In[ClockState], mapping: Const[MappingConfig], tank: Const[TankConfig]
):
    """Add ``stamp`` to the dynamic occupancy of every cell whose centre a moving body covers, clipped at 1."""
    n_env, n_row, n_col = ti.static(grid_map.dynamic_occ.shape)
    n_body = ti.static(world.kind.shape[1])
    for env, row in ti.ndrange(n_env, n_row):
        if clock.awake[env] == 1:
            for col in range(n_col):
                stamped = 0
                for body in range(n_body):
                    if covers(env, body, centre_of(row, col, tank, mapping.cell_m), world):
                        stamped = 1
                if stamped == 1:
                    stamped_occ = ti.min(1.0, grid_map.dynamic_occ[env, row, col] + mapping.stamp)
                    grid_map.dynamic_occ[env, row, col] = stamped_occ
                    put_bit(grid_map.alive, env, row, col)
                    if stamped_occ >= mapping.occupied:
                        put_bit(grid_map.dynamic_occupied, env, row, col)
