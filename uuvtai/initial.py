"""A new simulator's arrays: every struct, and what no step changes."""

from __future__ import annotations

import dataclasses
from typing import get_type_hints

import numpy as np

from uuvtai import state
from uuvtai.allocation import allocation_matrices
from uuvtai.config import Config
from uuvtai.kernels.core.bits import WORD
from uuvtai.kernels.core.grid import outside_cells
from uuvtai.scenario import load_fixed
from uuvtai.stages import SimState
from uuvtai.state import GridMask
from uuvtai.taichi_patches.memory import Put, put_by_kernel
from uuvtai.tuned_numbers import configured_factors

LENGTHENED = (
    *("n_ray", "n_pixel_row", "n_pixel_col", "n_latency", "n_delay"),
    *("n_echo", "n_heard", "n_bin", "n_elevation", "n_trial", "n_control"),
    *("n_future", "n_past", "n_bend", "n_frame", "n_column", "n_hidden", "n_said", "n_weight"),
)
"""axes whose lengths follow from sensors and options"""


def allocate_state(sizes: dict[str, int]) -> SimState:
    """Every struct, with the lengths of ``sizes.array_sizes``; those that other options lengthen lie last, so
    that the others keep their places, and what was compiled for them holds."""
    kinds = get_type_hints(SimState)
    built = {name: state.allocate(kinds[name], sizes) for name in sorted(kinds, key=lambda n: rank(kinds[n]))}
    return SimState(**built)


def rank(kind: type) -> int:
    """0 for a struct that has the same length whatever sensors and options are; else how late it lies."""
    axes = {axis for declared in dataclasses.fields(kind) for axis in declared.metadata["shape"]}
    return max((LENGTHENED.index(axis) + 1 for axis in axes.intersection(LENGTHENED)), default=0)


def fill_constants(s: SimState, config: Config, put: Put) -> None:
    """What no step changes: explicit obstacles, the tank's bounds on the map, the thrusters' geometry, a
    learned forecast, factors on the tree's numbers. Raises ForecastError, FileError."""
    if config.forecast.learned:
        from uuvtai.mixture_weights import put_weights, read_weights

        put_weights(s.mixture, read_weights(config.forecast.learned), put)
    put(s.table.factor, configured_factors(config))
    load_fixed(s.fixed, config.world)
    load_bounds(s.mask, np.array(outside_cells(config.world.tank, config.mapping.cell_m)), put)
    wrench_of_thrust, thrust_of_wrench = allocation_matrices(config.vehicle)
    put(s.allocation.wrench_of_thrust, wrench_of_thrust.astype(np.float32))
    put(s.allocation.thrust_of_wrench, thrust_of_wrench.astype(np.float32))


def load_bounds(mask: GridMask, outside: np.ndarray, put: Put = put_by_kernel) -> None:
    """``outside``: booleans (n_row, n_col), True outside the tank (``kernels.grid.outside_cells``)."""
    n_row, n_col = outside.shape
    padded = np.zeros((n_row, -(-n_col // WORD) * WORD), dtype=bool)
    padded[:, :n_col] = outside
    put(mask.outside, outside.astype(np.int32))
    put(mask.outside_bits, np.packbits(padded, axis=1, bitorder="little").view("<u8").astype(np.uint64))
