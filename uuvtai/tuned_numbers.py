"""Numbers of the behaviour tree that ``uuv train tuned`` changes, row by row: the order of
``TeacherState.tuned``."""

from __future__ import annotations

import math
from typing import NamedTuple

CAUTION, GROWTH, CLOSING, HORIZON, LAG, DEVIATION, TTC, RANGE, CALM, GAZE = range(10)


class TunedNumber(NamedTuple):
    """A number of the config's section ``teacher``."""

    name: str
    least: float
    """smallest factor that is tried"""
    most: float
    """largest one"""


TUNED = (
    TunedNumber("caution", 0.6, 1.6),
    TunedNumber("margin_growth_m_s", 0.5, 2.0),
    TunedNumber("closing_s", 0.5, 2.0),
    TunedNumber("horizon_s", 0.4, 1.0),
    TunedNumber("lag_s", 0.5, 1.6),
    TunedNumber("weight_deviation", 0.4, 2.5),
    TunedNumber("emergency_ttc_s", 0.15, 2.0),
    TunedNumber("emergency_range_m", 0.15, 2.0),
    TunedNumber("calm_s", 0.3, 3.0),
    TunedNumber("gaze_m", 0.2, 1.6),
)
"""by their numbers above; roll-outs are no longer than the config's horizon, for forecasts end there"""


def log_bounds() -> tuple[list[float], list[float]]:
    """(smallest, largest) natural logarithms of the factors."""
    return [math.log(number.least) for number in TUNED], [math.log(number.most) for number in TUNED]
