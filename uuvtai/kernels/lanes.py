"""Sixteen-lane packets: Taichi 1.7.4 does not vectorise loops over elements, but it does vectorise fixed vectors.

Rules (measured): fill lanes with ``ti.static`` loops; never rebind a lane vector to its own name inside a loop (``b = ti.sqrt(b)`` can
silently keep the old lanes): use a new name; test every packet kernel against a scalar reference.
"""

import taichi as ti

LANES = 16
"""Width of one packet: one AVX-512 register of float32."""

f16x = ti.types.vector(LANES, ti.f32)
i16x = ti.types.vector(LANES, ti.i32)
u16x = ti.types.vector(LANES, ti.u32)


@ti.func
def ramp_lanes(first):
    """(first, first + 1, ..., first + 15)."""
    out = f16x(0.0)
    for i in ti.static(range(LANES)):
        out[i] = first + float(i)
    return out
