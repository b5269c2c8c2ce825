"""Topics of motion: frames, true and estimated pose, state, instruments, events."""

from __future__ import annotations

import json
import math
from typing import Any

from uuvtai.common.enums import OUTCOMES
from uuvtai.logs.encode import (
    EVENTS,
    EVERY_STEP,
    Moment,
    Topic,
    When,
    number,
    numbers,
    pose_in_frame,
    transform,
)
from uuvtai.logs.schemas import (
    BOOLEAN,
    FOUR,
    FRAME_TRANSFORMS,
    INFO,
    LOG,
    NUMBER,
    POSE_IN_FRAME,
    THREE,
    WARNING,
    array_of,
    described,
    record,
)
from uuvtai.logs.topics.planning import SOURCE, fallback_of, planner_of, trigger_of

_CAMERA_OPTICAL = (0.5, -0.5, 0.5, -0.5)
"""Quaternion (w, x, y, z) from optical axes (x right, y down, z ahead) to the body's."""


def _transforms(moment: Moment) -> bytes:
    """world -> base -> sonar, camera."""
    stamp, quat = moment.stamp, moment["vehicle.quat_wb"].tolist()
    base = transform(stamp, "world", "base", moment["vehicle.pos_w"].tolist(), quat)
    sonar = transform(stamp, "base", "sonar", (0, 0, 0), _level_rotation(quat))
    mount = moment.header.config.sensors.depth.offset_b_m
    camera = transform(stamp, "base", "camera", mount, _CAMERA_OPTICAL)
    return f'{{"transforms":[{base},{sonar},{camera}]}}'.encode()


def _level_rotation(quat_wb: list[float]) -> tuple[float, float, float, float]:
    """Quaternion (w, x, y, z) from a level frame with the vehicle's yaw to the body frame: roll and pitch."""
    w, x, y, z = quat_wb
    half = 0.5 * math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    c, s = math.cos(half), math.sin(half)
    return w * c + z * s, -x * c - y * s, x * s - y * c, w * s - z * c


def quaternion_of(rpy: Any) -> tuple[float, float, float, float]:
    """Quaternion (w, x, y, z) of roll, pitch, yaw (Z-Y-X)."""
    cr, cp, cy = (math.cos(0.5 * v) for v in rpy)
    sr, sp, sy = (math.sin(0.5 * v) for v in rpy)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def angles_of(w: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Roll, pitch, yaw [rad] (Z-Y-X) of a unit quaternion."""
    return (
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x)))),
        math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )


_ESTIMATED = When(
    "every new scan, where the pose is estimated",
    lambda moment, waited: bool(moment["scan.fresh"]) and moment["ego.pose_cov"][0] > 0,
    ("scan.fresh", "ego.pose_cov"),
)

_COVARIANCE = record(
    "uuv.PoseCovariance",
    "How sure the pose filter is of `/pose_estimate`, and how far off that is.",
    covariance=described(
        {**array_of(NUMBER), "minItems": 36, "maxItems": 36},
        "[m^2, m rad, rad^2] row by row of x, y, z, roll, pitch, yaw, as in ROS PoseWithCovariance; roll and "
        "pitch are measured: 0",
    ),
    sigma=described(FOUR, "[m, m, m, rad] standard deviations of x, y, z, yaw"),
    error=described(FOUR, "[m, m, m, rad] estimate less truth of x, y, z, yaw"),
)
_ROW_OF = (0, 1, 5)  # rows of x, y and heading among x, y, z, roll, pitch, yaw


def _covariance(moment: Moment) -> bytes:
    level, z_var = moment["ego.pose_cov"].tolist(), float(moment["ego.z_var"])
    full = [0.0] * 36
    full[6 * 2 + 2] = z_var
    for value, (i, j) in zip(level, ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)), strict=True):
        full[6 * _ROW_OF[i] + _ROW_OF[j]] = full[6 * _ROW_OF[j] + _ROW_OF[i]] = value
    sigma = [math.sqrt(max(var, 0.0)) for var in (level[0], level[3], z_var, level[5])]
    w, x, y, z = moment["vehicle.quat_wb"].tolist()
    turn = float(moment["ego.rpy"][2]) - math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    off = (moment["ego.pos_w"] - moment["vehicle.pos_w"]).tolist()
    error = numbers([*off, math.remainder(turn, 2 * math.pi)])
    return f'{{"covariance":{numbers(full)},"sigma":{numbers(sigma)},"error":{error}}}'.encode()


def _read_pose(data: dict[str, Any]) -> tuple[float, float, float, float]:
    """(x, y, z, yaw)."""
    place, q = data["pose"]["position"], data["pose"]["orientation"]
    yaw = math.atan2(2 * (q["w"] * q["z"] + q["x"] * q["y"]), 1 - 2 * (q["y"] ** 2 + q["z"] ** 2))
    return place["x"], place["y"], place["z"], yaw


POSE_ROWS = (
    Topic("/tf", EVERY_STEP, FRAME_TRANSFORMS, _transforms, ("vehicle.pos_w", "vehicle.quat_wb")),
    Topic(
        "/pose",
        EVERY_STEP,
        POSE_IN_FRAME,
        lambda moment: pose_in_frame(moment.stamp, moment["vehicle.pos_w"], moment["vehicle.quat_wb"]),
        ("vehicle.pos_w", "vehicle.quat_wb"),
        _read_pose,
        in_picture=True,
        note="; truth",
    ),
    Topic(
        "/pose_estimate",
        EVERY_STEP,
        POSE_IN_FRAME,
        lambda moment: pose_in_frame(moment.stamp, moment["ego.pos_w"], quaternion_of(moment["ego.rpy"])),
        ("ego.pos_w", "ego.rpy"),
    ),
    Topic(
        "/pose_covariance",
        _ESTIMATED,
        _COVARIANCE,
        _covariance,
        ("ego.pose_cov", "ego.z_var", "ego.pos_w", "ego.rpy", "vehicle.pos_w", "vehicle.quat_wb"),
        note="; with the error against the truth",
    ),
)


# ---- How the vehicle moves, in truth and by its instruments.

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


STATE_ROWS = (
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


# ---- What the instruments themselves say, before anything is made of it: with the scans, and the exact
# images where they were asked for, all that the stack decides by (``uuv replay``).

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


INSTRUMENT_ROWS = (
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


# ---- What happens now and then, as lines of text.


def _lines(moment: Moment) -> list[bytes]:
    lines = []
    if moment.replanned:
        fallback = fallback_of(moment)
        found = f"replan ({trigger_of(moment)}): {planner_of(moment)}, {int(moment['route.n_way'])} waypoints"
        why = f"; voronoi: {fallback}" if fallback else ""
        lines.append(_line(moment, WARNING if fallback else INFO, "uuv.route", found + why))
    if moment.ended:
        outcome = OUTCOMES[int(moment["termination.outcome"])]
        lines.append(_line(moment, INFO, "uuv.episode", f"outcome: {outcome}"))
    return lines


def _line(moment: Moment, level: int, name: str, message: str) -> bytes:
    return (
        f'{{"timestamp":{moment.stamp},"level":{level},"message":{json.dumps(message)},"name":"{name}",'
        f'"file":"","line":0}}'
    ).encode()


EVENT_ROWS = (Topic("/log", EVENTS, LOG, _lines, SOURCE),)
