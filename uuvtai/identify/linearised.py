"""Derivatives of the readings with respect to parameters and initial velocities, by differences."""

from __future__ import annotations

import numpy as np

from uuvtai.config import VehicleConfig
from uuvtai.identify.motion_model import AXES, Stretches, readings

SCALE = np.array(
    [1.0] * 3 + [0.05] + [1.0] * 3 + [0.05] + [5.0] * 3 + [0.3] + [0.5, 0.1] + [0.02, 0.01, 0.01]
)
"""size of a step of each parameter"""


def linearised(
    given: Stretches,
    vehicle_cfg: VehicleConfig,
    value: np.ndarray,
    start: np.ndarray,
    free: np.ndarray,
    noise: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(s, readings, free), (s, readings, 4), (s, readings): derivatives and what is left, in units of
    noise."""
    places = np.flatnonzero(free)
    runs = 1 + len(places) + len(AXES)
    theta, begin = np.tile(value, (runs, 1)), np.tile(start, (runs, 1, 1))
    small = 1e-4
    for i, place in enumerate(places):
        theta[1 + i, place] += small * SCALE[place]
    for axis in range(len(AXES)):
        begin[1 + len(places) + axis, :, axis] += small
    moved = readings(theta, begin, given, vehicle_cfg) / noise
    seen = ~np.isnan(given.velocity)
    rest = np.where(seen, np.nan_to_num(given.velocity) / noise - moved[0], 0.0)
    slopes = np.where(seen, (moved[1:] - moved[0]) / small, 0.0)
    count = len(given.velocity)
    flat = np.moveaxis(slopes.reshape(runs - 1, count, -1), 0, 2)
    return flat[..., : len(places)], flat[..., len(places) :], rest.reshape(count, -1)
