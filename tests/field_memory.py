"""Tests look at arrays, and fill them, where they lie in memory.

Taichi compiles a kernel for each field that is read as a whole, one for each that is written, one for every
value that a field is filled with, and two for single elements. Here one kernel for each block of memory tells
where it lies. What NumPy sees is compared with Taichi's own copies in ``test_capture.py``.
"""

import ctypes

import numpy as np
import taichi as ti
import torch
from taichi.lang import impl
from taichi.lang.field import ScalarField
from taichi.lang.matrix import MatrixField
from taichi.lang.util import in_python_scope

from uuvtai.taichi_patches.memory import _offset, _path, _view


@ti.kernel
def _tell_where(field: ti.template(), out: ti.types.ndarray(dtype=ti.i64, ndim=1)):  # type: ignore[valid-type]
    """out[0] = address of the first element of a field of any rank."""
    out[0] = ti.cast(ti.get_addr(field, ti.Vector([0 for _ in ti.static(range(len(field.shape)))])), ti.i64)


KINDS = (ScalarField, MatrixField)
_own_copy = {kind: kind.to_numpy for kind in KINDS}

_blocks: dict[int, np.ndarray] = {}
"""bytes of every tree of fields, by its number"""
_seen: dict[int, tuple] = {}
"""(field, its view) by the field's identity"""


def copied_by_taichi(field):
    """The field as Taichi's own kernel copies it."""
    return _own_copy[type(field)](field)


def view_of(field):
    """The field's memory as an array, vectors with a last axis; None where it does not lie in one piece."""
    known = _seen.get(id(field))
    if known is None:
        impl.get_runtime().materialize()
        known = _seen[id(field)] = field, _found(field)
    return known[1]


def _found(field):
    first, last = (field.vars[i].ptr.snode() for i in (0, -1))
    together = (last.offset_bytes_in_parent_cell - first.offset_bytes_in_parent_cell) == (
        len(field.vars) - 1
    ) * int(str(field.dtype)[1:]) // 8
    if field.shape == () or not together or getattr(field, "m", 1) != 1:
        return None
    tree = first.get_snode_tree_id()
    if tree not in _blocks:
        out = torch.zeros(1, dtype=torch.int64)
        _tell_where(field, out)
        size = _path(field)[-1].cell_size_bytes
        _blocks[tree] = np.ctypeslib.as_array(
            (ctypes.c_uint8 * size).from_address(int(out[0]) - _offset(field))
        )
    return _view(field, False, _blocks[tree])


def _reads(taichis):
    def to_numpy(self, *arguments, **named):
        view = None if arguments or named else view_of(self)
        return taichis(self, *arguments, **named) if view is None else view.copy()

    return to_numpy


def _writes(taichis):
    def from_numpy(self, arr):
        view = view_of(self)
        if view is None or arr.shape != view.shape:
            taichis(self, arr)
        else:
            view[...] = arr

    return from_numpy


def _fills(taichis):
    def fill(self, val):
        plain = in_python_scope() and isinstance(val, int | float | np.generic | tuple | list)
        view = view_of(self) if plain else None
        if view is None:
            taichis(self, val)
        else:
            view[...] = np.asarray(val).astype(view.dtype)

    return fill


def _gets(taichis):
    def getitem(self, key):
        view = view_of(self)
        return taichis(self, key) if view is None or not _is_cell(view, key) else view[key].item()

    return getitem


def _sets(taichis):
    def setitem(self, key, value):
        view = view_of(self)
        if view is None or not _is_cell(view, key):
            taichis(self, key, value)
        else:
            view[key] = value

    return setitem


def _is_cell(view, key):
    key = key if isinstance(key, tuple) else (key,)
    return len(key) == view.ndim and all(isinstance(i, int | np.integer) for i in key)


def look_in_memory() -> None:
    """From now on Taichi's fields are read and written in memory. CPU only, with Taichi running."""
    for kind in KINDS:
        kind.to_numpy, kind.from_numpy = _reads(kind.to_numpy), _writes(kind.from_numpy)
        kind.fill = _fills(kind.fill)
    ScalarField.__getitem__ = _gets(ScalarField.__getitem__)
    ScalarField.__setitem__ = _sets(ScalarField.__setitem__)
