"""What one recorded file told: ArduSub's logs, those of uuv pilot, lines of a DVL A50, Ping Viewer's Ping360.

Everything goes through what hears it on a vehicle: ``telemetry.Intake``, ``instruments.a50``,
``instruments.ping``. Times are the file's own.
"""

from __future__ import annotations

import contextlib
import io
import math
import re
import struct
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from uuvtai.common.errors import ODD, UserError
from uuvtai.common.files import json_object, open_file, read_lines
from uuvtai.config import Config
from uuvtai.logs.reader import read_messages
from uuvtai.vehicle.identify.ardusub_log import by_motor, messages
from uuvtai.vehicle.instruments.a50 import A50, LONGEST
from uuvtai.vehicle.instruments.channel import Channel, Instrument
from uuvtai.vehicle.instruments.ping import AUTO_DEVICE_DATA, DEVICE_DATA, TICK_S, Frames, Ping360
from uuvtai.vehicle.instruments.rig import as_fields
from uuvtai.vehicle.messages import ANY, KINDS, DvlReading, Inbox, SensorMessage, SonarPing, is_believed
from uuvtai.vehicle.pilot_log import SEEN
from uuvtai.vehicle.telemetry import AUTOPILOT, KIND_OF, Intake, Senders

MOST_BYTES = 2 << 30
MOST_READINGS = 2_000_000
MOST_MESSAGES = 20_000_000
_MOST_KINDS = 500  # of what was dropped, told apart
_USED = frozenset(KIND_OF) - {"SYS_STATUS", "BATTERY_STATUS"}
_SILENT = frozenset(name for name, kind in KIND_OF.items() if kind == "imu")
"""messages that come out with the next attitude"""
NOT_USED, ODD_SHAPE = "not used", "not as its definition says"


class RecordingError(UserError, ValueError):
    """A file of others that is not imported: what, where, why, what to type next."""


@dataclass(frozen=True, eq=False)
class Pulses:
    """Pulse widths while armed."""

    time_s: float
    us: np.ndarray  # (8,) [us] of ArduSub's motors 1 to 8, as if none were reversed; 0 = off


Told = SensorMessage | Pulses


class Source:
    """One file: what it told, and what was dropped of it."""

    def __init__(self, path: Path, kind: str) -> None:
        self.path, self.kind, self.messages = path, kind, 0
        self.readings: list[Told] = []
        self.dropped: Counter[tuple[str, str]] = Counter()  # (message or topic, why) -> how many

    def heard(self) -> None:
        """One more message. Raises RecordingError for more than are read."""
        self.messages += 1
        if self.messages > MOST_MESSAGES:
            raise RecordingError(f"{self.path}: holds more than {MOST_MESSAGES:,} messages; cut it")

    def add(self, reading: Told, what: str) -> None:
        """Raises RecordingError for more readings than a log may have."""
        if not (np.isfinite(reading.us).all() if isinstance(reading, Pulses) else is_believed(reading)):
            self.drop(what, "numbers that cannot be")
            return
        if len(self.readings) >= MOST_READINGS:
            raise RecordingError(f"{self.path}: tells more than {MOST_READINGS:,} readings; cut it")
        self.readings.append(reading)

    def drop(self, what: str, why: str, count: int = 1) -> None:
        key = _plain(what[:80]), _plain(why[:120])
        full = key not in self.dropped and len(self.dropped) >= _MOST_KINDS
        self.dropped[("others", "more kinds than are told apart") if full else key] += count


def _plain(text: str) -> str:
    return "".join(each if each.isprintable() else "?" for each in text)


# ---- MAVLink's messages, or others that say the same.


class _NamedIntake(Intake):
    """Says why the last message was not used."""

    why = ""

    def refuse(self, why: str) -> list[SensorMessage]:
        self.why = why
        return []


_OWN = 1, AUTOPILOT


