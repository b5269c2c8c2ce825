"""ROS 2's standard messages as a log's JSON messages; the table of docs/viewers.md. Nothing in a message is
trusted: what does not fit together is a ValueError."""

from __future__ import annotations

import base64
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from uuvtai.files import parsed_json
from uuvtai.foreign_time import JUMP_S
from uuvtai.logs.encode import dumped
from uuvtai.logs.moment import time_text
from uuvtai.logs.ros_types import FRAMES_BACK, SURFACE_PA
from uuvtai.logs.ros_write import INVALID_VAR, Setup
from uuvtai.logs.schemas import (
    BASE64,
    BOOLEAN,
    FRAME_TRANSFORMS,
    GRID,
    LASER_SCAN,
    NUMBER,
    PACKED_FIELD,
    POSE,
    STRING,
    THREE,
    TIME,
    UINT,
    Schema,
    array_of,
    record,
)
from uuvtai.logs.topics.map_topics import dynamic_colors, grid_text, static_colors

_CLOUD = record(
    "foxglove.PointCloud",
    timestamp=TIME,
    frame_id=STRING,
    pose=POSE,
    point_stride=UINT,
    fields=array_of(PACKED_FIELD),
    data=BASE64,
)
_ODOMETRY = record(
    "uuv.Odometry",
    timestamp=TIME,
    frame_id=STRING,
    pose=POSE,
    pose_covariance=array_of(NUMBER),
    velocity=THREE,
    rates=THREE,
    velocity_valid=BOOLEAN,
)
_IMU = record(
    "uuv.Imu",
    "",
    {"acceleration": THREE, "orientation": POSE["properties"]["orientation"]},
    timestamp=TIME,
    frame_id=STRING,
    rates=THREE,
)
_PRESSURE = record("uuv.Pressure", timestamp=TIME, frame_id=STRING, pressure_pa=NUMBER, depth_m=NUMBER)
_TWIST = record("uuv.Twist", linear=THREE, angular=THREE)
_TWIST_STAMPED = record("uuv.TwistStamped", timestamp=TIME, frame_id=STRING, linear=THREE, angular=THREE)

_LATE_NS = round(1e9 * JUMP_S)
NAMES = {"/scan": "/sonar/scan", "/map": "/map/static"}
"""ROS topic: the log's, where it is another"""
_UNIT = 0.1
"""by which the square of a quaternion's length may be off 1"""
_TYPES = {1: 2, 2: 1, 3: 4, 4: 3, 5: 6, 6: 5, 7: 7, 8: 8}
"""PointField's codes: Foxglove's"""


@dataclass(frozen=True)
class Reading:
    """How messages of one kind become ours."""

    schema: Schema
    read: Callable[[Reader, Any], bytes]


class Reader:
    """Of one message, logged at ``log_ns``; times count from the start of the bag's ``span_ns``."""

    def __init__(self, topic: str, setup: Setup, span_ns: tuple[int, int], log_ns: int) -> None:
        self.topic, self.setup, self._span_ns, self._log_ns = topic, setup, span_ns, log_ns
        self.is_foreign = False
        """whether a stamp was of another clock than the bag's, not just late"""

    def head(self, header: Any) -> dict[str, Any]:
        """timestamp and frame_id."""
        return {
            "timestamp": parsed_json(self.stamp(header), self.topic),
            "frame_id": FRAMES_BACK.get(header.frame_id, header.frame_id),
        }

    def stamp(self, header: Any) -> str:
        """Time as a foxglove time; of a stamp outside of the bag's span that of the log."""
        time_ns = header.stamp.sec * 1_000_000_000 + header.stamp.nanosec
        start_ns, end_ns = self._span_ns
        if not start_ns <= time_ns <= end_ns:
            self.is_foreign |= max(start_ns - time_ns, time_ns - end_ns) > _LATE_NS
            time_ns = self._log_ns
        return time_text(time_ns - start_ns)


def _xyz(value: Any) -> dict[str, float]:
    return {"x": value.x, "y": value.y, "z": value.z}


def _list(value: Any) -> list[float]:
    return [value.x, value.y, value.z]


def _turn(value: Any) -> dict[str, float]:
    if abs(value.x**2 + value.y**2 + value.z**2 + value.w**2 - 1) > _UNIT:
        raise ValueError(f"an orientation that is none ({value.x:g}, {value.y:g}, {value.z:g}, {value.w:g})")
    return {"x": value.x, "y": value.y, "z": value.z, "w": value.w}


def _pose(value: Any) -> dict[str, Any]:
    return {"position": _xyz(value.position), "orientation": _turn(value.orientation)}


