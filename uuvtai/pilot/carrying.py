"""Readings that come late, carried forward to now by what the vehicle knows of its motion since.

The pose filter takes every reading for one of this very step. One of a tenth of a second ago is wrong by what
the vehicle has done meanwhile, which is far more than the instrument's own error.
"""

from __future__ import annotations

import numpy as np

from uuvtai.pilot.sensor_messages import ImuReading


def turned_on(imu: ImuReading, late_s: float) -> np.ndarray:
    """(3,) [rad] roll, pitch, yaw ``late_s`` after the reading, at its own rates (Fossen, Handbook of Marine
    Craft Hydrodynamics and Motion Control, 2011, eq. 2.28)."""
    rpy, (p, q, r) = np.asarray(imu.rpy, np.float64), np.asarray(imu.rate_b, np.float64)
    (sin_roll, sin_pitch, _), (cos_roll, cos_pitch, _) = np.sin(rpy), np.cos(rpy)
    turning = (q * sin_roll + r * cos_roll) / max(cos_pitch, 0.1)
    rates = np.array([p + sin_pitch * turning, q * cos_roll - r * sin_roll, turning])
    return rpy + late_s * rates


def acceleration_b(imu: ImuReading, vel_b: np.ndarray, gravity_m_s2: float) -> np.ndarray:
    """(3,) [m/s^2] rate of change of the velocity in body axes: specific force, gravity, and the turning of
    the axes."""
    roll, pitch, _ = np.asarray(imu.rpy, np.float64)
    down_b = np.array([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)])
    turning = np.cross(np.asarray(imu.rate_b, np.float64), np.asarray(vel_b, np.float64))
    return np.asarray(imu.specific_force_b, np.float64) - gravity_m_s2 * down_b - turning


def to_world(vector_b: np.ndarray, rpy: np.ndarray) -> np.ndarray:
    """(3,) of body axes in the world's."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(rpy), np.cos(rpy)
    rotation = np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
    return rotation @ np.asarray(vector_b, np.float64)
