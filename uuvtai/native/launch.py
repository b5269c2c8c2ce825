"""Launching kernels again without having Taichi look at them again: by machine code of their own where a
simulator has offered its bundles (``making.adopt``), else by Taichi's."""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import functools
import threading
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any, TypeVar

import taichi as ti
from taichi.lang import impl

if TYPE_CHECKING:
    import torch

_T = TypeVar("_T")
MOST_LAUNCHES = 64
"""lists of arguments remembered per kernel"""


class TaichiLaunch:
    """A kernel compiled by Taichi for one list of arguments, which are kept alive: their identities are the
    key."""

    def __init__(
        self,
        kernel: Any,
        arguments: tuple,
        compiled: tuple[Any, Any] | None = None,
        values: list[tuple[Any, Any]] | None = None,
    ) -> None:
        """``values``: as in ``NativeLaunch``; None where no number of the config is an argument."""
        self.program: Any = impl.get_runtime().prog
        self._arguments = arguments
        self._given = given(kernel, arguments) if values is None else values
        self._kernel, self._compiled = compiled or self._found(kernel)

    def _found(self, kernel: Any) -> tuple[Any, Any]:
        made = kernel.compiled_kernels[kernel.ensure_compiled(*self._arguments)]
        return made, self.program.compile_kernel(self.program.config(), self.program.get_device_caps(), made)

    def again(self) -> None:
        """Launch it."""
        context = self._kernel.make_launch_context()
        for number, (declared, value) in enumerate(self._given):
            if declared is int:
                context.set_arg_int((number,), value)
            elif declared is float:
                context.set_arg_float((number,), value)
            else:
                size = value.element_size() * value.nelement()
                context.set_arg_external_array_with_shape(
                    (number,), value.data_ptr(), size, tuple(value.shape), 0
                )
        self.program.launch_kernel(self._compiled, context)


class NativeLaunch:
    """A kernel's own machine code with one list of arguments, which are kept alive."""

    def __init__(
        self, machine: Any, runtime: Any, tasks: list[int], arguments: tuple, values: list[tuple[Any, Any]]
    ) -> None:
        """``values``: what it is told at each launch, as ``given`` has them, and numbers of the config."""
        self.program: Any = impl.get_runtime().prog
        self.machine = machine
        self._arguments, self._runtime = arguments, runtime
        self._tasks = (ctypes.c_void_p * len(tasks))(*tasks)
        self._packed, self.tensors = _packed(values)
        self.entry = (
            ctypes.addressof(self._tasks),
            len(tasks),
            ctypes.addressof(self._packed),
            ctypes.addressof(runtime),
        )
        """what the machine is told: tasks, how many, arguments, runtime"""
        self._launch = functools.partial(machine.launch, *self.entry)

    def look_at_tensors(self) -> None:
        """Where they lie now, for a launch."""
        for place, tensor in self.tensors:
            place.data = tensor.data_ptr()
            place.shape[:] = tensor.shape

    def again(self) -> None:
        """Launch it."""
        self.look_at_tensors()
        self._launch()


Launch = TaichiLaunch | NativeLaunch
native: list[Any] = []
"""the process's ``Native``, when a simulator has asked for it"""
_tables: list[dict[tuple[int, ...], Launch]] = []
"""launches of every kernel with ``quick_launch``, by the identities of their arguments"""
_noting: list[tuple[int, list[Launch | None]]] = []
"""thread whose launches are being noted, and these; at most one"""


def quick_launch(launch: _T) -> _T:
    """Decorator above Taichi's: launch again with the very same objects without looking at them again.

    Taichi inspects every argument and hashes every section at every launch, which costs more than many
    kernels do. Here the first launch looks; later ones with the same structs, sections, numbers and tensors
    go straight to the machine code. For kernels whose arguments live as long as the simulator: they are kept
    alive.
    """
    kernel = launch._primal  # type: ignore[attr-defined]
    known: dict[tuple[int, ...], Launch] = {}
    _tables.append(known)

    def again(*arguments):
        key = tuple(map(id, arguments))
        found = known.get(key)
        if found is not None and found.program is impl.get_runtime().prog:
            found.again()
        else:
            found = _first(launch, kernel, arguments)  # type: ignore[arg-type]
            if len(known) >= MOST_LAUNCHES:
                known.clear()
            if found is not None:
                known[key] = found
        if _noting and _noting[0][0] == threading.get_ident():
            _noting[0][1].append(found)

    again.__name__, again.__doc__ = launch.__name__, launch.__doc__  # type: ignore[attr-defined]
    again._primal = kernel  # type: ignore[attr-defined]  # as Taichi has it; aboard/tape.py looks for it
    return again  # type: ignore[return-value]


