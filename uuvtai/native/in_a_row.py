"""Launches in a row: what is nothing but launches is done again by one call, without Python between them.

Python's part of a launch costs little where launches follow each other closely; a vehicle's loop sleeps in
between, and finds Python's code and data no longer in the processor's caches.
"""

from __future__ import annotations

import ctypes
import operator
from collections.abc import Callable, Sequence
from typing import Any

from taichi.lang import impl

from uuvtai.native.launch import NativeLaunch, noted


class Rows:
    """What a simulator launches in a row, by the name of the work."""

    def __init__(self) -> None:
        self._known: dict[str, _Row] = {}

    def play(self, work: Callable[[], None], on: tuple[Any, ...]) -> None:
        """Do it. ``on``: all that decides which kernels it launches on what, compared by identity and kept
        alive."""
        name = work.__name__
        row = self._known.get(name)
        if row is not None and row.is_for(on):
            row.again()
            return
        launches = noted(work)
        if launches and all(isinstance(launch, NativeLaunch) for launch in launches):
            self._known[name] = _Row(launches, on)


class _Entry(ctypes.Structure):
    """One launch, as ``Machine.launch_row`` reads it."""

    _fields_ = (
        ("tasks", ctypes.c_void_p),
        ("count", ctypes.c_int32),
        ("arguments", ctypes.c_void_p),
        ("runtime", ctypes.c_void_p),
    )


class _Row:
    """Launches of machine code, which are kept alive."""

    def __init__(self, launches: Sequence[Any], on: tuple[Any, ...]) -> None:
        self._launches, self._on, self._program = launches, on, impl.get_runtime().prog
        self._entries = (_Entry * len(launches))(*(launch.entry for launch in launches))
        self._machine, self._count = launches[0].machine, len(launches)
        self._place = ctypes.addressof(self._entries)
        self._with_tensors = [launch for launch in launches if launch.tensors]

    def is_for(self, on: tuple[Any, ...]) -> bool:
        """Whether the work would be the same."""
        return all(map(operator.is_, on, self._on)) and self._program is impl.get_runtime().prog

    def again(self) -> None:
        """Launch them."""
        for launch in self._with_tensors:
            launch.look_at_tensors()
        self._machine.launch_row(self._place, self._count)