class Telemetry:
    """Of one vehicle; ``finish`` when all is told."""

    def __init__(
        self,
        source: Source,
        config: Config,
        start: tuple[float, ...],
        system: int = 1,
        replaced: Collection[str] = (),
    ) -> None:
        """``replaced``: as in ``Intake``."""
        x, y, z = start
        self._source, self._system, self._senders = source, system, Senders(system)
        self._intake = _NamedIntake(config, (x, y, z), None, system, replaced=replaced)
        self._parameters: dict[str, float] = {}
        self._pulses: list[Pulses] = []
        self.is_armed = True  # until somebody says otherwise
        self.only_places = False  # whether LOCAL_POSITION_NED tells no velocity

    def take(
        self, name: str, fields: dict[str, Any], come_s: float, what: str, sender: tuple[int, int] = _OWN
    ) -> None:
        """A message of MAVLink; ``what``: as it is called in the file."""
        try:
            if name not in _USED | {"HEARTBEAT", "PARAM_VALUE", "SERVO_OUTPUT_RAW"}:
                self._source.drop(what, NOT_USED)
            elif not self._senders.counts(name, *sender):
                self._source.drop("{} of {}/{}".format(what, *sender), "another sender")
            elif name == "PARAM_VALUE":
                self._parameters[str(fields["param_id"])] = float(fields["param_value"])
            elif name == "SERVO_OUTPUT_RAW":
                self._servos(fields, come_s, what)
            else:
                self._read(name, fields, come_s, sender, what)
        except ODD:
            self._source.drop(what, ODD_SHAPE)

    def _servos(self, fields: dict[str, Any], come_s: float, what: str) -> None:
        if int(fields.get("port", 0)) != 0 or not self.is_armed:
            self._source.drop(what, "not armed" if not self.is_armed else NOT_USED)
            return
        widths = [float(fields.get(f"servo{i}_raw", 0)) for i in range(1, 17)]
        self._pulses.append(Pulses(come_s, np.array(widths)))

    def _read(
        self, name: str, fields: dict[str, Any], come_s: float, sender: tuple[int, int], what: str
    ) -> None:
        intake = self._intake
        intake.why = ""
        found = intake.take(name, *sender, fields, come_s)
        if name == "HEARTBEAT":
            self.is_armed = intake.heard.is_armed
        elif intake.why:
            self._source.drop(what, intake.why.removeprefix(f"{name}: ").partition(": --set")[0])
        elif not found and name not in _SILENT:
            self._source.drop(what, "another message tells it")
        for reading in found:
            if not (self.only_places and name == "LOCAL_POSITION_NED" and isinstance(reading, DvlReading)):
                self._source.add(reading, what)

    def finish(self) -> None:
        """Which channel is which motor is known now."""
        for pulses in self._pulses:
            motors = np.array(by_motor(pulses.us, self._parameters))
            self._source.add(Pulses(pulses.time_s, motors), "SERVO_OUTPUT_RAW")


def read_ardusub(source: Source, config: Config, start: tuple[float, ...]) -> None:
    """A .tlog, or a DataFlash log. Raises RecordingError."""
    path, is_bin = source.path, source.kind == "DataFlash"
    try:
        with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
            system = 1 if is_bin else _system(path)
            telemetry, gyro = Telemetry(source, config, start, system), [0.0, 0.0, 0.0]
            rest = path.stat().st_size if is_bin else 0
            for m in messages(path, is_bin):
                source.heard()
                name = m.get_type()
                if is_bin:
                    rest -= m.fmt.len
                    _take_bin(telemetry, source, m, gyro)
                elif name == "BAD_DATA" or name.startswith("UNKNOWN"):
                    source.drop("bytes", "no message of MAVLink's")
                else:
                    fields = {each: getattr(m, each) for each in m.get_fieldnames()}
                    sender = m.get_srcSystem(), m.get_srcComponent()
                    telemetry.take(name, fields, m._timestamp, name, sender)
            if rest > 0:
                source.drop("bytes", "no message of a DataFlash log", rest)
    except (UserError, MemoryError):
        raise
    except Exception as error:  # pymavlink raises this very class for a format that it does not know
        raise RecordingError(
            f"{path}: is damaged ({type(error).__name__}: {str(error)[:120]}); give another copy of the file"
        ) from None
    telemetry.finish()


def _system(path: Path) -> int:
    """The vehicle that tells most."""
    told: Counter[int] = Counter()
    for m in messages(path, False, ["ATTITUDE", "HEARTBEAT"]):
        told[m.get_srcSystem()] += m.get_srcComponent() == AUTOPILOT and m.get_type() == "ATTITUDE"
    return told.most_common(1)[0][0] if told else 1


def read_pilot(source: Source, config: Config, start: tuple[float, ...]) -> None:
    """What ``uuv pilot`` heard, by its own log. Raises RecordingError, LogError."""
    told: Counter[int] = Counter()
    own: set[str] = set()
    for m in read_messages(source.path, SEEN):
        own |= {str(m.data.get("kind"))} if m.topic == SEEN[1] else set()
        is_it = (m.data.get("name"), m.data.get("component")) == ("ATTITUDE", AUTOPILOT)
        told.update([m.data.get("system", 1)] if is_it else [])
    telemetry = Telemetry(source, config, start, told.most_common(1)[0][0] if told else 1, own)
    beams = (ANY if config.sensors.sonar.mechanical else config.sensors.sonar.n_ray,)
    shapes = {"range_m": beams, "hit": beams, "doppler_m_s": (ANY,), "first_beam": ()}
    inbox = Inbox({f"sonar.{name}": shape for name, shape in shapes.items()})
    for m in read_messages(source.path, SEEN):
        source.heard()
        what = str(m.data.get("kind" if m.topic == SEEN[1] else "name"))
        try:
            if m.topic == SEEN[1] and what in ("depth", "thruster"):
                source.drop(what, NOT_USED)
            elif m.topic == SEEN[1]:
                reading = KINDS[what](**as_fields(m.data["fields"]))
                inbox.feed(reading)
                if isinstance(reading, SonarPing) and len(reading.hit) != len(reading.range_m):
                    raise ValueError(what)
                source.add(reading, what)
            else:
                sender = m.data["system"], m.data["component"]
                telemetry.take(what, m.data["fields"], m.time_s, what, sender)
        except ODD:
            source.drop(what, ODD_SHAPE)
    telemetry.finish()