_HERE = {"position": {"x": 0, "y": 0, "z": 0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}


def _transforms(reader: Reader, message: Any) -> bytes:
    return dumped({"transforms": [_transform(reader, one) for one in message.transforms]})


def _transform(reader: Reader, one: Any) -> dict[str, Any]:
    head = reader.head(one.header)
    return {
        "timestamp": head["timestamp"],
        "parent_frame_id": head["frame_id"],
        "child_frame_id": FRAMES_BACK.get(one.child_frame_id, one.child_frame_id),
        "translation": _xyz(one.transform.translation),
        "rotation": _turn(one.transform.rotation),
    }


def _scan(reader: Reader, message: Any) -> bytes:
    """REP 117: +inf is no return, as in our logs: maximum range with intensity 0. -inf is too near to
    measure: a return at the least range. What else is no range (NaN, below the least, beyond the greatest)
    says nothing: range 0 with intensity 0, so that no water counts as free."""
    ranges = np.asarray(message.ranges, np.float64)
    shine = np.asarray(message.intensities, np.float64)
    if len(shine) not in (0, len(ranges)):
        raise ValueError(f"{len(ranges)} ranges with {len(shine)} intensities")
    near, none = np.isneginf(ranges), np.isposinf(ranges)
    hit = near | ((ranges >= message.range_min) & (ranges <= message.range_max) & ~none)
    shine = np.where(hit, np.fmax(shine, 1e-3) if len(shine) else 1.0, 0.0)
    ranges = np.select([near, hit, none], [message.range_min, ranges, message.range_max], 0.0)
    last = message.angle_min + message.angle_increment * max(len(ranges) - 1, 0)
    return dumped(
        {
            **reader.head(message.header),
            "pose": _HERE,
            "start_angle": message.angle_min,
            "end_angle": last,
            "ranges": ranges.tolist(),
            "intensities": shine.tolist(),
        }
    )


def _cloud(reader: Reader, message: Any) -> bytes:
    fields = [
        {"name": one.name, "offset": one.offset, "type": _TYPES[one.datatype]} for one in message.fields
    ]
    points, row = np.asarray(message.data, np.uint8), message.point_step * message.width
    if row < message.row_step and len(points) == message.row_step * message.height:
        points = points.reshape(message.height, -1)[:, :row]  # without what fills up the rows
    if message.is_bigendian or points.size != row * message.height:
        raise ValueError("a point cloud that is big-endian or cut off")
    data = base64.b64encode(points.tobytes()).decode()
    head = reader.head(message.header)
    return dumped({**head, "pose": _HERE, "point_stride": message.point_step, "fields": fields, "data": data})


def _grid(reader: Reader, message: Any) -> bytes:
    """Per cent as a share; unknown (-1) as a half."""
    info, data = message.info, np.asarray(message.data, np.int8)
    if len(data) != info.width * info.height or not len(data) or data.max() > 100:
        raise ValueError(f"a map of {info.width} x {info.height} with {len(data)} cells")
    values = np.where(data < 0, np.float32(0.5), data / np.float32(100)).reshape(info.height, info.width)
    head = reader.head(message.header)
    paint = dynamic_colors if reader.topic == "/map/dynamic" else static_colors
    place = _pose(info.origin)
    dumped(place)  # finite
    return grid_text(
        reader.stamp(message.header), head["frame_id"], place, info.resolution, values.astype("<f4"), paint
    )


def _odometry(reader: Reader, message: Any) -> bytes:
    twist = message.twist.twist
    return dumped(
        {
            **reader.head(message.header),
            "pose": _pose(message.pose.pose),
            "pose_covariance": np.asarray(message.pose.covariance, float).tolist(),
            "velocity": _list(twist.linear),
            "rates": _list(twist.angular),
            "velocity_valid": bool(message.twist.covariance[0] < INVALID_VAR),
        }
    )


def _imu(reader: Reader, message: Any) -> bytes:
    """What a covariance of -1, or an orientation of zeros, says is not measured is null."""
    q, attitude, acceleration = (
        message.orientation,
        message.orientation_covariance[0],
        message.linear_acceleration_covariance[0],
    )
    return dumped(
        {
            **reader.head(message.header),
            "orientation": None if attitude == -1 or not any((q.x, q.y, q.z, q.w)) else _turn(q),
            "rates": _list(message.angular_velocity),
            "acceleration": None if acceleration == -1 else _list(message.linear_acceleration),
        }
    )


def _pressure(reader: Reader, message: Any) -> bytes:
    depth = (message.fluid_pressure - SURFACE_PA) / reader.setup.pa_per_m
    return dumped({**reader.head(message.header), "pressure_pa": message.fluid_pressure, "depth_m": depth})


def _twist(reader: Reader, message: Any) -> bytes:
    return dumped({"linear": _list(message.linear), "angular": _list(message.angular)})


def _twist_stamped(reader: Reader, message: Any) -> bytes:
    twist = message.twist
    head = reader.head(message.header)
    return dumped({**head, "linear": _list(twist.linear), "angular": _list(twist.angular)})


READ = {
    "tf2_msgs/msg/TFMessage": Reading(FRAME_TRANSFORMS, _transforms),
    "nav_msgs/msg/Odometry": Reading(_ODOMETRY, _odometry),
    "sensor_msgs/msg/Imu": Reading(_IMU, _imu),
    "sensor_msgs/msg/FluidPressure": Reading(_PRESSURE, _pressure),
    "sensor_msgs/msg/LaserScan": Reading(LASER_SCAN, _scan),
    "sensor_msgs/msg/PointCloud2": Reading(_CLOUD, _cloud),
    "nav_msgs/msg/OccupancyGrid": Reading(GRID, _grid),
    "geometry_msgs/msg/TwistStamped": Reading(_TWIST_STAMPED, _twist_stamped),
    "geometry_msgs/msg/Twist": Reading(_TWIST, _twist),
}
"""message: how it is read; all others are left out"""
