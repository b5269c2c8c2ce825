"""Vector code from Taichi 1.7.4, which never turns a loop over rows of fields into vectors by itself. Two
ways (measured):

1. Sixteen-lane packets. Expressions of fixed vectors become vector code. Fill lanes with ``ti.static`` loops;
   never rebind a lane vector to its own name inside a loop (``b = ti.sqrt(b)`` can silently keep the old
   lanes): use a new name. Good for few quantities and long loops.
2. Columns. Copy what some rows need into local matrices (a row per quantity, a column per lane), then loop
   over the columns with a plain ``for lane in range(lanes)`` whose body is scalar code on ``column(...)`` and
   touches nothing but local variables: LLVM turns that loop into vectors, branches included. One load of a
   field in the loop, or a loop inside it, and it stays scalar. Good for much work per row.

Test every packet kernel against a scalar reference.
"""

from typing import Any

import taichi as ti

from uuvtai.compile.launch import is_gpu_shaped
from uuvtai.kernels.core.stage import Const, In, Out
from uuvtai.state import ClockState

LANES = 16
"""Width of one packet: one AVX-512 register of float32."""

f16x = ti.types.vector(LANES, ti.f32)
i16x = ti.types.vector(LANES, ti.i32)


_COLUMNS = 8
"""Columns on a CPU: LLVM prefers vectors of 256 bits even where there are longer ones, and every element
costs compile time."""

_WARP = 32  # Threads of a GPU that go in step.


def n_column() -> int:
    """Rows that one loop item takes together; one on a GPU, whose threads are lanes already. Plain Python."""
    return 1 if is_gpu_shaped() else _COLUMNS


def n_lane() -> int:
    """Lanes of a packet whose width its functions take from their arguments; one on a GPU, where sixteen
    would need more registers than a thread has. Plain Python."""
    return 1 if is_gpu_shaped() else LANES


def n_item() -> int:
    """Loop items that share the map and the clearance of an env: a warp on a GPU, one on a CPU. Plain
    Python."""
    return _WARP if is_gpu_shaped() else 1


def n_turn(count: int) -> int:
    """Turns in which the items of an env get through so many things, one each in a turn. Plain Python."""
    return -(-count // n_item())


@ti.func
def ramp(first, lanes: Const[int]):
    """(first, first + 1, ...)."""
    return ti.Vector([first + float(i) for i in range(lanes)])


@ti.func
def filled(value, lanes: Const[int]):
    """A packet of float32 with one value in all lanes."""
    return ti.Vector([ti.cast(value, ti.f32) for _ in range(lanes)])


@ti.func
def filled_int(value, lanes: Const[int]):
    """A packet of int32 with one value in all lanes."""
    return ti.Vector([ti.cast(value, ti.i32) for _ in range(lanes)])


@ti.func
def column(matrix: In[Any], lane):
    """Vector of one lane of a local matrix."""
    return ti.Vector([matrix[row, lane] for row in range(matrix.n)])


@ti.func
def row_lanes(matrix: In[Any], row: Const[int]):
    """A row of a local matrix as a packet."""
    return ti.Vector([matrix[row, lane] for lane in range(matrix.m)])


@ti.func
def put_column(matrix: Out[Any], lane, values):
    """Write one lane of a local matrix."""
    for row in ti.static(range(matrix.n)):
        matrix[row, lane] = values[row]


@ti.func
def lane_bits(condition):
    """Bit i is 1 where the condition holds in lane i."""
    weights = ti.Vector(ti.static([1 << i for i in range(LANES)]))
    return ti.select(condition, weights, 0).sum()  # type: ignore[misc]


@ti.func
def n_active(first, lanes: Const[int], clock: In[ClockState]):
    """How many of the rows from ``first`` on are processed in this pass; the last packet may be short."""
    count = 0
    for env in range(first, ti.min(first + lanes, ti.static(clock.active.shape[0]))):
        count += clock.active[env]
    return count


@ti.func
def is_active(env, clock: In[ClockState]):
    """Whether a row exists and is processed in this pass."""
    n = ti.static(clock.active.shape[0])
    return env < n and clock.active[ti.min(env, n - 1)] == 1


# ------------------------------------------------------------------------------------------------------------
# Sets of cells as bits: sixty-four neighbours of a row share a word, so that one operation asks or changes
# all of them.


WORD = 64
"""Cells of one word."""


@ti.func
def cell_bit(col):
    """The bit of a column in its word."""
    return ti.cast(1, ti.u64) << ti.cast(col % WORD, ti.u64)


@ti.func
def lowest_bit(word):
    """Number of the lowest bit that is set; the word must not be 0."""
    below = (word & (~word + ti.cast(1, ti.u64))) - ti.cast(1, ti.u64)
    return ti.cast(ti.math.popcnt(below), ti.i32)


@ti.func
def highest_bit(word):
    """Number of the highest bit that is set; the word must not be 0."""
    return WORD - 1 - ti.cast(ti.math.clz(ti.cast(word, ti.i64)), ti.i32)


@ti.func
def without_lowest(word):
    """The word with its lowest bit cleared."""
    return word & (word - ti.cast(1, ti.u64))


@ti.func
def bit_of(word, number):
    """0 or 1."""
    return ti.cast((word >> ti.cast(number, ti.u64)) & ti.cast(1, ti.u64), ti.i32)


@ti.func
def with_bit(word, number, value):
    """The word with one bit set to 0 or 1."""
    place = ti.cast(number, ti.u64)
    return (word & ~(ti.cast(1, ti.u64) << place)) | (ti.cast(value, ti.u64) << place)


@ti.func
def put_bit(words: Out[ti.Field], first, row, col):
    """Set the bit of a cell; ``first`` is an env or a slot. On a GPU others may set theirs in the same
    word."""
    if ti.static(is_gpu_shaped()):
        ti.atomic_or(words[first, row, col // WORD], cell_bit(col))
    else:
        words[first, row, col // WORD] = words[first, row, col // WORD] | cell_bit(col)


@ti.func
def flip_bit(words: Out[ti.Field], first, row, col):
    """Turn the bit of a cell over, as ``put_bit`` sets it."""
    if ti.static(is_gpu_shaped()):
        ti.atomic_xor(words[first, row, col // WORD], cell_bit(col))
    else:
        words[first, row, col // WORD] = words[first, row, col // WORD] ^ cell_bit(col)


@ti.func
def taken(words: Out[ti.Field], first, row, word):
    """A word that was left for one reader; it is used up."""
    found = words[first, row, word]
    if found != 0:
        words[first, row, word] = ti.cast(0, ti.u64)
    return found
