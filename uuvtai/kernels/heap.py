"""Binary min-heap of cells by key, one per slot, in two fields (n_slot, n_heap). Old entries of a cell stay until they surface."""

import taichi as ti

from uuvtai.kernels.signature import Out
from uuvtai.state import VoronoiState


@ti.func
def heap_after_push(heap: Out[VoronoiState], slot, size, cell, key):
    """Insert; returns the new size. The caller makes sure that there is room."""
    place = size
    rising = 1
    while rising == 1 and place > 0:
        above = (place - 1) // 2
        above_key = heap.heap_key[slot, above]
        if key < above_key:
            heap.heap_key[slot, place] = above_key
            heap.heap_cell[slot, place] = heap.heap_cell[slot, above]
            place = above
        else:
            rising = 0
    heap.heap_key[slot, place] = key
    heap.heap_cell[slot, place] = cell
    return size + 1


@ti.func
def heap_after_pop(heap: Out[VoronoiState], slot, size):
    """Remove the top (read it before); returns the new size."""
    last = size - 1
    key = heap.heap_key[slot, last]
    cell = heap.heap_cell[slot, last]
    place = 0
    below = 1
    while below < last:
        below_key = heap.heap_key[slot, below]
        if below + 1 < last:
            right_key = heap.heap_key[slot, below + 1]
            if right_key < below_key:
                below += 1
                below_key = right_key
        if below_key < key:
            heap.heap_key[slot, place] = below_key
            heap.heap_cell[slot, place] = heap.heap_cell[slot, below]
            place = below
            below = 2 * place + 1
        else:
            below = last
    heap.heap_key[slot, place] = key
    heap.heap_cell[slot, place] = cell
    return last
