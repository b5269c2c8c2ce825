"""What the physics answers ArduSub: one line of JSON. Pure functions.

Ours: world x north, y west, z up; body x ahead, y left, z up. ArduSub's: north, east, down; ahead, right,
down. Its parser (SIM_JSON.cpp) finds keys by their text and wants no space after a colon, three numbers to a
vector, and a line between two line feeds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

Three = tuple[float, float, float]


@dataclass(frozen=True)
class Motion:
    """What the vehicle does, in our axes."""

    time_s: float
    pos_w: Three
    vel_w: Three
    quat_wb: tuple[float, float, float, float]
    rate_b: Three
    specific_force_b: Three
    altitude_m: float
    """above the floor"""
    volts: float = 16.0
    amperes: float = 1.0


def turned_over(vector: Sequence[float]) -> Three:
    """Of either axes in the other: y and z change sign."""
    return float(vector[0]), 0.0 - float(vector[1]), 0.0 - float(vector[2])


def reply_of(motion: Motion) -> bytes:
    """The line. ValueError for a number that is not finite."""
    w, x, y, z = motion.quat_wb
    text = (
        f'\n{{"timestamp":{motion.time_s:.6f},'
        f'"imu":{{"gyro":{_vector(turned_over(motion.rate_b))},'
        f'"accel_body":{_vector(turned_over(motion.specific_force_b))}}},'
        f'"position":{_vector(turned_over(motion.pos_w))},'
        f'"quaternion":{_vector((w, x, 0.0 - y, 0.0 - z))},'
        f'"velocity":{_vector(turned_over(motion.vel_w))},'
        f'"rng_1":{motion.altitude_m:.4f},'
        f'"battery":{{"voltage":{motion.volts:.3f},"current":{motion.amperes:.3f}}}}}\n'
    )
    if "nan" in text or "inf" in text:
        raise ValueError(f"the physics gave a number that is not finite: {text.strip()}")
    return text.encode()


def _vector(values: Sequence[float]) -> str:
    return "[" + ",".join(f"{value:.9g}" for value in values) + "]"


def euler_of(quat_wb: Sequence[float]) -> Three:
    """[rad] roll, pitch, yaw in the axes of the quaternion."""
    w, x, y, z = (float(value) for value in quat_wb)
    return (
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x)))),
        math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )
