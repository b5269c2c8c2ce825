"""Markers for kernel parameters, and the loop helper every per-env kernel uses.

A bundle says what a stage reads and what it writes: ``In[Struct]``, ``Out[Struct]``, ``Const[Section]`` (a
frozen config section whose numbers become constants of the compiled kernel); its kernels take ``io:
Bundle[..]`` and what changes from call to call, functions that serve one stage end in ``io``, and those that
several stages share take the structs and sections that they need, marked in the same way. For the type
checker these are the plain classes; for Taichi they are ``ti.template()``. Tensors of the caller are
``FloatMatrix`` and the like. A test reads all of this to prove who sees what.
"""

from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, TypeVar

import taichi as ti

from uuvtai.compile.launch import is_gpu_shaped
from uuvtai.state import ClockState

_T = TypeVar("_T")

if TYPE_CHECKING:
    In = Annotated[_T, "read only"]
    Out = Annotated[_T, "read and written"]
    Const = Annotated[_T, "compile-time constant"]
    Bundle = Annotated[_T, "what a stage reads and writes"]
    FloatVector = FloatMatrix = IntVector = ByteVector = AnyVector = AnyTensor = Any
else:
    FloatVector, FloatMatrix = ti.types.ndarray(dtype=ti.f32, ndim=1), ti.types.ndarray(dtype=ti.f32, ndim=2)
    IntVector, AnyVector = ti.types.ndarray(dtype=ti.i32, ndim=1), ti.types.ndarray(ndim=1)
    ByteVector = ti.types.ndarray(dtype=ti.u8, ndim=1)
    AnyTensor = ti.types.ndarray()

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


@ti.func
def loop_end(count, clock: In[ClockState]):
    """``count`` as the end of a parallel loop. The compiler cannot know that ``zero`` is 0, so the size of a
    block is worked out at run time, and our machine code makes blocks of any size; blocks of a loop whose end
    is known have 512 items or more (``compile/codegen.py``)."""
    return ti.min(count, count + clock.zero[None])


@ti.func
def n_envs(clock: In[ClockState]):
    """How many envs there are, as the end of a loop."""
    return loop_end(ti.static(clock.active.shape[0]), clock)


def shares(count: int) -> int:
    """Loop items among which an env's ``count`` rows or tracks are shared: one each on a GPU, one for all on
    a CPU, so that a reset of few rows asks every other env only once whether it is active."""
    return count if is_gpu_shaped() else 1


@ti.func
def fetch(element: Out[Any]):
    """Ask memory for a whole number that will be needed soon, without waiting for it: our machine code makes
    a prefetch of this "or" with 0 (``compile/codegen.py``). On a GPU it does nothing."""
    if ti.static(not is_gpu_shaped()):
        ti.atomic_or(element, element ^ element)  # a 0 of its type


# ------------------------------------------------------------------------------------------------------------
# What a group of columns of the observation is: the environment's table is read off these declarations, and
# the kernels write by them.


class ColumnGroup(NamedTuple):
    """A group of neighbouring columns of the observation, all of one quantity."""

    name: str
    width: int
    """columns of the env, or of each of its sectors or obstacles"""
    unit: str
    frame: str
    """"level" is the body frame without roll and pitch: x along the heading, y to its left, z up"""
    meaning: str
    source: Any
    """func that returns the values of one env, or the value of one of its sectors, or the values of all
    groups of one of its obstacles"""
    per: str = ""
    """'sector' or 'body': there are so many for each"""


# ------------------------------------------------------------------------------------------------------------
# Copy chosen rows of a field into a host buffer: recording must not copy every env to look at one.


@ti.kernel
def copy_rows(field: In[ti.Field], envs: IntVector, out: AnyTensor):
    """out[i] = field[envs[i]] for a field of rank 1, 2 or 3 (vectors add a last axis)."""
    for i in range(envs.shape[0]):
        env = envs[i]
        if ti.static(len(field.shape) == 1):
            _copy_cell(field, out, ti.Vector([env]), ti.Vector([i]))
        elif ti.static(len(field.shape) == 2):
            for j in range(ti.static(field.shape[1])):
                _copy_cell(field, out, ti.Vector([env, j]), ti.Vector([i, j]))
        else:
            for j, k in ti.ndrange(ti.static(field.shape[1]), ti.static(field.shape[2])):
                _copy_cell(field, out, ti.Vector([env, j, k]), ti.Vector([i, j, k]))


@ti.func
def _copy_cell(field: In[ti.Field], out: Out[ti.Field], source, target):
    if ti.static(hasattr(field, "n")):
        for c in ti.static(range(field.n)):
            out[target, c] = field[source][c]
    else:
        out[target] = field[source]
