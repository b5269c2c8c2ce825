"""Where a kernel's machine code comes from: the store, or Taichi, whose result it is compared with once."""

from __future__ import annotations

import atexit
import contextlib
import gc
import os
import sys
import warnings
import weakref
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti
import torch
from taichi.lang import impl

from uuvtai.native.companion import Companion
from uuvtai.native.gpu_shape import asked_shape
from uuvtai.native.keys import KeyNameError, key_of, key_with
from uuvtai.native.launch import Launch, NativeLaunch, TaichiLaunch, given, native, written
from uuvtai.native.machine import Machine, UnfitError, tasks_in
from uuvtai.native.numbers import Sum, worked_out
from uuvtai.native.reads import noted, value_of
from uuvtai.native.store import MachineCode, Store, StoreError, default_folder
from uuvtai.native.taichi_code import Compiler
from uuvtai.taichi_patches.memory import Memory


@dataclass(frozen=True)
class Owner:
    """What a bundle's kernels need to know of its simulator."""

    memory: Memory
    runtime: Any
    recipe: Callable[[], bytes] | None
    """what another process can build the same simulator by (``other_end``)"""


class Native:
    """One per process."""

    def __init__(self) -> None:
        """Raises UnfitError or StoreError where nothing can be launched or kept here."""
        if sys.platform != "linux":
            raise UnfitError("own machine code is for Linux so far")
        if tuple(ti.__version__) != (1, 7, 4):
            raise UnfitError(f"Taichi {'.'.join(map(str, ti.__version__))} is not 1.7.4")
        self.store = Store(default_folder())
        self.machine = Machine(int(os.environ.get("UUV_NUM_THREADS") or os.cpu_count() or 1))
        program: Any = impl.get_runtime().prog
        told = program.config()
        passes = f"{told.advanced_optimization} {told.cfg_optimization} {told.fast_math}"
        self.surroundings = [*self.machine.surroundings(), *map(str, ti.__version__), asked_shape(), passes]
        self.adopted: weakref.WeakKeyDictionary[Any, Owner] = weakref.WeakKeyDictionary()
        self.compiler: Compiler | None = None
        self.companion = Companion()
        self.found, self.made, self.refused = 0, 0, 0
        self._times: Counter[Any] = Counter()

    def adopt(
        self,
        bundles: Iterable[Any],
        memory: Memory,
        recipe: Callable[[], bytes] | None = None,
        alone: bool = False,
    ) -> None:
        """Launch kernels on these bundles, whose arrays are those of ``memory``; ``alone``: in the calling
        thread."""
        owner = Owner(memory, self.machine.runtime(memory.address, alone), recipe)
        for bundle in bundles:
            self.adopted[bundle] = owner

    def first(self, kernel: Any, arguments: tuple) -> Launch | None:
        """Launch with arguments that were not seen before; None where this is nothing for us."""
        owner = self.adopted.get(arguments[0]) if arguments else None
        if owner is None or not all(_is_plain(value) for value in arguments[1:]):
            return None
        try:
            key = key_of(kernel, arguments, owner.memory.tree, self.surroundings)
            kept = (self.store.get(key_with(key, names, arguments[0])) for names in self.store.names(key))
            code = next(filter(None, kept), None)
            if code is None:
                return self._make(key, kernel, arguments, owner)
            launch = self._launch(code, kernel, arguments, owner)
        except (UnfitError, KeyNameError, StoreError) as error:
            self._tell(kernel, error)
            return None
        launch.again()
        self.found += 1
        return launch

    def _make(self, key: str, kernel: Any, arguments: tuple, owner: Owner) -> Launch:
        """Compile, launch both codes, keep ours if it did what Taichi's did."""
        if self.compiler is None:
            self.compiler = Compiler()
            atexit.register(self.compiler.close)
            atexit.register(self.companion.close)
            self.store.bound()
        if owner.recipe:
            self.companion.ask(owner.recipe())
        made, names, table = self._read(kernel, arguments)
        compiled, text = self.compiler.compiled(made)
        tasks = tasks_in(text)
        work = self.compiler.beside(self.machine.object_of, text)
        taichi = TaichiLaunch(kernel, arguments, (made, compiled), _values(kernel, arguments, table))
        state = Written(arguments, owner.memory)
        taichi.again()
        try:
            code = MachineCode(tasks, work(), table)
            ours = self._launch(code, kernel, arguments, owner)
        except UnfitError as error:
            self._tell(kernel, error)
            return taichi
        if not state.is_same_after(ours):
            self._tell(kernel, UnfitError("its own machine code gives another result"))
            return taichi
        self.made += 1
        try:
            self.store.put(key_with(key, names, arguments[0]), code)
            self.store.put_names(key, names)
        except StoreError as error:
            self._tell(kernel, error, "its machine code is not kept")
        return ours

    def _read(self, kernel: Any, arguments: tuple) -> tuple[Any, list[str], list[Sum]]:
        """What Taichi makes of a kernel's source, what of the config this depends on, and the numbers that
        are its arguments."""
        instance = kernel.mapper.lookup(arguments)[0]
        kernel.compiled_kernels.pop((kernel.func, instance, kernel.autodiff_mode), None)  # not read by us
        self._times[kernel.func] += 1
        with noted(arguments[0], self._times[kernel.func]) as (names, numbers), _uncollected():
            made = kernel.compiled_kernels.pop(kernel.ensure_compiled(*arguments))
        return made, sorted(names), numbers.table

    def _launch(self, code: MachineCode, kernel: Any, arguments: tuple, owner: Owner) -> NativeLaunch:
        tasks, values = (
            self.machine.tasks_of(code.machine, code.tasks),
            _values(kernel, arguments, code.numbers),
        )
        return NativeLaunch(self.machine, owner.runtime, tasks, arguments, values)

    def _tell(self, kernel: Any, error: Exception, effect: str = "Taichi launches it") -> None:
        """One line for the first kernel; the others are counted."""
        self.refused += 1
        if self.refused == 1:
            warnings.warn(f"{kernel.func.__name__}: {error}; {effect}", RuntimeWarning, stacklevel=2)


