"""What sensors tell the pilot. Every message carries the time at which it was measured, in seconds of the
pilot's clock (0 = its first step); it may arrive later, out of order, twice or never."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class ImuReading:
    """Attitude, rates and acceleration in one message."""

    time_s: float
    rpy: np.ndarray
    """(3,) [rad] roll, pitch, yaw; yaw counter-clockwise from the world's x axis"""
    rate_b: np.ndarray
    """(3,) [rad/s] gyro, body axes (x ahead, y left, z up)"""
    specific_force_b: np.ndarray
    """(3,) [m/s^2] acceleration less gravity, body axes: at rest (0, 0, 9.81)"""


@dataclass(frozen=True, eq=False)
class DvlReading:
    """A valid velocity; while the bottom is lost there is no message."""

    time_s: float
    vel_b: np.ndarray
    """(3,) [m/s] over ground, body axes"""


@dataclass(frozen=True, eq=False)
class PressureReading:
    """Depth by pressure."""

    time_s: float
    depth_m: float
    """[m] positive down; zeroed at the known start (reading there less the start's depth) unless the
    position is given"""


@dataclass(frozen=True, eq=False)
class PositionFix:
    """A position from elsewhere, needed unless the pilot estimates its own (``sensors.localization``)."""

    time_s: float
    pos_w: np.ndarray
    """(3,) [m] world"""


@dataclass(frozen=True, eq=False)
class SonarPing:
    """A scan of all beams, in the order of ``SonarConfig``; ``time_s`` is that of the ping. Of a mechanical
    beam (``sensors.sonar.mechanical``): the one or the few neighbouring beams that were taken then, n of them
    in place of n_ray."""

    time_s: float
    range_m: np.ndarray
    """(n_ray,) [m] counter-clockwise, beam 0 of a ring ahead, of a fan at its right edge; without a return
    anything finite"""
    hit: np.ndarray
    """(n_ray,) 1 = return"""
    doppler_m_s: np.ndarray
    """(n_ray,) [m/s] rate of change of the distance to what returned, own motion included; empty where the
    sonar measures none (``sensors.sonar.doppler``)"""
    first_beam: int = 0
    """number of the first of these beams; 0 unless the beam is a mechanical one"""


@dataclass(frozen=True, eq=False)
class DepthShot:
    """An image of the forward depth camera."""

    time_s: float
    depth_m: np.ndarray
    """(rows, columns) [m] z-depth, row 0 at the top; no return = maximum range"""


@dataclass(frozen=True, eq=False)
class ThrusterLoss:
    """A vertical thruster is dead, until the end."""

    time_s: float
    thruster: float
    """its number, counted from 1; -1 = not known, or only suspected"""


SensorMessage = ImuReading | DvlReading | PressureReading | PositionFix | SonarPing | DepthShot | ThrusterLoss
KINDS: dict[str, type] = {
    "imu": ImuReading,
    "dvl": DvlReading,
    "pressure": PressureReading,
    "position": PositionFix,
    "sonar": SonarPing,
    "depth": DepthShot,
    "thruster": ThrusterLoss,
}
"""what a message is called where it is counted, lost or old"""
NAMES = {kind: name for name, kind in KINDS.items()}

LIMITS = {
    "rpy": 100.0,
    "rate_b": 50.0,
    "specific_force_b": 500.0,
    "vel_b": 50.0,
    "pos_w": 1e5,
    "depth_m": 1e5,
    "range_m": 1e5,
    "doppler_m_s": 1e3,
    "hit": 1.0,
    "thruster": 100.0,
    "first_beam": 1e5,
}
"""largest size that is believed, far above what any of these instruments says: a number that is larger, or
not finite, makes the message a bad one"""
