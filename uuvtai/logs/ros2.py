"""ROS 2 without ROS: its standard messages by the package ``rosbags``, and our names for its frames.

Messages are packed and unpacked by definitions that come with ``rosbags`` or are ours; a bag's own are never
parsed. Frames and units follow REP 103 and REP 105, scans without a return REP 117.
"""

from __future__ import annotations

import base64
import importlib.util
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import zstandard

from uuvtai.config import Config
from uuvtai.logs.encode import LogError
from uuvtai.logs.reader import MAX_RECORD, ZSTD
from uuvtai.logs.topics.perception import grid_values

EXTRA = "uuvtai[ros]"  # extra that brings ``rosbags``
_PACKAGE = "rosbags"

FRAMES = {"world": "map", "base": "base_link", "sonar": "sonar_link", "camera": "camera_optical_frame"}
"""frame of a log: the same one in ROS"""

SURFACE_PA = 101_325.0  # standard atmosphere, which FluidPressure has on top of the water's


class RosMessages:
    """Makes, packs (CDR) and unpacks standard messages: ``ros("geometry_msgs/msg/Vector3", x=0.0, ...)``."""

    def __init__(self, declared: Mapping[str, str] | None = None) -> None:
        """``declared``: definitions of messages that are not standard. Raises LogError where ``rosbags`` is
        not installed."""
        if importlib.util.find_spec(_PACKAGE) is None:
            raise LogError(f"bags are written and read by {_PACKAGE}: pip install '{EXTRA}'")
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self._store, self._of_ros1 = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC)
        for kind, text in (declared or {}).items():
            for store in (self._store, self._of_ros1):
                store.register(get_types_from_msg(text, kind))

    def __call__(self, kind: str, **fields: Any) -> Any:
        return self._store.types[kind](**fields)

    def packed(self, message: Any) -> bytes:
        return bytes(self._store.serialize_cdr(message, message.__msgtype__))

    def unpacked(self, data: bytes, kind: str, is_ros1: bool = False) -> Any:
        """Message of CDR, compressed or not, or of ROS 1. Raises ValueError for bytes that are none of this
        kind."""
        try:
            if data.startswith(ZSTD) and 0 <= zstandard.frame_content_size(data) <= MAX_RECORD:
                data = zstandard.ZstdDecompressor().decompress(data)
            read = self._of_ros1.deserialize_ros1 if is_ros1 else self._store.deserialize_cdr
            return read(data, kind)
        except MemoryError:
            raise
        except Exception as error:  # struct.error, AssertionError, rosbags' own and more
            raise ValueError(f"not a {kind}: {error!r}") from None

    def definition(self, kind: str) -> bytes:
        """Text of a message's definition, as MCAP's encoding 'ros2msg' has it."""
        return self._store.generate_msgdef(kind, ros_version=2)[0].encode()

    # ------------------------------------------------------------------------------------------------- parts

    def header(self, time_ns: int, frame: str) -> Any:
        """std_msgs/Header; ``frame`` by our name or ROS's."""
        sec, nanosec = divmod(time_ns, 1_000_000_000)
        stamp = self("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self("std_msgs/msg/Header", stamp=stamp, frame_id=FRAMES.get(frame, frame))

    def vector(self, x: float, y: float, z: float, kind: str = "Vector3") -> Any:
        return self(f"geometry_msgs/msg/{kind}", x=float(x), y=float(y), z=float(z))

    def quaternion(self, w: float, x: float, y: float, z: float) -> Any:
        return self("geometry_msgs/msg/Quaternion", x=float(x), y=float(y), z=float(z), w=float(w))

    def pose(self, place: Any, turn: Any) -> Any:
        at, along = self.vector(*place, kind="Point"), self.quaternion(*turn)
        return self("geometry_msgs/msg/Pose", position=at, orientation=along)

    def twist(self, linear: Any, angular: Any) -> Any:
        return self("geometry_msgs/msg/Twist", linear=self.vector(*linear), angular=self.vector(*angular))


# ---- A log's control steps as ROS 2's standard messages; the table of docs/logs.md.

Step = dict[str, dict[str, Any]]  # messages of one control step by topic

WRITTEN = {
    "/tf": "tf2_msgs/msg/TFMessage",
    "/ground_truth/odom": "nav_msgs/msg/Odometry",
    "/odometry/filtered": "nav_msgs/msg/Odometry",
    "/imu/data": "sensor_msgs/msg/Imu",
    "/pressure": "sensor_msgs/msg/FluidPressure",
    "/scan": "sensor_msgs/msg/LaserScan",
    "/sonar/points": "sensor_msgs/msg/PointCloud2",
    "/sonar/own_velocity": "geometry_msgs/msg/TwistStamped",
    "/map": "nav_msgs/msg/OccupancyGrid",
    "/map/dynamic": "nav_msgs/msg/OccupancyGrid",
    "/cmd_vel": "geometry_msgs/msg/Twist",
}
"""ROS topic: its message"""
SOURCES = frozenset(
    (
        *("/tf", "/state", "/pose_estimate", "/pose_covariance", "/sonar/scan", "/sonar/doppler"),
        *("/map/static", "/map/dynamic", "/action"),
    )
)
"""topics of a log that anything is made of"""
INVALID_VAR = 1e6  # [m^2/s^2] variance of a velocity that the instrument calls invalid
_FLOAT32 = 7
_CLOUD_FIELDS = ("x", "y", "z", "intensity", "velocity")


@dataclass(frozen=True)
class Setup:
    """What a run's config says about its messages."""

    max_range_m: float
    pa_per_m: float  # pressure of a metre of water
    limits: tuple[float, ...]  # [m/s, m/s, m/s, rad/s] that an action of 1 asks for

    @classmethod
    def of(cls, given: dict[str, Any]) -> Setup:
        """From a config's YAML; what lacks is the default. Raises ValueError, TypeError, AttributeError."""
        vehicle, default = given.get("vehicle") or {}, Config()
        names = ("max_surge_m_s", "max_sway_m_s", "max_heave_m_s", "max_yaw_rate_rad_s")
        sonar = (given.get("sensors") or {}).get("sonar") or {}

        def value(name: str) -> float:
            return float(vehicle.get(name, getattr(default.vehicle, name)))

        return cls(
            float(sonar.get("max_range_m", default.sensors.sonar.max_range_m)),
            value("water_density_kg_m3") * value("gravity_m_s2"),
            tuple(value(name) for name in names),
        )


def ros_messages(ros: RosMessages, setup: Setup, time_ns: int, step: Step) -> Iterator[tuple[str, Any]]:
    """(topic, message) of one control step."""
    if "/tf" in step:
        yield "/tf", _transforms(ros, step["/tf"])
    if "/state" in step:
        yield from _motion(ros, setup, time_ns, step)
    if "/sonar/scan" in step:
        yield "/scan", _scan(ros, setup, step["/sonar/scan"])
        if "/sonar/doppler" in step:
            yield "/sonar/points", _cloud(ros, step["/sonar/scan"], step["/sonar/doppler"]["velocity"])
    if "/sonar/doppler" in step:
        own = step["/sonar/doppler"]
        head, twist = ros.header(_ns(own), "base"), ros.twist(own["own_velocity"], (0, 0, 0))
        yield "/sonar/own_velocity", ros("geometry_msgs/msg/TwistStamped", header=head, twist=twist)
    for topic, name in (("/map/static", "/map"), ("/map/dynamic", "/map/dynamic")):
        if topic in step:
            yield name, _grid(ros, step[topic])
    if "/action" in step:
        surge, sway, heave, yaw = np.multiply(step["/action"]["applied"], setup.limits)
        yield "/cmd_vel", ros.twist((surge, sway, heave), (0, 0, yaw))


def _ns(message: dict[str, Any]) -> int:
    stamp = message["timestamp"]
    return int(stamp["sec"]) * 1_000_000_000 + int(stamp["nsec"])


def _wxyz(value: dict[str, float]) -> tuple[float, ...]:
    return value["w"], value["x"], value["y"], value["z"]


def _xyz(value: dict[str, float]) -> tuple[float, float, float]:
    return value["x"], value["y"], value["z"]


def _transforms(ros: RosMessages, data: dict[str, Any]) -> Any:
    transforms = []
    for one in data["transforms"]:
        head = ros.header(_ns(one), one["parent_frame_id"])
        child = ros.header(0, one["child_frame_id"]).frame_id
        moved = ros(
            "geometry_msgs/msg/Transform",
            translation=ros.vector(*_xyz(one["translation"])),
            rotation=ros.quaternion(*_wxyz(one["rotation"])),
        )
        transforms.append(
            ros("geometry_msgs/msg/TransformStamped", header=head, child_frame_id=child, transform=moved)
        )
    return ros("tf2_msgs/msg/TFMessage", transforms=transforms)


def _motion(ros: RosMessages, setup: Setup, time_ns: int, step: Step) -> Iterator[tuple[str, Any]]:
    state, measured = step["/state"], step["/state"]["measured"]
    place, turn = state["position"], state["orientation"]
    motion = state["velocity"], state["rates"]
    yield "/ground_truth/odom", _odometry(ros, time_ns, (place, turn), motion, np.zeros(36), np.zeros(36))
    if "/pose_estimate" in step:
        pose = step["/pose_estimate"]["pose"]
        place, turn = _xyz(pose["position"]), _wxyz(pose["orientation"])
        pose_cov = np.array(step.get("/pose_covariance", {}).get("covariance", np.zeros(36)), float)
        twist_cov = np.zeros(36)
        if not measured["velocity_valid"]:
            twist_cov[[0, 7, 14]] = INVALID_VAR
        motion = measured["velocity"], measured["rates"]
        yield "/odometry/filtered", _odometry(ros, time_ns, (place, turn), motion, pose_cov, twist_cov)
        yield "/imu/data", _imu(ros, time_ns, turn, measured["rates"])
    pressure = SURFACE_PA + measured["depth_m"] * setup.pa_per_m
    head = ros.header(time_ns, "base")
    told = ros("sensor_msgs/msg/FluidPressure", header=head, fluid_pressure=pressure, variance=0.0)
    yield "/pressure", told


def _odometry(
    ros: RosMessages, time_ns: int, pose: Any, motion: Any, pose_cov: np.ndarray, twist_cov: np.ndarray
) -> Any:
    return ros(
        "nav_msgs/msg/Odometry",
        header=ros.header(time_ns, "world"),
        child_frame_id=ros.header(0, "base").frame_id,
        pose=ros("geometry_msgs/msg/PoseWithCovariance", pose=ros.pose(*pose), covariance=pose_cov),
        twist=ros("geometry_msgs/msg/TwistWithCovariance", twist=ros.twist(*motion), covariance=twist_cov),
    )


def _imu(ros: RosMessages, time_ns: int, turn: Any, rates: Any) -> Any:
    """Attitude as estimated and the gyro; logs hold no acceleration, which covariance[0] = -1 says."""
    return ros(
        "sensor_msgs/msg/Imu",
        header=ros.header(time_ns, "base"),
        orientation=ros.quaternion(*turn),
        orientation_covariance=np.zeros(9),
        angular_velocity=ros.vector(*rates),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=ros.vector(0, 0, 0),
        linear_acceleration_covariance=np.array([-1.0] + [0.0] * 8),
    )


def _scan(ros: RosMessages, setup: Setup, scan: dict[str, Any]) -> Any:
    """REP 117: -inf = noise puts a return behind the sonar, NaN = nothing known, +inf = nothing there."""
    ranges, intensities = np.array(scan["ranges"], np.float32), np.array(scan["intensities"], np.float32)
    first, last = float(scan["start_angle"]), float(scan["end_angle"])
    return ros(
        "sensor_msgs/msg/LaserScan",
        header=ros.header(_ns(scan), scan["frame_id"]),
        angle_min=first,
        angle_max=last,
        angle_increment=(last - first) / max(len(ranges) - 1, 1),
        time_increment=0.0,
        scan_time=0.0,
        range_min=0.0,
        range_max=setup.max_range_m,
        ranges=np.select(
            [(intensities > 0) & (ranges >= 0), intensities > 0, ranges > 0],
            [ranges, np.float32(-math.inf), np.float32(math.inf)],
            np.float32(math.nan),
        ),
        intensities=intensities,
    )


def _cloud(ros: RosMessages, scan: dict[str, Any], velocity: Any) -> Any:
    """Returns only; their velocity is NaN where the sonar measures none."""
    ranges, shine = np.array(scan["ranges"]), np.array(scan["intensities"])
    bearing = np.linspace(scan["start_angle"], scan["end_angle"], len(ranges))
    hit = shine > 0
    speed = np.array(velocity) if len(velocity) else np.full(len(ranges), math.nan)
    columns = (ranges * np.cos(bearing), ranges * np.sin(bearing), 0 * ranges, shine, speed)
    points = np.column_stack(columns)[hit].astype("<f4")
    fields = [
        ros("sensor_msgs/msg/PointField", name=name, offset=4 * i, datatype=_FLOAT32, count=1)
        for i, name in enumerate(_CLOUD_FIELDS)
    ]
    step = 4 * len(fields)
    return ros(
        "sensor_msgs/msg/PointCloud2",
        header=ros.header(_ns(scan), scan["frame_id"]),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=step,
        row_step=step * len(points),
        data=np.frombuffer(points.tobytes(), np.uint8),
        is_dense=len(velocity) > 0,
    )


def _grid(ros: RosMessages, grid: dict[str, Any]) -> Any:
    """Probabilities in per cent."""
    if len(base64.b64decode(grid["data"])) % grid["row_stride"]:
        raise ValueError("a grid that is cut off")
    values, pose, head = grid_values(grid), grid["pose"], ros.header(_ns(grid), grid["frame_id"])
    info = ros(
        "nav_msgs/msg/MapMetaData",
        map_load_time=head.stamp,
        resolution=float(grid["cell_size"]["x"]),
        width=values.shape[1],
        height=values.shape[0],
        origin=ros.pose(_xyz(pose["position"]), _wxyz(pose["orientation"])),
    )
    data = np.rint(100 * np.clip(values, 0, 1)).astype(np.int8).ravel()
    return ros("nav_msgs/msg/OccupancyGrid", header=head, info=info, data=data)
