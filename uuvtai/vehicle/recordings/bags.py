"""Bags of ROS 1 and ROS 2 (MCAP, SQLite) as what they told, without ROS.

Standard messages are those of the package ``rosbags``, a few of instruments are declared here; a bag's own
definitions are never parsed. Axes by REP 103: x ahead, y left, z up; east, north, up.
"""

from __future__ import annotations

import bz2
import contextlib
import functools
import math
import re
import sqlite3
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from shlex import quote
from typing import Any, NamedTuple

import lz4.frame
import numpy as np
from mcap.records import Channel, Message, Schema

from uuvtai.common.errors import ODD
from uuvtai.common.files import open_file, refuse_links
from uuvtai.config import Config
from uuvtai.logs.reader import MAX_RECORD, records
from uuvtai.logs.ros2 import INVALID_VAR, RosMessages
from uuvtai.logs.topics.motion import angles_of
from uuvtai.vehicle.instruments import ping
from uuvtai.vehicle.messages import SonarPing
from uuvtai.vehicle.recordings import sources
from uuvtai.vehicle.recordings.sources import MOST_BYTES, RecordingError, Source, Telemetry
from uuvtai.vehicle.telemetry import UNKNOWN_CM, ping_of

DECLARED = {
    "marine_acoustic_msgs/msg/Dvl": (
        "std_msgs/Header header\nuint8 velocity_mode\nuint8 dvl_type\ngeometry_msgs/Vector3 velocity\n"
        "float64[9] velocity_covar\nfloat64 altitude\nfloat64 course_gnd\nfloat64 speed_gnd\n"
        "uint8 num_good_beams\nfloat32 sound_speed\nbool beam_ranges_valid\nbool beam_velocities_valid\n"
        "geometry_msgs/Vector3[4] beam_unit_vec\nfloat64[4] range\nfloat32[4] range_covar\n"
        "float32[4] beam_quality\nfloat32[4] beam_velocity\nfloat32[4] beam_velocity_covar"
    ),
    "ping360_sonar_msgs/msg/SonarEcho": (
        "std_msgs/Header header\nfloat32 angle\nuint8 gain\nuint16 number_of_samples\n"
        "uint16 transmit_frequency\nuint16 speed_of_sound\nuint8 range\nuint8[] intensities"
    ),
    "mavros_msgs/msg/RCOut": "std_msgs/Header header\nuint16[] channels",
    "px4_msgs/msg/VehicleOdometry": (
        "uint64 timestamp\nuint64 timestamp_sample\nuint8 pose_frame\nfloat32[3] position\nfloat32[4] q\n"
        "uint8 velocity_frame\nfloat32[3] velocity\nfloat32[3] angular_velocity\n"
        "float32[3] position_variance\nfloat32[3] orientation_variance\nfloat32[3] velocity_variance\n"
        "uint8 reset_counter\nint8 quality"
    ),
}
"""of versions in use since 2022; one of another size is named and dropped"""
DECLARED["ping360_sonar/msg/SonarEcho"] = DECLARED["ping360_sonar_msgs/msg/SonarEcho"]  # of ROS 1
_STAMP_S = 10.0  # a stamp that is further from when it was logged is of another clock


class Row(NamedTuple):
    """A message as it lies in a bag."""

    topic: str
    kind: str  # package/msg/Name
    time_s: float
    data: bytes
    is_ros1: bool


# ---- Files.


def parts_of(path: Path) -> list[Path]:
    """The files of a bag that is a folder. Raises RecordingError, FileError, OSError."""
    entries = sorted(entry for entry in path.iterdir() if {".mcap", ".db3"} & set(entry.suffixes))
    packed = [entry for entry in entries if entry.suffix not in (".mcap", ".db3")]
    if packed:
        raise RecordingError(
            f"{packed[0]}: is compressed as a whole and not read; first: zstd -d {quote(str(packed[0]))}"
        )
    if not entries:
        raise RecordingError(f"{path}: is a folder without .mcap or .db3 files; name a bag, or its file")
    for entry in entries:
        refuse_links(path, entry)
    return entries


