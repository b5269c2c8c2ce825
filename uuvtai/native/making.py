"""Where a kernel's machine code comes from: the store, or Taichi, whose result it is compared with once."""

from __future__ import annotations

import atexit
import os
import sys
import warnings
import weakref
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti
import torch

from uuvtai.native.companion import Companion
from uuvtai.native.gpu_shape import asked_shape
from uuvtai.native.keys import KeyNameError, key_of
from uuvtai.native.launch import Launch, NativeLaunch, TaichiLaunch, native, written
from uuvtai.native.machine import Machine, UnfitError, tasks_in
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
        self.surroundings = [*self.machine.surroundings(), *map(str, ti.__version__), asked_shape()]
        self.adopted: weakref.WeakKeyDictionary[Any, Owner] = weakref.WeakKeyDictionary()
        self.compiler: Compiler | None = None
        self.companion = Companion()
        self.found, self.made, self.refused = 0, 0, 0

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
            code = self.store.get(key)
            if code is None:
                return self._make(key, kernel, arguments, owner)
            tasks = self.machine.tasks_of(code.machine, code.tasks)
            launch = NativeLaunch(self.machine, owner.runtime, tasks, kernel, arguments)
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
        made = kernel.compiled_kernels[kernel.ensure_compiled(*arguments)]
        compiled, text = self.compiler.compiled(made)
        names = tasks_in(text)
        work = self.compiler.beside(self.machine.object_of, text)
        taichi = TaichiLaunch(kernel, arguments, (made, compiled))
        state = Written(arguments, owner.memory)
        taichi.again()
        try:
            code = MachineCode(names, work())
            tasks = self.machine.tasks_of(code.machine, code.tasks)
            ours = NativeLaunch(self.machine, owner.runtime, tasks, kernel, arguments)
        except UnfitError as error:
            self._tell(kernel, error)
            return taichi
        if not state.is_same_after(ours):
            self._tell(kernel, UnfitError("its own machine code gives another result"))
            return taichi
        self.made += 1
        try:
            self.store.put(key, code)
        except StoreError as error:
            self._tell(kernel, error, "its machine code is not kept")
        return ours

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
