"""What the vehicle has felt of its own motion, and what readings have corrected of the estimate of it.

Both are sums since the start; their differences between two steps carry a late reading forward, or take what
was estimated at a ping to what is known now. Neither may hold the other: a reading carried by an estimate
that later readings have corrected, or compared with one that they have not, has one error corrected once for
each reading on its way, and the estimate runs away (T. Larsen et al., Incorporation of time delayed
measurements in a discrete-time Kalman filter, CDC 1998).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from uuvtai.pilot.carrying import to_world


def _nothing() -> np.ndarray:
    return np.zeros(3)


@dataclass(frozen=True, eq=False)
class OwnPose:
    """What the pilot takes for its own pose and velocity at one moment."""

    pos_w: np.ndarray
    """(3,) [m]"""
    rpy: np.ndarray
    """(3,) [rad]"""
    vel_b: np.ndarray
    """(3,) [m/s]"""
    bias_b: np.ndarray = field(default_factory=_nothing)
    """(3,) [m/s^2] error of the accelerometer"""


@dataclass(eq=False)
class MotionSums:
    """Sums up to the present step."""

    won_b: np.ndarray = field(default_factory=_nothing)
    """(3,) [m/s] velocity by the accelerometer alone, less its error as it was known, body axes"""
    risen_m: float = 0.0
    """upwards, by the velocity alone"""
    bias_w: np.ndarray = field(default_factory=_nothing)
    """(3,) [m/s^2] corrections of the accelerometer's error,"""
    vel_w: np.ndarray = field(default_factory=_nothing)
    """(3,) [m/s] of the velocity, led back to time 0 by those,"""
    pos_w: np.ndarray = field(default_factory=_nothing)
    """(3,) [m] and of the position, led back by both"""
    yaw: float = 0.0
    """[rad] corrections of the heading"""

    def feel(self, accel_b: np.ndarray, vel_w: np.ndarray, dt_s: float) -> None:
        """A step of dt at an acceleration (3,) [m/s^2] and a velocity (3,) [m/s]."""
        self.won_b = self.won_b + dt_s * accel_b
        self.risen_m += dt_s * float(vel_w[2])

    def correct(self, expected: OwnPose, found: OwnPose, time_s: float) -> None:
        """Readings at ``time_s`` made ``found`` of what was ``expected``."""
        bias_w = to_world(found.bias_b - expected.bias_b, expected.rpy)
        vel_w = to_world(found.vel_b - expected.vel_b, expected.rpy)
        self.bias_w = self.bias_w + bias_w
        self.vel_w = self.vel_w + vel_w + time_s * bias_w
        self.pos_w = self.pos_w + found.pos_w - expected.pos_w - time_s * (vel_w + 0.5 * time_s * bias_w)
        self.yaw += float(found.rpy[2] - expected.rpy[2] + np.pi) % (2 * np.pi) - np.pi

    def noted(self) -> dict[str, np.ndarray]:
        """The sums, for a history."""
        return {name: np.array(value) for name, value in vars(self).items()}

    def known_now(self, then: OwnPose, noted: dict[str, np.ndarray], time_s: float) -> OwnPose:
        """``then``, the pose of ``time_s`` as it was taken to be when the sums were those ``noted``, as it is
        known now."""
        pos_w, vel_w, bias_w = (getattr(self, name) - noted[name] for name in ("pos_w", "vel_w", "bias_w"))
        return OwnPose(
            then.pos_w + pos_w + time_s * (vel_w - 0.5 * time_s * bias_w),
            then.rpy + np.array([0.0, 0.0, self.yaw - float(noted["yaw"])]),
            then.vel_b + to_body(vel_w - time_s * bias_w, then.rpy),
        )


def to_body(vector_w: np.ndarray, rpy: np.ndarray) -> np.ndarray:
    """(3,) of the world's axes in the body's."""
    return np.array([vector_w @ to_world(axis, rpy) for axis in np.eye(3)])
