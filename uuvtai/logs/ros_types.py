"""ROS 2 without ROS: its standard messages by the package ``rosbags``, and our names for its frames.

Only the messages named here are ever decoded, by definitions that come with ``rosbags``; a bag's own
definitions are never parsed. Frames and units follow REP 103 and REP 105, scans without a return REP 117.
"""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np
import zstandard

from uuvtai.logs.log_errors import LogError
from uuvtai.logs.reader import MAX_RECORD, ZSTD

EXTRA = "uuvtai[ros]"
"""extra that brings ``rosbags``"""
_PACKAGE = "rosbags"

FRAMES = {"world": "map", "base": "base_link", "sonar": "sonar_link", "camera": "camera_optical_frame"}
"""frame of a log: the same one in ROS"""
FRAMES_BACK = {ros: ours for ours, ros in FRAMES.items()}

SURFACE_PA = 101_325.0
"""standard atmosphere, which FluidPressure has on top of the water's"""


class RosMessages:
    """Makes, packs (CDR) and unpacks standard messages: ``ros("geometry_msgs/msg/Vector3", x=0.0, ...)``."""

    def __init__(self) -> None:
        """Raises LogError where ``rosbags`` is not installed."""
        if importlib.util.find_spec(_PACKAGE) is None:
            raise LogError(f"uuv log convert with rosbag2 needs {_PACKAGE}: pip install '{EXTRA}'")
        from rosbags.typesys import Stores, get_typestore

        self._store = get_typestore(Stores.ROS2_HUMBLE)

    def __call__(self, kind: str, **fields: Any) -> Any:
        return self._store.types[kind](**fields)

    def packed(self, message: Any) -> bytes:
        """CDR of a message."""
        return bytes(self._store.serialize_cdr(message, message.__msgtype__))

    def unpacked(self, data: bytes, kind: str) -> Any:
        """Message of CDR, compressed by itself or not. Raises ValueError for bytes that are none of this
        kind."""
        try:
            if data.startswith(ZSTD) and 0 <= zstandard.frame_content_size(data) <= MAX_RECORD:
                data = zstandard.ZstdDecompressor().decompress(data)
            return self._store.deserialize_cdr(data, kind)
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
        """geometry_msgs/Vector3 or Point."""
        return self(f"geometry_msgs/msg/{kind}", x=float(x), y=float(y), z=float(z))

    def quaternion(self, w: float, x: float, y: float, z: float) -> Any:
        """geometry_msgs/Quaternion."""
        return self("geometry_msgs/msg/Quaternion", x=float(x), y=float(y), z=float(z), w=float(w))

    def twist(self, linear: Any, angular: Any) -> Any:
        """geometry_msgs/Twist."""
        return self("geometry_msgs/msg/Twist", linear=self.vector(*linear), angular=self.vector(*angular))


def zeros(count: int) -> np.ndarray:
    """A covariance that is unknown."""
    return np.zeros(count)
