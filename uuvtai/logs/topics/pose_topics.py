"""Where the vehicle is: frames, true pose, its own estimate."""

from __future__ import annotations

import math
from typing import Any

from uuvtai.logs.encode import numbers, pose_in_frame, transform
from uuvtai.logs.moment import Moment
from uuvtai.logs.schemas import FOUR, FRAME_TRANSFORMS, NUMBER, POSE_IN_FRAME, array_of, described, record
from uuvtai.logs.topic import EVERY_STEP, Topic, When

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
    """Quaternion (w, x, y, z) that turns a level frame with the vehicle's yaw into the body frame: undoes
    roll and pitch."""
    w, x, y, z = quat_wb
    half = 0.5 * math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    c, s = math.cos(half), math.sin(half)
    return w * c + z * s, -x * c - y * s, x * s - y * c, w * s - z * c


def _quaternion_of(rpy: Any) -> tuple[float, float, float, float]:
    """Quaternion (w, x, y, z) of roll, pitch, yaw (Z-Y-X)."""
    cr, cp, cy = (math.cos(0.5 * v) for v in rpy)
    sr, sp, sy = (math.sin(0.5 * v) for v in rpy)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
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
_ROW_OF = (0, 1, 5)
"""rows of x, y and heading among x, y, z, roll, pitch, yaw"""


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


ROWS = (
    Topic(
        "/tf",
        EVERY_STEP,
        FRAME_TRANSFORMS,
        _transforms,
        ("vehicle.pos_w", "vehicle.quat_wb"),
    ),
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
        lambda moment: pose_in_frame(moment.stamp, moment["ego.pos_w"], _quaternion_of(moment["ego.rpy"])),
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
