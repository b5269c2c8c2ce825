"""What the physics answers ArduSub: one line of JSON. Pure functions.

Ours: world x north, y west, z up; body x ahead, y left, z up. ArduSub's: north, east, down; ahead, right,
down. Its parser (SIM_JSON.cpp) finds keys by their text and wants no space after a colon, three numbers to a
vector, and a line between two line feeds.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np

from uuvtai.config import Config
from uuvtai.vehicle.mavlink import Order
from uuvtai.vehicle.telemetry import sectors_of

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
    altitude_m: float  # above the floor
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


# ---- What the sensors beside the autopilot say by MAVLink: a DVL, a sonar, an altimeter.

LEAST_STEPS = 5  # control steps between two reports, at least: 10 Hz, as of an A50 and a multibeam
_SONAR, _DOWN, _BOW = 1, 25, 12
"""MAV_DISTANCE_SENSOR_ULTRASOUND, MAV_SENSOR_ROTATION_PITCH_270, MAV_FRAME_BODY_FRD"""
_MOST_ALTITUDE_CM = 5000

Value = Callable[[str], np.ndarray]


class ReportedSensors:
    """One vehicle's. ``report`` is called in every control step."""

    def __init__(self, config: Config, silent: Collection[str] = ()) -> None:
        """``silent``: what speaks its own protocol, of 'dvl' and 'sonar'."""
        sensors, self._silent = config.sensors, silent
        self._dt, self._sonar = config.episode.control_dt_s, sensors.sonar
        self._dvl_s = max(LEAST_STEPS, sensors.dvl.period_steps) * self._dt
        self._steps, self._told = 0, {"dvl": -LEAST_STEPS, "sonar": -LEAST_STEPS}

    def report(self, time_s: float, altitude_m: float, value: Value) -> list[Order]:
        """Messages of this step; ``value`` gives arrays of the vehicle by 'struct.field'."""
        found = []
        if self._is_due("dvl", value("ego.dvl_fresh")):
            found.append(self._velocity(time_s, value("ego.dvl_b"), value("ego.rate_b")))
        if self._is_due("sonar", value("scan.fresh")):
            late_s = float(value("clock.step") - value("scan.ping_step")) * self._dt
            found.append(self._scan(time_s - late_s, value("scan.range_m"), value("scan.hit")))
        if self._steps % LEAST_STEPS == 0:
            found.append(_altitude(time_s, altitude_m))
        self._steps += 1
        return found

    def _is_due(self, name: str, fresh: np.ndarray) -> bool:
        """A new reading: the water's steps begin when the vehicle is driven, ours before."""
        due = name not in self._silent and bool(fresh) and self._steps - self._told[name] >= LEAST_STEPS
        if due:
            self._told[name] = self._steps
        return due

    def _velocity(self, time_s: float, vel_b: np.ndarray, rate_b: np.ndarray) -> Order:
        fields = {
            "time_usec": _microseconds(time_s),
            "time_delta_usec": _microseconds(self._dvl_s),
            "angle_delta": [self._dvl_s * value for value in turned_over(rate_b.tolist())],
            "position_delta": [self._dvl_s * value for value in turned_over(vel_b.tolist())],
            "confidence": 100.0,
        }
        return Order("VISION_POSITION_DELTA", "VISION_POSITION_DELTA", fields)

    def _scan(self, time_s: float, range_m: np.ndarray, hit: np.ndarray) -> Order:
        beams = self._sonar.n_ray
        distances, increment, offset = sectors_of(self._sonar, range_m[:beams], hit[:beams])
        fields = {
            "time_usec": _microseconds(time_s),
            "sensor_type": _SONAR,
            "distances": distances,
            "increment": max(1, round(increment)),
            "min_distance": 1,
            "max_distance": round(100.0 * self._sonar.max_range_m),
            "increment_f": increment,
            "angle_offset": offset,
            "frame": _BOW,
        }
        return Order("OBSTACLE_DISTANCE", "OBSTACLE_DISTANCE", fields)


def _altitude(time_s: float, altitude_m: float) -> Order:
    distance = int(np.clip(round(100.0 * altitude_m), 1, _MOST_ALTITUDE_CM))
    fields = {
        "time_boot_ms": round(1e3 * time_s) & 0xFFFFFFFF,
        "min_distance": 1,
        "max_distance": _MOST_ALTITUDE_CM,
        "current_distance": distance,
        "type": _SONAR,
        "id": 0,
        "orientation": _DOWN,
        "covariance": 255,
    }
    return Order("DISTANCE_SENSOR", "DISTANCE_SENSOR", fields)


def _microseconds(seconds: float) -> int:
    return round(1e6 * seconds)
