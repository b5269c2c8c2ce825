"""Spaces of actions and observations, with bounds where the simulator keeps them."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces

from uuvtai.config import Config
from uuvtai.env import NUM_ACTIONS, ObservationColumn


def action_space() -> spaces.Box:
    """Surge, sway, heave, yaw rate in parts of the vehicle's limits."""
    return spaces.Box(-1.0, 1.0, (NUM_ACTIONS,), np.float32)


def observation_space(table: tuple[ObservationColumn, ...], config: Config) -> spaces.Box:
    """Float32 box (n_obs,) in the units of ``table``; what noise or drift may carry anywhere is unbounded."""
    known = bounds(config)
    low, high = (np.full(table[-1].slice.stop, value, np.float32) for value in (-np.inf, np.inf))
    for column in table:
        low[column.slice], high[column.slice] = known.get(column.name, (-np.inf, np.inf))
    return spaces.Box(low, high, dtype=np.float32)


def bounds(config: Config) -> dict[str, tuple[float, float]]:
    """(low, high) of the columns that cannot leave them, by name."""
    ttc_s = config.features.ttc_cap_s
    return {
        "heading_error": (-1.0, 1.0),
        "sector_range": (0.0, config.sensors.sonar.max_range_m),
        "sector_ttc": (0.0, ttc_s),
        "path_risk": (0.0, np.inf),
        "body_valid": (0.0, 1.0),
        "body_age": (0.0, np.inf),
        "body_closest_time": (0.0, np.inf),
        "teacher_conflict": (0.0, ttc_s),
        "teacher_class": (0.0, 1.0),
    }
