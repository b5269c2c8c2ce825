"""The known bounds of the tank on the map's grid, put where the kernels read them."""

from __future__ import annotations

import numpy as np

from uuvtai.kernels.core.bits import WORD
from uuvtai.state import GridMask
from uuvtai.taichi_patches.memory import Put, put_by_kernel


def load_bounds(mask: GridMask, outside: np.ndarray, put: Put = put_by_kernel) -> None:
    """``outside``: booleans (n_row, n_col), True outside the tank (``kernels.grid.outside_cells``)."""
    n_row, n_col = outside.shape
    padded = np.zeros((n_row, -(-n_col // WORD) * WORD), dtype=bool)
    padded[:, :n_col] = outside
    put(mask.outside, outside.astype(np.int32))
    put(mask.outside_bits, np.packbits(padded, axis=1, bitorder="little").view("<u8").astype(np.uint64))
