"""What a log must hold for an axis to be identified, and what to drive where it does not."""

from __future__ import annotations

import numpy as np

from uuvtai.identify.drive_log import Drive
from uuvtai.identify.motion_model import AXES, Stretches

_FAST = (0.12, 0.12, 0.12, 0.15)
"""[m/s, m/s, m/s, rad/s] that a tenth of the readings must exceed"""
_VARIED = (0.05, 0.05, 0.05, 0.08)
"""standard deviation that the speed must have"""
_LEAST_READINGS = 200
_STEP_S, _STEP_RPM, _LEAST_STEPS = 0.1, 300.0, 20
"""jumps of a commanded speed that the rotors' lag can be seen in"""
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


def unstepped(drives: list[Drive]) -> str:
    """Why the drives do not show the rotors' lag, '' = they do."""
    asked = [drive for drive in drives if drive.is_asked]
    if not asked:
        return (
            "the log holds rotor speeds as turned (rpm_1, ..), which lag behind nothing: log those that were "
            "commanded (asked_1, ..)"
        )
    steps = 0
    for drive in asked:
        width = max(1, round(_STEP_S / drive.dt_s))
        risen = np.abs(drive.rpm[width::width] - drive.rpm[:-width:width][: len(drive.rpm[width::width])])
        steps += int((risen > _STEP_RPM).any(axis=1).sum())
    if steps >= _LEAST_STEPS:
        return ""
    return (
        f"the commanded speeds jump {steps} times by {_STEP_RPM:g} rpm within {_STEP_S:g} s, {_LEAST_STEPS} "
        "are needed: push the sticks forth and back at once, not slowly"
    )


MORE = {
    "added mass": "start, stop and turn round more often",
    "linear damping": "add slow legs (a fifth of full speed)",
    "quadratic damping": "add fast legs (full speed, held for three seconds)",
    "net buoyancy": "hover and heave up and down",
    "rotor lag": "log the commands 50 times a second, and push the sticks forth and back at once",
    "delay": "start, stop and turn round more often",
    "thruster gain": "drive for longer; with --known buoyancy, hang on a weight whose net force is known",
}
"""what narrows the interval of a parameter"""
