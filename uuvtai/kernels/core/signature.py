"""Markers for kernel parameters, and the loop helper every per-env kernel uses.

A bundle says what a stage reads and what it writes: ``In[Struct]``, ``Out[Struct]``, ``Const[Section]`` (a
frozen config section whose numbers become constants of the compiled kernel); its kernels take ``io:
Bundle[..]`` and what changes from call to call, functions that serve one stage end in ``io``, and those that
several stages share take the structs and sections that they need, marked in the same way. For the type
checker these are the plain classes; for Taichi they are ``ti.template()``. Tensors of the caller are
``FloatMatrix`` and the like. ``tests/test_architecture.py`` reads all of this to prove who sees what.
``quick_launch`` makes launching cheap.
"""

from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, TypeVar

import taichi as ti
from taichi.lang import impl

_T = TypeVar("_T")

if TYPE_CHECKING:
    In = Annotated[_T, "read only"]
    Out = Annotated[_T, "read and written"]
    Const = Annotated[_T, "compile-time constant"]
    Bundle = Annotated[_T, "what a stage reads and writes"]
    FloatVector = FloatMatrix = IntVector = LongVector = AnyVector = AnyTensor = Any
else:
    FloatVector, FloatMatrix = ti.types.ndarray(dtype=ti.f32, ndim=1), ti.types.ndarray(dtype=ti.f32, ndim=2)
    IntVector, LongVector = ti.types.ndarray(dtype=ti.i32, ndim=1), ti.types.ndarray(dtype=ti.i64, ndim=1)
    AnyVector, AnyTensor = ti.types.ndarray(ndim=1), ti.types.ndarray()

    class _Marker:
        def __class_getitem__(cls, _item):
            return ti.template()

    class In(_Marker):
        """A struct that the kernel only reads."""

    class Out(_Marker):
        """A struct that the kernel writes (and may read)."""

    class Const(_Marker):
        """A frozen config section: its values are constants of the compiled kernel."""

    class Bundle(_Marker):
        """All that a stage reads and writes, in one frozen dataclass."""


_CPU_BLOCK = 512
"""Taichi's CPU scheduler never splits a loop into blocks of fewer items than this (measured on 1.7.4)."""

_BLOCKS = 16
"""Blocks wanted per loop, so that two to sixteen cores share unequal work evenly."""


def spread(n_env: int) -> int:
    """Loop items per env that make ``ti.ndrange(n_env, spread(n_env))`` fill every core; use only the items
    with ``pad == 0``."""
    return max(1, min(_CPU_BLOCK, -(-_CPU_BLOCK * _BLOCKS // n_env)))


class _Launch(NamedTuple):
    """A kernel compiled for one list of arguments."""

    program: Any
    """Taichi's; another one after a restart knows nothing of this kernel"""
    kernel: Any
    compiled: Any
    arguments: tuple
    """kept alive: their identities are the key"""
    given: list
    """(what it is declared as, value) of the arguments that are no compile-time ones: int, float, tensors"""


_MOST_LAUNCHES = 64
"""Lists of arguments remembered per kernel."""


def quick_launch(launch: _T) -> _T:
    """Decorator above Taichi's: launch again with the very same objects without looking at them again.

    Taichi inspects every argument and hashes every section at every launch, which costs more than many
    kernels do. Here the first launch goes through Taichi; later ones with the same structs, sections, numbers
    and tensors go straight to the compiled kernel. For kernels whose arguments live as long as the simulator:
    they are kept alive.
    """
    kernel, known = launch._primal, {}  # type: ignore[attr-defined]

    def again(*arguments):
        key = tuple(map(id, arguments))
        found = known.get(key)
        if found is None or found.program is not impl.get_runtime().prog:
            launch(*arguments)  # type: ignore[operator]
            if len(known) >= _MOST_LAUNCHES:
                known.clear()
            given = [
                (d.annotation, a)
                for a, d in zip(arguments, kernel.arguments, strict=True)
                if not isinstance(d.annotation, ti.template)
            ]
            if all(declared in (int, float) or hasattr(value, "data_ptr") for declared, value in given):
                known[key] = _compiled(kernel, arguments, given)
        else:
            context = found.kernel.make_launch_context()
            for number, (declared, value) in enumerate(found.given):
                _set_argument(context, number, declared, value)
            found.program.launch_kernel(found.compiled, context)

    again.__name__, again.__doc__ = launch.__name__, launch.__doc__  # type: ignore[attr-defined]
    return again  # type: ignore[return-value]


def _compiled(kernel: Any, arguments: tuple, given: list) -> _Launch:
    program: Any = impl.get_runtime().prog
    for_arguments = kernel.compiled_kernels[kernel.ensure_compiled(*arguments)]
    compiled = program.compile_kernel(program.config(), program.get_device_caps(), for_arguments)
    return _Launch(program, for_arguments, compiled, arguments, given)


def _set_argument(context: Any, number: int, declared: Any, value: Any) -> None:
    if declared is int:
        context.set_arg_int((number,), value)
    elif declared is float:
        context.set_arg_float((number,), value)
    else:
        size = value.element_size() * value.nelement()
        context.set_arg_external_array_with_shape((number,), value.data_ptr(), size, tuple(value.shape), 0)
