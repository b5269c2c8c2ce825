"""Declaring arrays and building them: names of axes become lengths, memory is known before anything is
allocated."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, TypeVar

import taichi as ti

REAL = "real"
"""dtype of continuous quantities: float32, or float64 where a run asks for double precision."""

PACKET = 16
"""Lanes of a packed array (lanes.LANES)."""
WORD = 64
"""Bits of a word of a bit array (bits.WORD)."""

_T = TypeVar("_T")


def array(
    *shape: str,
    vec: int = 0,
    dtype: Any = REAL,
    packed: bool = False,
    lanes: bool = False,
    bits: bool = False,
    beside: str = "",
    scratch: bool = False,
) -> Any:
    """Declare one array of a struct: named sizes, optional vector length, dtype (default: the run's real
    type).

    ``packed`` groups the last axis into vectors of sixteen neighbours: one packet is one index, which Taichi
    loads as a whole. ``lanes`` keeps single elements as indices, but lays the last axis (padded to whole
    packets) out in groups of sixteen, so that the compiler sees that a loop over ``packet * 16 + i`` with
    static i meets neighbours: it then loads, computes and stores whole vectors. ``bits`` keeps sixty-four
    neighbours on the last axis as the bits of one word (uint64), the first in the lowest. Arrays of one shape
    with the same word in ``beside`` lie side by side, element by element: what is touched together is fetched
    together. It also costs fewer of Taichi's nodes, of which there may be 1,024 in all: an array takes one
    and one more per component, one beside others only the latter. ``scratch``: no step reads what an earlier
    one left in it, so a capture leaves it out (capture.py).
    """
    metadata = {
        "shape": shape,
        "vec": vec,
        "dtype": ti.u64 if bits else dtype,
        "packed": packed,
        "lanes": lanes,
        "bits": bits,
    }
    return dataclasses.field(metadata=metadata | {"beside": beside, "scratch": scratch})


def allocate(struct: type[_T], sizes: dict[str, int], real: Any = ti.f32) -> _T:
    """Build every array of ``struct``; ``sizes`` maps each name of a shape to its length. Taichi must be
    running."""
    built: dict[str, Any] = {}
    for declared in dataclasses.fields(struct):  # type: ignore[arg-type]
        if declared.metadata["beside"]:
            built |= (
                {}
                if declared.name in built
                else _side_by_side(struct, declared.metadata["beside"], sizes, real)
            )
        else:
            built[declared.name] = _field(declared, sizes, real)
    return struct(**built)


def _side_by_side(struct: type, group: str, sizes: dict[str, int], real: Any) -> dict[str, Any]:
    fields = dataclasses.fields(struct)  # type: ignore[arg-type]
    together = [f for f in fields if f.metadata["beside"] == group]
    shape = _shape(together[0], sizes)
    built = {f.name: ti.field(_dtype(f, real)) for f in together}
    ti.root.dense((ti.i, ti.ij, ti.ijk, ti.ijkl)[len(shape) - 1], shape).place(*built.values())
    return built


def _dtype(declared: dataclasses.Field, real: Any) -> Any:
    return real if declared.metadata["dtype"] is REAL else declared.metadata["dtype"]


def _shape(declared: dataclasses.Field, sizes: dict[str, int]) -> tuple[int, ...]:
    shape = tuple(sizes[name] for name in declared.metadata["shape"])
    return (*shape[:-1], -(-shape[-1] // WORD)) if declared.metadata["bits"] else shape


def _field(declared: dataclasses.Field, sizes: dict[str, int], real: Any) -> Any:
    shape, dtype = _shape(declared, sizes), _dtype(declared, real)
    if declared.metadata["packed"]:
        return ti.Vector.field(PACKET, dtype, shape=(*shape[:-1], shape[-1] // PACKET), layout=ti.Layout.AOS)
    if declared.metadata["lanes"]:
        return _field_in_lanes(shape, dtype)
    if declared.metadata["vec"]:
        # a vector's components stay together: apart, they would lie a whole array from each other, which for
        # a power of two of envs is the same cache set for every component of every array
        return ti.Vector.field(declared.metadata["vec"], dtype, shape=shape, layout=ti.Layout.AOS)
    return ti.field(dtype, shape=shape)


def _field_in_lanes(shape: tuple[int, ...], dtype: Any) -> Any:
    """A scalar field whose last axis is split in two levels, the inner one of sixteen; in memory and in use
    it is like any other."""
    field, axes, node = ti.field(dtype), (ti.i, ti.j, ti.k, ti.l)[: len(shape)], ti.root
    for axis, length in zip(axes[:-1], shape[:-1], strict=True):
        node = node.dense(axis, length)
    node.dense(axes[-1], _packets(shape[-1])).dense(axes[-1], PACKET).place(field)
    return field


def _packets(length: int) -> int:
    return -(-length // PACKET)


def bytes_of(struct: type, sizes: dict[str, int]) -> int:
    """Memory that ``allocate`` would take [bytes], known before anything is allocated."""
    total = 0
    for declared in dataclasses.fields(struct):
        count = max(1, declared.metadata["vec"])
        shape = _shape(declared, sizes)
        if declared.metadata["lanes"]:
            shape = (*shape[:-1], PACKET * _packets(shape[-1]))
        count *= math.prod(shape)
        total += count * (
            4 if declared.metadata["dtype"] is REAL else _DTYPE_BYTES[declared.metadata["dtype"]]
        )
    return total


_DTYPE_BYTES = {
    ti.f32: 4,
    ti.f64: 8,
    ti.i32: 4,
    ti.u32: 4,
    ti.i16: 2,
    ti.u16: 2,
    ti.i8: 1,
    ti.u8: 1,
    ti.u64: 8,
}