def forget(bundles: Iterable[Any]) -> None:
    """Launch nothing with these again without looking, and keep nothing alive that was launched with them."""
    gone = {id(bundle) for bundle in bundles}
    for known in _tables:
        for key in [key for key in known if not gone.isdisjoint(key)]:
            del known[key]


def noted(work: Callable[[], None]) -> list[Launch | None]:
    """Do it; what this thread has launched meanwhile, None where Taichi had to look."""
    launches: list[Launch | None] = []
    _noting.insert(0, (threading.get_ident(), launches))
    try:
        work()
    finally:
        _noting.pop(0)
    return launches


def with_cse(where: Callable[[Any], bool] = lambda _bundle: True) -> Callable[[_T], _T]:
    """Decorator between ``quick_launch`` and Taichi's: compile with common subexpression elimination,
    ``where`` the kernel's bundle says so.

    The time of that pass grows with the square of a kernel's length, a fifth of what all kernels took to
    compile. LLVM does that work again, but for what Taichi hides from it: for kernels that run faster by it.
    """

    def mark(launch: _T) -> _T:
        launch._primal.with_cse = where  # type: ignore[attr-defined]
        return launch

    return mark


@contextlib.contextmanager
def compiling(kernel: Any, arguments: tuple) -> Iterator[None]:
    """As this kernel wants to be compiled for these arguments (``with_cse``)."""
    program: Any = impl.get_runtime().prog
    config, before = program.config(), program.config().opt_level
    where = getattr(kernel, "with_cse", None)
    config.opt_level = before if where is not None and where(arguments[0]) else 0
    try:
        yield
    finally:
        config.opt_level = before


def _first(launch: Callable, kernel: Any, arguments: tuple) -> Launch | None:
    """Launch with arguments that were not seen before; how to do it again, None where Taichi has to look."""
    with compiling(kernel, arguments):
        return _compiled(launch, kernel, arguments)


def _compiled(launch: Callable, kernel: Any, arguments: tuple) -> Launch | None:
    if native and len(arguments) == len(kernel.arguments):
        found = native[0].first(kernel, arguments)
        if found is not None:
            return found
    launch(*arguments)
    known = all(d in (int, float) or hasattr(value, "data_ptr") for d, value in given(kernel, arguments))
    return TaichiLaunch(kernel, arguments) if known else None


def given(kernel: Any, arguments: tuple) -> list[tuple[Any, Any]]:
    """(what it is declared as, value) of the arguments that are no compile-time ones: int, float, tensors."""
    return [
        (declared.annotation, value)
        for value, declared in zip(arguments, kernel.arguments, strict=True)
        if not isinstance(declared.annotation, ti.template)
    ]


# ------------------------------------------------------------------------------------------------- arguments


def _packed(values: list[tuple[Any, Any]]) -> tuple[ctypes.Structure, list[tuple[Any, torch.Tensor]]]:
    """Arguments as Taichi's kernels read them from memory; the places of tensors in it."""
    kinds = [
        ctypes.c_int32 if declared is int else ctypes.c_float if declared is float else _array_of(value.ndim)
        for declared, value in values
    ]
    struct = type("Arguments", (ctypes.Structure,), {"_fields_": [(f"a{i}", k) for i, k in enumerate(kinds)]})
    packed, tensors = struct(), []
    for i, (declared, value) in enumerate(values):
        if declared in (int, float):
            setattr(packed, f"a{i}", value)
        else:
            tensors.append((getattr(packed, f"a{i}"), value))
    return packed, tensors


@functools.cache
def _array_of(rank: int) -> type[ctypes.Structure]:
    fields = [("shape", ctypes.c_int32 * rank), ("data", ctypes.c_void_p)]
    return type(f"Array{rank}", (ctypes.Structure,), {"_fields_": fields})


def written(bundle: Any) -> list[Any]:
    """The structs of a bundle that its kernels write."""
    return [
        getattr(bundle, member.name)
        for member in dataclasses.fields(bundle)
        if str(member.type).startswith("Out[")
    ]