def rows(path: Path) -> Iterator[Row]:
    """All messages of a file. Raises RecordingError, LogError, FileError, OSError."""
    with open_file(path, MOST_BYTES) as file:
        head = file.read(16)
    if head.startswith(b"#ROSBAG"):
        yield from _of_ros1(path)
    elif head.startswith(b"SQLite"):
        yield from _of_sqlite(path)
    else:
        yield from _of_mcap(path)


def _of_mcap(path: Path) -> Iterator[Row]:
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    for record in records(path):
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Message):
            channel = channels.get(record.channel_id)
            schema = schemas.get(channel.schema_id) if channel else None
            topic, encoding = (channel.topic, channel.message_encoding) if channel else ("?", "")
            kind = schema.name if schema and encoding in ("cdr", "ros1") else ""
            yield Row(topic, kind, record.log_time / 1e9, record.data, encoding == "ros1")


def _of_sqlite(path: Path) -> Iterator[Row]:
    """Read only; what is no plain table is not asked, for it may compute."""
    try:
        base = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
        base.text_factory = lambda text: text.decode("utf-8", "replace")
        try:
            base.execute("PRAGMA trusted_schema=OFF")
            tables = dict(base.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'"))
            for name in ("topics", "messages"):
                sql = str(tables.get(name, "")).upper()
                if not sql.startswith("CREATE TABLE") or re.search(r"\bAS\b", sql):
                    raise RecordingError(f"{path}: has no table {name}: no bag; name a bag of ROS 2")
            topics = {row[0]: row[1:] for row in base.execute("SELECT id, name, type FROM topics")}
            small = f"CASE WHEN length(data) <= {MAX_RECORD} THEN data ELSE x'' END"
            asked = f"SELECT topic_id, timestamp, {small} FROM messages ORDER BY rowid"
            for number, time_ns, data in base.execute(asked):
                topic, kind = topics.get(number, ("?", ""))
                is_odd = not (isinstance(time_ns, int) and isinstance(data, bytes))
                told = ("", 0.0, b"") if is_odd else (str(kind), time_ns / 1e9, data)
                yield Row(str(topic), *told, False)
        finally:
            base.close()
    except (sqlite3.Error, *ODD) as error:
        if isinstance(error, RecordingError):
            raise
        raise RecordingError(f"{path}: is damaged ({str(error)[:120]}); give another copy of it") from None


def _of_ros1(path: Path) -> Iterator[Row]:
    """By the bag's index, without which it is cut off."""
    from rosbags.rosbag1 import Reader

    try:
        with Reader(path) as bag:
            for place, chunk in bag.chunks.items():
                bag.chunks[place] = chunk._replace(decompressor=_unpacked)
            for connection, time_ns, data in bag.messages():
                yield Row(connection.topic, connection.msgtype, time_ns / 1e9, data, True)
    except MemoryError:
        raise
    except Exception as error:  # rosbags' own, AssertionError, struct.error and more
        why = str(error)[:120] or type(error).__name__
        raise RecordingError(f"{path}: is cut off or damaged ({why}); first: rosbag reindex") from None


@functools.lru_cache(maxsize=4)
def _unpacked(data: bytes) -> bytes:
    """A chunk, never more than any may have; messages of several may lie in turns."""
    if data.startswith(b"BZh"):
        data = bz2.BZ2Decompressor().decompress(data, max_length=MAX_RECORD + 1)
    elif data.startswith(b"\x04\x22\x4d\x18"):
        data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=MAX_RECORD + 1)
    if len(data) > MAX_RECORD:
        raise ValueError(f"a chunk would unpack to more than {MAX_RECORD >> 20} MiB")
    return data


# ---- Messages.


