"""Predicted against measured: a panel for each axis, as a picture. Imports matplotlib."""

from __future__ import annotations

import numpy as np

from uuvtai.identify.identified import Identified
from uuvtai.identify.motion_model import AXES
from uuvtai.report.figures import Line, curves
from uuvtai.report.ink import png

_SHOWN_S = 30.0


def prediction_png(found: Identified) -> bytes:
    """Measured speeds and those of the fitted vehicle, driven by the same rotor speeds, over the first half
    minute. The prediction begins anew with each stretch of the fit."""
    steps = found.measured.shape[1] - 1
    count = max(1, round(_SHOWN_S / (steps * found.dt_s)))
    time_s = np.arange(min(count, len(found.measured)) * steps) * found.dt_s
    panels = []
    for i, axis in enumerate(AXES):
        measured, predicted = (
            speeds[:count, :steps, i].ravel() for speeds in (found.measured, found.predicted)
        )
        seen = ~np.isnan(measured)
        lines = [
            Line("measured", time_s[seen].tolist(), measured[seen].tolist()),
            Line("predicted", time_s.tolist(), predicted.tolist()),
        ]
        panels.append(curves(lines, f"{axis} [{'rad/s' if axis == 'yaw' else 'm/s'}]", "time [s]"))
    return png(panels)
