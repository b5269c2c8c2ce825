"""Numbers of the config that kernels are told at every launch, so that another threshold is no other code.

While Taichi reads a kernel, a float of a section is a ``Number``: one can reckon with it in Python, and what
comes out becomes an argument of the kernel, rounded once as a constant would be. Whatever else is done with
it, for example a comparison that decides what code there is, is done with its value and noted: the code
depends on what came of it.
"""

from __future__ import annotations

import contextlib
import json
import math
import operator
from collections.abc import Callable, Iterator
from numbers import Number as PythonNumber
from typing import Any

import numpy as np
import taichi as ti
from taichi.lang import expr, impl, kernel_impl, matrix
from taichi.lang._ndrange import GroupedNDRange

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
    try:
        yield
    finally:
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
