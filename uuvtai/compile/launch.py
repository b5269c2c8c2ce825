"""Launching kernels again without having Taichi look at them again: by machine code of their own where a
simulator has offered its bundles (``codegen.adopt``), else by Taichi's."""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import functools
import json
import math
import operator
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from numbers import Number as PythonNumber
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import taichi as ti
from taichi.lang import expr, impl, kernel_impl, matrix
from taichi.lang._ndrange import GroupedNDRange

from uuvtai.common.errors import SettingError

if TYPE_CHECKING:
    import torch


_T = TypeVar("_T")
MOST_LAUNCHES = 64
"""lists of arguments remembered per kernel"""


class TaichiLaunch:
    """A kernel compiled by Taichi for one list of arguments, which are kept alive: their identities are the
    key."""

    place: Callable[[int], Any] = staticmethod(lambda number: (number,))
    """how Taichi names an argument"""

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
        told = given(kernel, arguments) if values is None else values
        self._given = [(self.place(number), *value) for number, value in enumerate(told)]
        self._kernel, self._compiled = compiled or self._found(kernel)

    def _found(self, kernel: Any) -> tuple[Any, Any]:
        made = kernel.compiled_kernels[kernel.ensure_compiled(*self._arguments)]
        return made, self.program.compile_kernel(self.program.config(), self.program.get_device_caps(), made)

    def again(self) -> None:
        """Launch it."""
        context = self._kernel.make_launch_context()
        for place, declared, value in self._given:
            if declared is int:
                context.set_arg_int(place, value)
            elif declared is float:
                context.set_arg_float(place, value)
            else:
                size = value.element_size() * value.nelement()
                context.set_arg_external_array_with_shape(
                    place, value.data_ptr(), size, tuple(value.shape), 0
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


# ------------------------------------------------------------------------------------------------------------
# Launches in a row: what is nothing but launches is done again by one call, without Python between them.
#
# Python's part of a launch costs little where launches follow each other closely; a vehicle's loop sleeps in
# between, and finds Python's code and data no longer in the processor's caches.


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


# ------------------------------------------------------------------------------------------------------------
# Which of two shapes kernels are made in: for a CPU's few cores and wide vectors, or for a GPU's many narrow
# threads. No result depends on it (``docs/performance.md``).


VARIABLE = "UUV_KERNELS"
"""names the shape where there is no GPU, to compare the two: 'cpu' or 'gpu'"""


_reading: list[Numbers] = []
"""of the kernel that Taichi reads now: its code depends on the shape where it asks for that"""


def asked_shape() -> str:
    """'cpu' or 'gpu': what kernels on a CPU are to be like. Raises SettingError."""
    shape = os.environ.get(VARIABLE) or "cpu"
    if shape not in ("cpu", "gpu"):
        raise SettingError(f"{VARIABLE}={shape!r}: must be cpu or gpu; unset it for the shape that fits")
    return shape


def is_gpu_shaped() -> bool:
    """Whether the kernels of this process are made for a GPU. Plain Python, for the time when a kernel is
    compiled or a size chosen; sizes are also asked for before Taichi has been started."""
    for numbers in _reading:
        numbers.fix(VARIABLE)
    return (ti.cfg is not None and ti.cfg.arch == ti.cuda) or asked_shape() == "gpu"


# ------------------------------------------------------------------------------------------------------------
# Numbers of the config that kernels are told at every launch, so that another threshold is no other code.
#
# While Taichi reads a kernel, a float of a section is a ``Number``: one can reckon with it in Python, and
# what comes out becomes an argument of the kernel, rounded once as a constant would be. Whatever else is done
# with it, for example a comparison that decides what code there is, is done with its value and noted: the
# code depends on what came of it.


Sum = str | int | float | list
"""a value of the config by its name, a number, or [operation, Sum, ...], as JSON"""
MOST_NUMBERS = 128
"""arguments that a kernel has for them; further ones are constants of its code"""
_FUNCTIONS: dict[str, Callable[..., Any]] = {
    name: getattr(math, name) for name in ("sqrt", "exp", "log", "sin", "cos", "tan", "radians", "hypot")
}
"""of Python's ``math`` that kernels work out numbers by beforehand"""
_SUMS: dict[str, Callable[..., Any]] = _FUNCTIONS | {
    "+": operator.add, "-": operator.sub, "*": operator.mul, "/": operator.truediv, "**": operator.pow,
    "neg": operator.neg,
}  # fmt: skip
_DECISIONS: dict[str, Callable[..., Any]] = {
    "<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge, "==": operator.eq,
    "!=": operator.ne, "//": operator.floordiv, "%": operator.mod, "round": round, "floor": math.floor,
    "ceil": math.ceil, "int": int, "bool": bool, "abs": abs, "float": float,
}  # fmt: skip
_OPERATIONS = _SUMS | _DECISIONS


def worked_out(told: Sum, value_of: Callable[[str], float]) -> float:
    """The number that a sum comes to where the config says ``value_of`` a name."""
    if isinstance(told, list):
        return _OPERATIONS[told[0]](*(worked_out(part, value_of) for part in told[1:]))
    return value_of(told) if isinstance(told, str) else told


def _applied(operation: str, swapped: bool = False) -> Callable[..., Any]:
    """A sum is another number; what comes of a decision is plain, and the code depends on it."""

    def apply(self: Any, *other: Any) -> Any:
        if not all(isinstance(value, Number) or type(value) in (int, float, bool) for value in other):
            return NotImplemented  # Taichi's expressions, for example: they take numbers themselves
        parts = (*other, self) if swapped else (self, *other)
        told = [operation, *(part.told if isinstance(part, Number) else part for part in parts)]
        value = _OPERATIONS[operation](*(part.value if isinstance(part, Number) else part for part in parts))
        if operation in _SUMS and type(value) is float:
            return Number(self.numbers, told, value)
        self.numbers.fix(told)
        return value

    return apply


def _function(name: str) -> Callable[..., Any]:
    """A function of ``math`` that takes numbers too."""
    apply, plain = _applied(name), _FUNCTIONS[name]

    def call(*given: Any) -> Any:
        found = apply(*given) if isinstance(given[0], Number) else NotImplemented
        return plain(*given) if found is NotImplemented else found

    return call


class Number(GroupedNDRange):
    """A float of the config, or a sum of such, while a kernel is read. ``ti.static`` lets it through for its
    base."""

    def __init__(self, numbers: Numbers, told: Sum, value: float) -> None:
        self.numbers, self.told, self.value = numbers, told, value

    __add__, __radd__ = _applied("+"), _applied("+", swapped=True)
    __sub__, __rsub__ = _applied("-"), _applied("-", swapped=True)
    __mul__, __rmul__ = _applied("*"), _applied("*", swapped=True)
    __truediv__, __rtruediv__ = _applied("/"), _applied("/", swapped=True)
    __pow__, __rpow__ = _applied("**"), _applied("**", swapped=True)
    __floordiv__, __rfloordiv__ = _applied("//"), _applied("//", swapped=True)
    __mod__, __rmod__ = _applied("%"), _applied("%", swapped=True)
    __lt__, __le__, __gt__, __ge__ = map(_applied, ("<", "<=", ">", ">="))
    __eq__, __ne__ = map(_applied, ("==", "!="))  # type: ignore[assignment]
    __neg__, __abs__, __bool__ = map(_applied, ("neg", "abs", "bool"))
    __round__, __floor__, __ceil__ = map(_applied, ("round", "floor", "ceil"))
    __int__, __trunc__, __float__ = map(_applied, ("int", "int", "float"))
    __iter__ = None  # type: ignore[assignment]

    def __array_ufunc__(self, ufunc: Any, method: str, *given: Any, **named: Any) -> Any:
        """In kernels ``max`` and ``min`` are NumPy's where nothing is Taichi's."""
        chosen = {np.maximum: max, np.minimum: min}.get(ufunc)
        if chosen:
            return chosen(*given)
        return getattr(ufunc, method)(*(float(v) if isinstance(v, Number) else v for v in given), **named)

    def __repr__(self) -> str:
        return repr(float(self))

    def __hash__(self) -> int:
        return hash(float(self))


PythonNumber.register(Number)  # vectors of one number repeated ask for that


class Numbers:
    """Those of one kernel: ``table`` has the sums that are its arguments, in their order."""

    def __init__(self, fix: Callable[[str], None], spare: int = 0) -> None:
        """``fix`` is told, as JSON, what the code depends on. ``spare``: so many arguments more, which nobody
        reads. By them Taichi tells a kernel from one that it has compiled before, whose text it would not
        write again."""
        self._count = MOST_NUMBERS + spare
        self.table: list[Sum] = []
        self._fix, self._arguments = fix, list[Any]()
        self._places: dict[str, int] = {}

    def fix(self, told: Sum) -> None:
        """The code depends on what this comes to."""
        self._fix(json.dumps(told))

    def declare(self, callable_: Any) -> None:
        """Add the arguments to a kernel, whose own ones are there."""
        declared = [callable_.insert_scalar_param(ti.f32, f"number_{k}") for k in range(self._count)]
        self._arguments = declared[:MOST_NUMBERS]

    def argument(self, number: Number, dtype: Any) -> Any:
        """The expression that stands for a number, an argument of the kernel; None where it cannot be one."""
        told, runtime, core = json.dumps(number.told), impl.get_runtime(), expr._ti_core
        is_full = told not in self._places and len(self.table) == len(self._arguments)
        if is_full or dtype not in (None, ti.f32) or runtime.default_fp != ti.f32:
            return None
        place = self._places.setdefault(told, len(self.table))
        if place == len(self.table):
            self.table.append(number.told)
        where = core.DebugInfo(runtime.get_current_src_info())
        load = core.make_arg_load_expr(
            self._arguments[place], ti.f32, False, create_load=True, arg_depth=0, dbg_info=where
        )
        return expr.Expr(load)


@contextlib.contextmanager
def as_arguments(numbers: Numbers) -> Iterator[None]:
    """Kernels that Taichi reads meanwhile get their numbers as arguments."""
    transform, constant, kind_of = kernel_impl.transform_tree, expr.make_constant_expr, matrix._infer_entry_dt

    def transformed(tree: Any, context: Any) -> Any:
        runtime: Any = impl.get_runtime()
        if not isinstance(runtime.compiling_callable, _Declaring):
            runtime.compiling_callable = _Declaring(runtime.compiling_callable, numbers)
        return transform(tree, context)

    def constant_or_argument(value: Any, dtype: Any) -> Any:
        if not isinstance(value, Number):
            return constant(value, dtype)
        argument = numbers.argument(value, dtype)
        return constant(float(value), dtype) if argument is None else argument

    parts = [
        *((math, name, _function(name), plain) for name, plain in _FUNCTIONS.items()),
        (kernel_impl, "transform_tree", transformed, transform),
        (expr, "make_constant_expr", constant_or_argument, constant),
        (matrix, "_infer_entry_dt", lambda v: kind_of(0.0 if isinstance(v, Number) else v), kind_of),
    ]
    for module, name, ours, _ in parts:
        setattr(module, name, ours)
    _reading.append(numbers)
    try:
        yield
    finally:
        _reading.pop()
        for module, name, _, theirs in parts:
            setattr(module, name, theirs)


class _Declaring:
    """Taichi's kernel that is being built, but for the arguments that it gets besides."""

    def __init__(self, kernel: Any, numbers: Numbers) -> None:
        self._kernel, self._numbers = kernel, numbers

    def __getattr__(self, name: str) -> Any:
        return getattr(self._kernel, name)

    def finalize_params(self) -> None:
        self._numbers.declare(self._kernel)
        self._kernel.finalize_params()
