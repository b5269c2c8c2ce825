"""What a log must hold for an axis to be identified, and what to drive where it does not."""

from __future__ import annotations

import numpy as np

from uuvtai.identify.motion_model import AXES, Stretches

_FAST = (0.12, 0.12, 0.12, 0.15)
"""[m/s, m/s, m/s, rad/s] that a tenth of the readings must exceed"""
_VARIED = (0.05, 0.05, 0.05, 0.08)
"""standard deviation that the speed must have"""
_LEAST_READINGS = 200
LEAST_STRETCHES = 12
"""a bootstrap over fewer says nothing"""


def unexcited(given: Stretches) -> dict[str, str]:
    """Axes that the readings do not excite: name -> what was driven and what to drive."""
    found = {}
    for i, axis in enumerate(AXES):
        speed = given.velocity[..., i]
        speed = speed[~np.isnan(speed)]
        unit, full = ("rad/s", "1.0") if axis == "yaw" else ("m/s", "0.5")
        if len(speed) < _LEAST_READINGS:
            found[axis] = f"{axis} has {len(speed)} readings: log its speed"
            continue
        fast, varied = float(np.percentile(np.abs(speed), 90)), float(speed.std())
        if fast < _FAST[i] or varied < _VARIED[i]:
            found[axis] = (
                f"{axis} stayed below {fast:.2f} {unit} for nine tenths of the log: drive it forth and back, "
                f"each leg one to four seconds, at speeds from {_FAST[i]:g} to {full} {unit}"
            )
    return found


MORE = {
    "added mass": "start, stop and turn round more often",
    "linear damping": "add slow legs (a fifth of full speed)",
    "quadratic damping": "add fast legs (full speed, held for three seconds)",
    "net buoyancy": "hover and heave up and down",
    "thruster gain": "drive for longer; with --known buoyancy, hang on a weight whose net force is known",
}
"""what narrows the interval of a parameter"""
