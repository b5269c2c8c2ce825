"""Sets of cells as bits: sixty-four neighbours of a row share a word, so that one operation asks or changes
all of them."""

import taichi as ti

from uuvtai.kernels.core.signature import Out
from uuvtai.native.gpu_shape import is_gpu_shaped

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
