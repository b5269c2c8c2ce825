"""Binary min-heap of cells, one per slot. Old entries of a cell stay until they surface.

An entry is one number that sorts as it should: the key's bits (those of a float32 that is not negative are in
its order), then the cell.
"""

import taichi as ti

from uuvtai.kernels.core.signature import In, Out
from uuvtai.state import VoronoiState


@ti.func
def entry_of(cell, key):
    """Entry of a cell with a key >= 0."""
    return (ti.cast(ti.bit_cast(ti.cast(key, ti.f32), ti.u32), ti.u64) << 32) | ti.cast(cell, ti.u64)


@ti.func
def top_cell(voronoi: In[VoronoiState], slot):
    """Cell with the smallest key; of equal keys, the smallest cell."""
    return ti.cast(voronoi.heap[slot, 0] & ti.u64(0xFFFFFFFF), ti.i32)


@ti.func
def heap_after_push(voronoi: Out[VoronoiState], slot, size, cell, key):
    """Insert; returns the new size. The caller makes sure that there is room."""
    put_rising(voronoi, slot, size, entry_of(cell, key))
    return size + 1


@ti.func
def heap_after_pop(voronoi: Out[VoronoiState], slot, size):
    """Remove the top (read it before); returns the new size.

    The hole sinks to the bottom along the smaller children without asking where the last entry would stop: it
    almost always belongs down there, and a comparison that cannot be predicted costs more than a step up
    again.
    """
    # Bottom-up heapsort's sift (Wegener 1993, Theoretical Computer Science 118)
    last = size - 1
    moved = voronoi.heap[slot, last]
    place, below = 0, 1
    while below < last:
        left, right = (
            voronoi.heap[slot, below],
            voronoi.heap[slot, below + 1],
        )  # at the end of the heap right is ``moved``: harmless
        below += ti.cast(right < left, ti.i32)
        voronoi.heap[slot, place] = ti.min(left, right)
        place = below
        below = 2 * place + 1
    put_rising(voronoi, slot, place, moved)
    return last


@ti.func
def put_rising(voronoi: Out[VoronoiState], slot, hole, entry):
    """Put an entry into a hole at the bottom or above, where it belongs."""
    place = hole
    rising = 1
    while rising == 1 and place > 0:
        above = (place - 1) // 2
        upper = voronoi.heap[slot, above]
        if entry < upper:
            voronoi.heap[slot, place] = upper
            place = above
        else:
            rising = 0
    voronoi.heap[slot, place] = entry
