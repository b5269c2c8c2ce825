"""Debugging aid: writes moving bodies into the dynamic layer from the truth. Never part of a preset: it
breaks observation-only sensing.

Launched only where ``mapping.stamp`` > 0 (default 0).
"""

import taichi as ti

from uuvtai.kernels.core.bits import put_bit
from uuvtai.kernels.core.geometry import BOX, NONE, turned_z
from uuvtai.kernels.core.grid import centre_of
from uuvtai.kernels.core.signature import Bundle
from uuvtai.kernels.privileged.bundles import TrueMapIO


@ti.func
def covers(env, body, point, io: Bundle[TrueMapIO]):
    """True where a moving body lies over or under a horizontal point."""
    offset = point - ti.Vector([io.world.pos_w[env, body][0], io.world.pos_w[env, body][1]])
    size = io.world.size[env, body]
    inside = offset.norm() <= size[0]
    if io.world.kind[env, body] == BOX:
        local = turned_z(offset, -io.world.yaw[env, body])
        inside = ti.abs(local[0]) <= size[0] and ti.abs(local[1]) <= size[1]
    return inside and io.world.kind[env, body] != NONE and io.world.vel_w[env, body].norm() > 0.0


@ti.func
def is_covered(env, point, io: Bundle[TrueMapIO]):
    """1 where any moving body does."""
    covered = 0
    for body in range(ti.static(io.world.kind.shape[1])):
        if covers(env, body, point, io):
            covered = 1
    return covered


@ti.func
def stamp(env, row, col, io: Bundle[TrueMapIO]):
    """Add to one cell's occupancy, and keep the bits that follow from it."""
    stamped_occ = ti.min(1.0, io.grid_map.dynamic_occ[env, row, col] + io.mapping_cfg.stamp)
    io.grid_map.dynamic_occ[env, row, col] = stamped_occ
    put_bit(io.grid_map.alive, env, row, col)
    if stamped_occ >= io.mapping_cfg.occupied:
        put_bit(io.grid_map.dynamic_occupied, env, row, col)


@ti.kernel
def stamp_truth(io: Bundle[TrueMapIO]):
    """Add ``stamp`` to the dynamic occupancy of every cell whose centre a moving body covers, clipped at
    1."""
    n_env, n_row, n_col = ti.static(io.grid_map.dynamic_occ.shape)
    for env, row in ti.ndrange(n_env, n_row):
        if io.clock.awake[env] == 1:
            for col in range(n_col):
                if is_covered(env, centre_of(row, col, io.tank_cfg, io.mapping_cfg.cell_m), io) == 1:
                    stamp(env, row, col, io)
