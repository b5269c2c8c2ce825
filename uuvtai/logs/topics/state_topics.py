"""How the vehicle moves, in truth and by its instruments."""

from __future__ import annotations

import math

from uuvtai.logs.encode import number, numbers
from uuvtai.logs.moment import Moment
from uuvtai.logs.schemas import BOOLEAN, FOUR, NUMBER, THREE, array_of, described, record
from uuvtai.logs.topic import EVERY_STEP, Topic

_STATE = record(
    "uuv.State",
    "Truth, and under `measured` what the instruments say.",
    position=described(THREE, "[m] world"),
    orientation=described(FOUR, "unit quaternion w, x, y, z, body to world"),
    velocity=described(THREE, "[m/s] over ground, body frame"),
    rates=described(THREE, "[rad/s] body frame"),
    current=described(THREE, "[m/s] of the water, world frame"),
    rpm=described(array_of(NUMBER), "of each thruster"),
    measured=record(
        "uuv.Measured",
        velocity=described(
            THREE, "[m/s] DVL, body frame; where invalid the last reading, or the pose filter's"
        ),
        velocity_valid=BOOLEAN,
        rates=described(THREE, "[rad/s] gyro"),
        depth_m=described(NUMBER, "pressure depth, positive down"),
    ),
)
_TRUTH = tuple(f"vehicle.{name}" for name in ("pos_w", "quat_wb", "vel_b", "rate_b", "rpm"))
_MEASURED = tuple(f"ego.{name}" for name in ("vel_b", "vel_valid", "rate_b", "depth_m"))


def _state(moment: Moment) -> bytes:
    position, orientation, velocity, rates, rpm = (numbers(moment[name]) for name in _TRUTH)
    valid = "true" if moment["ego.vel_valid"] == 1 else "false"
    return (
        f'{{"position":{position},"orientation":{orientation},"velocity":{velocity},"rates":{rates},'
        f'"current":{numbers(moment["current.vel_w"])},"rpm":{rpm},'
        f'"measured":{{"velocity":{numbers(moment["ego.vel_b"])},"velocity_valid":{valid},'
        f'"rates":{numbers(moment["ego.rate_b"])},"depth_m":{number(moment["ego.depth_m"])}}}}}'
    ).encode()


ROWS = (
    Topic(
        "/state",
        EVERY_STEP,
        _STATE,
        _state,
        (*_TRUTH, "current.vel_w", *_MEASURED),
        lambda data: math.hypot(*data["velocity"]),
        note="; truth and measurements",
    ),
)