def _take_bin(telemetry: Telemetry, source: Source, m: Any, gyro: list[float]) -> None:
    """A message of a DataFlash log as the one of MAVLink that says the same."""
    name, come_s = m.get_type(), float(m._timestamp)
    try:
        number = int(getattr(m, "I", 0) if name in ("IMU", "BARO") else getattr(m, "C", 0))
        if name == "IMU" and number == 0:
            gyro[:] = m.GyrX, m.GyrY, m.GyrZ
        if name == "EV":
            telemetry.is_armed = {10: True, 11: False}.get(m.Id, telemetry.is_armed)
        said = _OF_BIN[name](m, gyro, number) if name in _OF_BIN else None
    except ODD:
        source.drop(name, "of a firmware that is not read")
        return
    if said is not None:
        telemetry.take(said[0], said[1], come_s, name)
    elif name != "EV":
        source.drop(name, NOT_USED)


def _attitude(m: Any, gyro: list[float], _: int) -> tuple[str, dict[str, Any]]:
    fields = {name.lower(): math.radians(getattr(m, name)) for name in ("Roll", "Pitch", "Yaw")}
    return "ATTITUDE", fields | dict(zip(("rollspeed", "pitchspeed", "yawspeed"), gyro, strict=True))


def _same(name: str, first_only: bool = False, **columns: str) -> Any:
    """The message of MAVLink that has a DataFlash message's columns as its fields."""
    return lambda m, gyro, number: (
        None if first_only and number else (name, {to: getattr(m, own) for to, own in columns.items()})
    )


_OF_BIN: dict[str, Any] = {
    "ATT": _attitude,
    "IMU": _same("HIGHRES_IMU", True, xacc="AccX", yacc="AccY", zacc="AccZ"),
    "BARO": lambda m, _, number: (
        f"SCALED_PRESSURE{number + 1 if number else ''}", {"press_abs": float(m.Press) / 100.0}),
    "VISO": lambda m, *_: (
        "VISION_POSITION_DELTA",
        {"time_delta_usec": m.dt * 1e6, "position_delta": (m.PosDX, m.PosDY, m.PosDZ), "confidence": m.conf}),
    "XKF1": _same("LOCAL_POSITION_NED", True, x="PN", y="PE", z="PD", vx="VN", vy="VE", vz="VD"),
    "RCOU": lambda m, *_: (
        "SERVO_OUTPUT_RAW", {f"servo{i}_raw": getattr(m, f"C{i}", 0) for i in range(1, 17)}),
    "PARM": _same("PARAM_VALUE", param_id="Name", param_value="Value"),
}  # fmt: skip


# ---- Instruments, whose bytes are handed to what hears them on a vehicle.


class _Piece(Channel):
    """A piece of a file."""

    opened, data = 1, b""

    def read(self, now_s: float) -> list[bytes]:
        piece, self.data = self.data, b""
        return [piece]

    def close(self) -> None:
        """As in ``Channel``."""


class Played:
    """An instrument that hears a file."""

    def __init__(self, source: Source, instrument: Instrument, what: str) -> None:
        self._source, self._what, self._instrument = source, what, instrument
        self._refused: Counter[str] = Counter()

    def hear(self, data: bytes, come_s: float, what: str = "") -> None:
        """A piece that came then."""
        channel, instrument = self._instrument.channel, self._instrument
        assert isinstance(channel, _Piece)
        channel.data = data
        for reading in instrument.poll(come_s):
            self._source.add(reading, what or self._what)
        for why, count in (instrument.refused - self._refused).items():
            self._source.drop(what or self._what, why, count)
        self._refused = Counter(instrument.refused)


def ping360(source: Source, config: Config) -> Played:
    """Raises SettingError for a config whose sonar is none."""
    sonar = config.sensors.sonar
    head = Ping360(_Piece(), sonar, sonar.zero_gradian, sonar.min_range_m, sonar.sound_m_s)
    return Played(source, head, "Ping360")


_TIME = re.compile(rb"[\s\[(\"']*([0-9][0-9T:.,+\- ]*Z?)")
_LONGEST_PREFIX = 64
_LONGEST_GAP_S = 60.0