class _Bag:
    """A bag's messages on their way into a source."""

    def __init__(self, source: Source, config: Config, start: tuple[float, ...]) -> None:
        self.source, self._config, self.stores = source, config, RosMessages(DECLARED)
        self.telemetry = Telemetry(source, config, start)
        self._chosen: dict[str, str] = {}  # what is told -> topic that tells it
        self.telemetry.only_places = True
        self._head = sources.ping360(source, config) if config.sensors.sonar.mechanical else None

    def choose(self, files: list[Path]) -> None:
        """Of several topics that tell the same: the kind named first in ``TOLD``, then most messages; an IMU
        whose first message has no orientation comes last."""
        counts, bare, ranks = Counter[tuple[str, str]](), set[tuple[str, str]](), list(TOLD)
        for row in (row for file in files for row in rows(file) if row.kind in TOLD):
            each = row.topic, row.kind
            if row.kind == ranks[0] and each not in counts:
                with contextlib.suppress(*ODD):
                    turn = self.stores.unpacked(row.data, row.kind, row.is_ros1).orientation
                    bare |= set() if any((turn.w, turn.x, turn.y, turn.z)) else {each}
            counts[each] += 1
        for topic, kind in sorted(counts, key=lambda e: (e in bare, ranks.index(e[1]), -counts[e], e[0])):
            for told in TOLD[kind][0]:
                if told != "position" or self._config.sensors.localization != "estimated":
                    self._chosen.setdefault(told, topic)

    def take(self, row: Row) -> None:
        source, what = self.source, f"{row.topic} ({row.kind or 'no message of ROS'})"
        source.heard()
        if row.kind not in TOLD:
            return source.drop(what, sources.NOT_USED)
        told, read = TOLD[row.kind]
        if not (wanted := {each for each in told if self._chosen.get(each) == row.topic}):
            return source.drop(what, f"{self._chosen[told[0]]} tells it")
        try:
            message = self.stores.unpacked(row.data, row.kind, row.is_ros1)
            stamp = getattr(getattr(message, "header", None), "stamp", None)
            told_s = stamp.sec + stamp.nanosec / 1e9 if stamp else math.nan
            come_s = told_s if abs(told_s - row.time_s) <= _STAMP_S else row.time_s
            read(self, message, come_s, wanted, what)
        except ODD as error:
            source.drop(what, str(error).partition(": {")[0])
        return None

    def attitude(self, angles: Any, rates: Any, come_s: float, what: str) -> None:
        """[rad], [rad/s]; north, east, down; ahead, right, down."""
        names = ("roll", "pitch", "yaw", "rollspeed", "pitchspeed", "yawspeed")
        fields: dict[str, Any] = dict(zip(names, (*angles, *map(float, rates)), strict=True))
        self.telemetry.take("ATTITUDE", fields, come_s, what)

    def velocity(self, ahead: float, right: float, down: float, come_s: float, what: str) -> None:
        moved = tuple(0.1 * float(value) for value in (ahead, right, down))
        fields = {"time_delta_usec": 1e5, "position_delta": moved, "confidence": 100.0}
        self.telemetry.take("VISION_POSITION_DELTA", fields, come_s, what)

    def position(self, north: float, east: float, down: float, come_s: float, what: str) -> None:
        fields = {"x": float(north), "y": float(east), "z": float(down)}
        fields |= dict.fromkeys(("vx", "vy", "vz"), 0.0)
        self.telemetry.take("LOCAL_POSITION_NED", fields, come_s, what)

    # ------------------------------------------------------------------------------------------ of each kind

    def imu(self, m: Any, come_s: float, _: set[str], what: str) -> None:
        turn, force = m.orientation, m.linear_acceleration
        if m.orientation_covariance[0] == -1 or not any((turn.w, turn.x, turn.y, turn.z)):
            raise ValueError("without an orientation")
        if m.linear_acceleration_covariance[0] != -1:
            fields = {"xacc": force.x, "yacc": -force.y, "zacc": -force.z}
            self.telemetry.take("HIGHRES_IMU", fields, come_s, what)
        self.attitude(*_flipped(turn, m.angular_velocity), come_s, what)

    def odometry(self, m: Any, come_s: float, wanted: set[str], what: str) -> None:
        twist, pose = m.twist.twist, m.pose.pose
        if "attitude" in wanted:
            self.attitude(*_flipped(pose.orientation, twist.angular), come_s, what)
        if "dvl" in wanted and m.twist.covariance[0] < INVALID_VAR:
            self.velocity(twist.linear.x, -twist.linear.y, -twist.linear.z, come_s, what)
        if "position" in wanted:
            self.position(pose.position.y, pose.position.x, -pose.position.z, come_s, what)

    def twist(self, m: Any, come_s: float, _: set[str], what: str) -> None:
        if not 0 <= m.twist.covariance[0] < INVALID_VAR:
            raise ValueError("a velocity that its covariance calls invalid")
        linear = m.twist.twist.linear
        self.velocity(linear.x, -linear.y, -linear.z, come_s, what)

    def dvl(self, m: Any, come_s: float, _: set[str], what: str) -> None:
        """Axes: x ahead, z down."""
        if m.velocity_mode == 0 and not m.beam_velocities_valid and not m.num_good_beams:
            raise ValueError("the bottom is lost")
        self.velocity(m.velocity.x, m.velocity.y, m.velocity.z, come_s, what)

    def pressure(self, m: Any, come_s: float, _: set[str], what: str) -> None:
        if m.fluid_pressure < _LEAST_PA:
            raise ValueError("no pressure of water in pascals, as REP 103 has it")
        self.telemetry.take("SCALED_PRESSURE", {"press_abs": m.fluid_pressure / 100.0}, come_s, what)

    def echo(self, m: Any, come_s: float, _: set[str], what: str) -> None:
        """As the device itself says it."""
        if self._head is None:
            raise ValueError("of a mechanical head: --sensors ping360")
        samples = np.asarray(m.intensities, np.uint8).tobytes()
        if not (0 < len(samples) <= ping.MOST_SAMPLES and m.speed_of_sound and math.isfinite(m.angle)):
            raise ValueError("a profile that is none")
        period = round(2.0 * m.range / (len(samples) * m.speed_of_sound * ping.TICK_S))
        gradian, count = round(m.angle * 200.0 / math.pi) % 400, len(samples)
        head = struct.pack("<BBHHHHHH", 1, m.gain, gradian, 0, period, m.transmit_frequency, count, count)
        self._head.hear(ping.frame(ping.DEVICE_DATA, head + samples), come_s, what)

    def laser(self, m: Any, come_s: float, _: set[str], what: str) -> None:
        """REP 117: -inf is a touch, +inf free water, NaN says nothing."""
        cm = 100.0 * np.asarray(m.ranges, np.float64)
        most = 100.0 * float(m.range_max)
        cm = np.select([np.isnan(cm), np.isposinf(cm), np.isneginf(cm)], [UNKNOWN_CM, most + 1.0, 0.0], cm)
        span = 100.0 * float(m.range_min), most
        turn, first = -math.degrees(m.angle_increment), -math.degrees(m.angle_min)
        found = ping_of(self._config.sensors.sonar, come_s, cm, turn, first, *span)
        if isinstance(found, str):
            raise ValueError(found.partition(": --set")[0])
        self.source.add(found, what)

    def cloud(self, m: Any, come_s: float, _: set[str], what: str) -> None:
        """Returns alone; a beam without one is free water. Points within the beams' height count."""
        sonar = self._config.sensors.sonar
        x, y, z = (_column(m, name) for name in "xyz")
        level = np.hypot(x, y)
        up = np.abs(np.arctan2(z, level)) <= math.radians(sonar.vertical_half_aperture_deg)
        beam = np.rint((np.arctan2(y, x) - sonar.first_beam_rad) / sonar.beam_step_rad)
        beam = np.mod(beam, sonar.circle_beams)
        kept = up & (beam >= 0) & (beam < sonar.n_ray) & (level > 0.0) & (level <= sonar.max_range_m)
        ranges = np.full(sonar.n_ray, np.inf)
        np.minimum.at(ranges, beam[kept].astype(int), level[kept])
        hit = np.isfinite(ranges)
        if not hit.any():
            raise ValueError("no point in sight of the sonar")
        ranges = np.where(hit, ranges, sonar.max_range_m)
        self.source.add(SonarPing(come_s, ranges, hit * 1.0, np.zeros(0)), what)

    def servos(self, m: Any, come_s: float, _: set[str], what: str) -> None:
        fields = {f"servo{i + 1}_raw": int(width) for i, width in enumerate(m.channels[:16])}
        self.telemetry.take("SERVO_OUTPUT_RAW", fields, come_s, what)

    def px4(self, m: Any, come_s: float, wanted: set[str], what: str) -> None:
        """North, east, down; ahead, right, down."""
        if "attitude" in wanted:
            self.attitude(_angles(*m.q), m.angular_velocity, come_s, what)
        if "dvl" in wanted and m.velocity_frame == _BODY:
            self.velocity(m.velocity[0], m.velocity[1], m.velocity[2], come_s, what)
        if "position" in wanted:
            self.position(m.position[0], m.position[1], m.position[2], come_s, what)


