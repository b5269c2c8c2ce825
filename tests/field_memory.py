"""Tests look at arrays, and fill them, where they lie in memory.

Taichi compiles a kernel for each field that is read as a whole, one for each that is written, one for every
value that a field is filled with, and two for single elements. Here one kernel for each block of memory tells
where it lies. What NumPy sees is compared with Taichi's own copies in ``test_capture.py``.
"""

import numpy as np
from taichi.lang.field import ScalarField
from taichi.lang.matrix import MatrixField
from taichi.lang.util import in_python_scope

from uuvtai.compile.memory import HostFields

KINDS = (ScalarField, MatrixField)
_own_copy = {kind: kind.to_numpy for kind in KINDS}

FIELDS = HostFields()


def copied_by_taichi(field):
    """The field as Taichi's own kernel copies it."""
    return _own_copy[type(field)](field)


def _reads(taichis):
    def to_numpy(self, *arguments, **named):
        view = None if arguments or named else FIELDS.view(self)
        return taichis(self, *arguments, **named) if view is None else view.copy()

    return to_numpy


def _writes(taichis):
    def from_numpy(self, arr):
        view = FIELDS.view(self)
        if view is None or arr.shape != view.shape:
            taichis(self, arr)
        else:
            view[...] = arr

    return from_numpy


def _fills(taichis):
    def fill(self, val):
        plain = in_python_scope() and isinstance(val, int | float | np.generic | tuple | list)
        view = FIELDS.view(self) if plain else None
        if view is None:
            taichis(self, val)
        else:
            view[...] = np.asarray(val).astype(view.dtype)

    return fill


def _gets(taichis):
    def getitem(self, key):
        view = FIELDS.view(self)
        return taichis(self, key) if view is None or not _is_cell(view, key) else view[key].item()

    return getitem


def _sets(taichis):
    def setitem(self, key, value):
        view = FIELDS.view(self)
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