def read_a50(source: Source, config: Config) -> None:
    """Lines of JSON, each perhaps behind the time when it came: seconds, ISO 8601, or a clock's."""
    dvl = config.sensors.dvl
    device = A50(_Piece(), math.radians(dvl.yaw_deg), dvl.fom_most_m_s, dvl.latency_s)
    played, clock, come_s = Played(source, device, "a line"), _Clock(), 0.0
    for row in read_lines(source.path, MOST_BYTES, longest=4 * LONGEST):
        line = row.strip()
        if not line:
            continue
        source.heard()
        at = line.find(b"{", 0, _LONGEST_PREFIX)
        said = json_object(line[at:]) if at >= 0 else None
        if said is None:
            source.drop("a line", "no JSON object")
            continue
        found = _TIME.match(line[:at])
        come_s = clock(found[1]) if found else _told_s(said, come_s)
        played.hear(line[at:] + b"\n", come_s)


def _told_s(said: dict[str, Any], before_s: float) -> float:
    """By the device: its clock, else how long after the line before."""
    sent, spent = (_number(said.get(name)) for name in ("time_of_transmission", "time"))
    if sent > 0:
        return 1e-6 * sent
    is_velocity = said.get("type", "velocity") == "velocity"
    return before_s + (1e-3 * spent if is_velocity and 0.0 <= spent <= 1e3 * _LONGEST_GAP_S else 0.0)


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else math.nan


class _Clock:
    """[s] of times as written; those of a clock go on after midnight."""

    def __init__(self) -> None:
        self._day_s = self._last_s = 0.0

    def __call__(self, text: bytes) -> float:
        told_s = _clock_s(text)
        if not told_s < 2.0 * _HALF_DAY_S:
            return told_s
        self._day_s += 2.0 * _HALF_DAY_S * (told_s < self._last_s - _HALF_DAY_S)
        self._last_s = told_s
        return self._day_s + told_s


def _clock_s(text: bytes) -> float:
    """[s] of a time as written; NaN = it is none."""
    written = text.decode("ascii", "replace").strip(" ,-").replace(",", ".")
    with contextlib.suppress(ValueError):
        seconds = float(written)
        return seconds * next((unit for most, unit in ((1e11, 1.0), (1e14, 1e-3)) if seconds < most), 1e-6)
    with contextlib.suppress(ValueError):
        moment = datetime.fromisoformat(written.replace("Z", "+00:00"))
        return (moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)).timestamp()
    with contextlib.suppress(ValueError):
        hours, minutes, seconds = (float(part) for part in written.split(":"))
        return 3600.0 * hours + 60.0 * minutes + seconds
    return math.nan


VIEWER = b"PingViewer sensor log file"
_MOST_ENTRY, _NO_TEXT = 1 << 16, 0xFFFFFFFF
_HALF_DAY_S = 43_200.0


def read_ping_viewer(source: Source, config: Config) -> None:
    """Ping Viewer's recording, by the clock that it wrote."""
    played, clock = ping360(source, config), _Clock()
    for time, message in _pairs(source):
        source.heard()
        played.hear(message, clock(time.replace(b"\0", b"")))


def reach_m(path: Path) -> float:
    """[m] how far the first profile of Ping Viewer's recording reaches at 1500 m/s. Raises RecordingError."""
    for _, message in _pairs(Source(path, "")):
        for number, payload in Frames().take(message):
            if number in (DEVICE_DATA, AUTO_DEVICE_DATA) and len(payload) > _ABOUT:
                (period,) = struct.unpack_from("<H", payload, 6)
                return 0.5 * TICK_S * period * (len(payload) - _ABOUT) * 1500.0
    raise RecordingError(f"{path}: tells nothing: it holds no profile of a Ping360; name another recording")


_ABOUT = 20  # [bytes] before a profile, six fewer in an older message


def _pairs(source: Source) -> Iterator[tuple[bytes, bytes]]:
    """(time, message of the ping-protocol): big endian, each behind its length, after words about the
    program: what it is, a version, then commit, date, tag, system's name and version, and the sensor."""
    with open_file(source.path, MOST_BYTES) as file:
        parts = _entries(file)
        next(parts, b"")
        file.read(4)
        for _ in range(5):
            next(parts, b"")
        file.read(8)
        yield from zip(parts, parts, strict=False)
        if file.read(1):
            source.drop("the rest of the file", "cut off, or damaged")


def _entries(file: io.BufferedReader) -> Iterator[bytes]:
    """Up to the end, or to what is none, which is left in the file."""
    while len(head := file.read(4)) == 4:
        size = int.from_bytes(head, "big")
        size = 0 if size == _NO_TEXT else size
        if size > _MOST_ENTRY or len(entry := file.read(size)) < size:
            file.seek(-1, io.SEEK_CUR)
            return
        yield entry
    file.seek(-len(head), io.SEEK_CUR)
