"""What the instruments themselves say, before anything is made of it: with the scans, and the exact images
where they were asked for, all that the stack decides by (``uuv replay``)."""

from __future__ import annotations

from uuvtai.logs.encode import number, numbers
from uuvtai.logs.moment import Moment
from uuvtai.logs.schemas import NUMBER, THREE, described, record
from uuvtai.logs.topic import EVERY_STEP, Topic, When

_NEW_VELOCITY = When(
    "every reading of the DVL", lambda moment, waited: bool(moment["ego.dvl_fresh"]), ("ego.dvl_fresh",)
)

_IMU = record(
    "uuv.ImuReading",
    attitude=described(THREE, "[rad] roll, pitch, yaw, not corrected by the pose filter"),
    rates=described(THREE, "[rad/s] gyro, body frame"),
    specific_force=described(THREE, "[m/s^2] acceleration less gravity, body frame"),
)
_DVL = record("uuv.DvlReading", velocity=described(THREE, "[m/s] over ground, body frame"))
_PRESSURE = record(
    "uuv.PressureReading",
    depth_m=described(NUMBER, "positive down, zeroed at the start unless the position is given"),
)


def _imu(moment: Moment) -> bytes:
    attitude, rates, force = (
        numbers(moment[name]) for name in ("ego.imu_rpy", "ego.rate_b", "ego.specific_force_b")
    )
    return f'{{"attitude":{attitude},"rates":{rates},"specific_force":{force}}}'.encode()


ROWS = (
    Topic("/sensors/imu", EVERY_STEP, _IMU, _imu, ("ego.imu_rpy", "ego.rate_b", "ego.specific_force_b")),
    Topic(
        "/sensors/dvl",
        _NEW_VELOCITY,
        _DVL,
        lambda moment: f'{{"velocity":{numbers(moment["ego.dvl_b"])}}}'.encode(),
        ("ego.dvl_b",),
    ),
    Topic(
        "/sensors/pressure",
        EVERY_STEP,
        _PRESSURE,
        lambda moment: f'{{"depth_m":{number(moment["ego.depth_m"])}}}'.encode(),
        ("ego.depth_m",),
    ),
)
