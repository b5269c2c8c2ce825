"""Where the vehicle is: frames, true pose, its own estimate."""

from __future__ import annotations

import math
from typing import Any

from uuvtai.logs.encode import pose_in_frame, transform
from uuvtai.logs.moment import Moment
from uuvtai.logs.schemas import FRAME_TRANSFORMS, POSE_IN_FRAME
from uuvtai.logs.topic import EVERY_STEP, Topic

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
)