def adopt(
    bundles: Iterable[Any],
    memory: Memory,
    recipe: Callable[[], bytes] | None = None,
    alone: bool = False,
) -> None:
    """Launch kernels on these bundles by machine code of their own from now on, where this machine allows it;
    one line says why where it does not. ``recipe``: what a second process compiles the same by, where much is
    to be compiled; ``alone``: in the calling thread, without waking others."""
    try:
        if not native:
            native.append(Native())
        native[0].adopt(bundles, memory, recipe, alone)
    except (UnfitError, StoreError) as error:
        warnings.warn(f"{error}; Taichi launches all kernels", RuntimeWarning, stacklevel=2)


def _values(kernel: Any, arguments: tuple, table: list[Sum]) -> list[tuple[Any, Any]]:
    """What a kernel is told at a launch: its own numbers and tensors, then those of the config."""
    numbers = (worked_out(told, lambda name: value_of(arguments[0], name)) for told in table)
    return given(kernel, arguments) + [(float, number) for number in numbers]


@contextlib.contextmanager
def _uncollected() -> Iterator[None]:
    """Look for no garbage meanwhile: Taichi makes trees of a kernel's source, which end with it."""
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()


def _is_plain(value: Any) -> bool:
    return isinstance(value, int | float) or (
        isinstance(value, torch.Tensor) and value.device.type == "cpu" and value.is_contiguous()
    )


class Written:
    """Everything that a kernel writes, as it is before its first launch."""

    def __init__(self, arguments: tuple, memory: Memory) -> None:
        tensors = [value.numpy() for value in arguments[1:] if isinstance(value, torch.Tensor)]
        structs = written(arguments[0])
        self._all = [a for s in structs for a in memory.arrays(s)] + tensors
        self._kept = [a for s in structs for a in memory.arrays(s, scratch=False)] + tensors
        self._before = [array.copy() for array in self._all]

    def is_same_after(self, ours: Launch) -> bool:
        """When Taichi's code has run: whether ours, from the same state, gives every byte that another kernel
        may read. What Taichi's code has done stands."""
        after = [array.copy() for array in self._all]
        wanted = [array.tobytes() for array in self._kept]
        _put(self._all, self._before)
        ours.again()
        is_same = all(array.tobytes() == bits for array, bits in zip(self._kept, wanted, strict=True))
        if not is_same:
            _put(self._all, after)
        return is_same


def _put(arrays: list[np.ndarray], values: list[np.ndarray]) -> None:
    for array, value in zip(arrays, values, strict=True):
        array[...] = value
