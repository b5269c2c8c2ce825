"""The list of bodies of each env: how slots are written and which of them move. Floor of the scenario's
drawing."""

import taichi as ti

from uuvtai.kernels.core.signature import Bundle, Const, In
from uuvtai.kernels.world.bundles import WorldIO
from uuvtai.state import PathState, WorldState


@ti.func
def put_body(env, slot, kind, pos_w, size, yaw, io: Bundle[WorldIO]):
    """Write one body, at rest."""
    io.world.kind[env, slot] = kind
    io.world.pos_w[env, slot] = pos_w
    io.world.vel_w[env, slot] = ti.Vector([0.0, 0.0, 0.0])
    io.world.size[env, slot] = size
    io.world.yaw[env, slot] = yaw


@ti.func
def first_moving(world: In[WorldState], path: In[PathState]):
    """Slot of the first moving body."""
    return ti.static(world.kind.shape[1] - path.n_way.shape[1])


@ti.func
def is_chosen(i, fraction: Const[float]):
    """1 for the indices that make up a fraction of any run of indices as evenly as can be: of an even number,
    half are exactly half."""
    return ti.cast(ti.floor((i + 1) * fraction) > ti.floor(i * fraction), ti.i32)
