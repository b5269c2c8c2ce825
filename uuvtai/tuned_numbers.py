"""Numbers of the behaviour tree that ``uuv train best`` changes, row by row: the order of
``TeacherState.tuned``."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from uuvtai.config import Config

SLOW, FAST = 0, 1
"""last axis of ``TeacherState.tuned``: which bodies the factors are for"""

CAUTION, GROWTH, CLOSING, HORIZON, LAG, DEVIATION, TTC, RANGE, CALM, GAZE = range(10)
VERTICAL, PEAK, MEAN, CONTACT, CHANGE, SOFTNESS, STATIC_MARGIN, STATIC, HEAVE, BURST = range(10, 20)
WITHIN, SLOPE, GOAL_DEPTH, DEPTH_CHANGE, DOUBT, ARRIVAL = range(20, 26)


class TunedNumber(NamedTuple):
    """A number of the config's section ``teacher``; the sections ``slow`` and ``fast`` have a factor of the
    same name."""

    name: str
    least: float
    """smallest factor that is tried"""
    most: float
    """largest one"""


TUNED = (
    TunedNumber("caution", 0.4, 1.6),
    TunedNumber("margin_growth_m_s", 0.4, 2.0),
    TunedNumber("closing_s", 0.4, 2.5),
    TunedNumber("horizon_s", 0.5, 1.0),
    TunedNumber("lag_s", 0.5, 1.6),
    TunedNumber("weight_deviation", 0.4, 2.5),
    TunedNumber("emergency_ttc_s", 0.15, 2.0),
    TunedNumber("emergency_range_m", 0.15, 2.5),
    TunedNumber("calm_s", 0.3, 4.0),
    TunedNumber("gaze_m", 0.1, 1.6),
    TunedNumber("vertical_weight", 0.5, 1.6),
    TunedNumber("weight_peak", 0.4, 5.0),
    TunedNumber("weight_mean", 0.4, 5.0),
    TunedNumber("weight_contact", 0.4, 4.0),
    TunedNumber("weight_change", 0.3, 2.5),
    TunedNumber("softness", 0.2, 3.0),
    TunedNumber("static_margin_m", 0.25, 2.5),
    TunedNumber("weight_static", 0.4, 4.0),
    TunedNumber("heave_m_s", 0.5, 1.1),
    TunedNumber("burst_s", 0.4, 2.0),
    TunedNumber("conflict_within_s", 0.3, 1.0),
    TunedNumber("return_slope", 0.4, 4.0),
    TunedNumber("weight_goal_depth", 0.3, 3.0),
    TunedNumber("weight_depth_change", 0.3, 3.0),
    TunedNumber("body_doubt", 0.1, 2.0),
    TunedNumber("arrival_depth_share", 0.1, 1.4),
)
"""by their numbers above, new ones last: a checkpoint without them drives by factors of one; roll-outs are no
longer than the config's horizon, for forecasts end there"""


def log_bounds() -> tuple[list[float], list[float]]:
    """(smallest, largest) natural logarithms of the factors."""
    return [math.log(number.least) for number in TUNED], [math.log(number.most) for number in TUNED]


def configured_factors(config: Config) -> np.ndarray:
    """(n_tuned, 2) natural logarithms of the factors in ``config.slow`` and ``config.fast``, float32."""
    factors = [[getattr(part, number.name) for part in (config.slow, config.fast)] for number in TUNED]
    return np.log(np.array(factors)).astype(np.float32)