_BODY = 3  # velocity_frame of PX4
_LEAST_PA = 3e4  # of the air, anywhere


def _flipped(turn: Any, rates: Any) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """(angles, rates) of REP 103 as north, east, down and ahead, right, down."""
    roll, pitch, yaw = _angles(turn.w, turn.x, turn.y, turn.z)
    return (roll, -pitch, math.pi / 2 - yaw), (rates.x, -rates.y, -rates.z)


def _angles(w: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Roll, pitch, yaw [rad]."""
    if not abs(w * w + x * x + y * y + z * z - 1.0) < 0.1:
        raise ValueError("an orientation that is none")
    return angles_of(w, x, y, z)


def _column(m: Any, name: str) -> np.ndarray:
    """(points,) of a field of 32-bit floats. ValueError for a cloud that is another."""
    offset = next((one.offset for one in m.fields if one.name == name and one.datatype == 7), None)
    data, step, width = np.asarray(m.data, np.uint8), int(m.point_step), int(m.width) * int(m.height)
    if offset is None or m.is_bigendian or step < offset + 4 or m.row_step != step * m.width:
        raise ValueError("a cloud that is big-endian, padded, or without x, y, z")
    if data.size != step * width:
        raise ValueError("a cloud that is cut off")
    return data.reshape(width, step)[:, offset : offset + 4].copy().view("<f4")[:, 0].astype(np.float64)


Read = Callable[[_Bag, Any, float, set[str], str], None]
TOLD: dict[str, tuple[tuple[str, ...], Read]] = {
    "sensor_msgs/msg/Imu": (("attitude",), _Bag.imu),
    "sensor_msgs/msg/FluidPressure": (("pressure",), _Bag.pressure),
    "marine_acoustic_msgs/msg/Dvl": (("dvl",), _Bag.dvl),
    "geometry_msgs/msg/TwistWithCovarianceStamped": (("dvl",), _Bag.twist),
    "nav_msgs/msg/Odometry": (("attitude", "dvl", "position"), _Bag.odometry),
    "px4_msgs/msg/VehicleOdometry": (("attitude", "dvl", "position"), _Bag.px4),
    "ping360_sonar_msgs/msg/SonarEcho": (("sonar",), _Bag.echo),
    "ping360_sonar/msg/SonarEcho": (("sonar",), _Bag.echo),
    "sensor_msgs/msg/LaserScan": (("sonar",), _Bag.laser),
    "sensor_msgs/msg/PointCloud2": (("sonar",), _Bag.cloud),
    "mavros_msgs/msg/RCOut": (("motors",), _Bag.servos),
}
"""message: what it tells, and how it is read; of several that tell the same the first counts"""


def read_bag(source: Source, config: Config, start: tuple[float, ...]) -> None:
    """All files of a bag. Raises RecordingError, LogError, FileError, OSError."""
    path = source.path
    files = parts_of(path) if path.is_dir() else [path]
    bag = _Bag(source, config, start)
    bag.choose(files)
    for file in files:
        for row in rows(file):
            bag.take(row)
    bag.telemetry.finish()
