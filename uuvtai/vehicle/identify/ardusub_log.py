"""Drives out of ArduSub's own logs, by pymavlink: DataFlash (``.bin``) and what a ground station wrote down
(``.tlog``).

Pulse widths become commanded rotor speeds by the maker's table; velocities are the DVL's
(``VISION_POSITION_DELTA``) where the log has them, else those of ArduSub's filter. ArduSub's axes are ahead,
right, down and north, east, down.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import math
import os
import struct
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from uuvtai.common.clocks import SEVERAL, SourceClock, stamp_of
from uuvtai.common.errors import ODD
from uuvtai.common.files import open_file, refusing
from uuvtai.config import VehicleConfig
from uuvtai.logs.reader import read_messages
from uuvtai.vehicle.identify.drive_log import Drive, DriveError, drives_of, refuse_long, thrust_of, up_axis
from uuvtai.vehicle.mavlink import EXTRA
from uuvtai.vehicle.telemetry import AUTOPILOT, NEUTRAL_US, Motors, Senders

SUFFIXES = (".bin", ".tlog")
STEP_S = 0.02
_HOLE_S = 1.0  # pulses or attitude that are further apart part a log
_MOST_BYTES = 2 << 30
_MOST_READINGS = 5_000_000
_BIN_HEAD = b"\xa3\x95\x80"
_CHANNELS = 16
_STILL_N = 1e-6
_FIRST_MOTOR = 33  # SERVOn_FUNCTION of the first motor; 40 is the eighth
_EKF2 = 2  # AHRS_EKF_TYPE that steers by NKF1
_MOST_NAMED = 8
_APART_S = 10.0  # the file's clock and ArduSub's that run apart by more belong to another start
_OF_A_BIN = 0  # system of a DataFlash log, which is one vehicle's


@dataclass
class _Readings:
    """What one instrument said."""

    time_s: Sequence[float] = field(default_factory=lambda: array("d"))
    flat: Sequence[float] = field(default_factory=lambda: array("d"))

    @property
    def values(self) -> np.ndarray:
        """(n, values)"""
        return np.array(self.flat).reshape(len(self.time_s), -1)

    def add(self, time_s: float, *values: float) -> None:
        """A reading; one that is not finite, or does not come after the last one, is left out."""
        if all(map(math.isfinite, (time_s, *values))) and not (self.time_s and time_s <= self.time_s[-1]):
            self.time_s.append(time_s)
            self.flat.extend(values)

    def at(self, times: np.ndarray) -> np.ndarray:
        """(n, values) on straight lines between the readings."""
        return np.stack([np.interp(times, self.time_s, column) for column in self.values.T], axis=1)


@dataclass
class _Heard:
    """What a log holds of one vehicle between two starts of its autopilot."""

    pulse: _Readings = field(default_factory=_Readings)  # [us] of 16 channels
    angle: _Readings = field(default_factory=_Readings)  # [rad] roll, pitch, yaw
    rate: _Readings = field(default_factory=_Readings)  # [rad/s]
    dvl: _Readings = field(default_factory=_Readings)  # [m/s] ahead, right, down
    filtered: _Readings = field(default_factory=_Readings)  # [m/s] north, east, down, by EKF3
    older: _Readings = field(default_factory=_Readings)  # the same by EKF2, before ArduSub 4.1
    armed: _Readings = field(default_factory=_Readings)
    behind_s: float = math.inf  # the file's clock less ArduSub's, by the message that came soonest
    apart: int = 0  # messages in a row that say something else of this
    parameters: dict[str, float] = field(default_factory=dict)


def read_ardusub(
    path: Path,
    vehicle_cfg: VehicleConfig,
    system: int | None = None,
    note: Callable[[str], None] = lambda text: None,
) -> list[Drive]:
    """The drives of one vehicle of a file, while it was armed; a clock that falls begins a new one.
    ``system``: its id where a .tlog holds several, None = whose motors it tells most of; ``note`` is told
    what was chosen and left out. Raises DriveError, SettingError."""
    drives: list[Drive] = []
    wrong: list[tuple[int, DriveError]] = []
    boots = _boots(path, system, note)
    for heard in boots:
        try:
            drives += _drives(path, heard, vehicle_cfg)
        except DriveError as error:
            wrong.append((-len(heard.pulse.time_s), error))
    if not drives:
        raise min(wrong, key=lambda row: row[0])[1]
    if len(boots) > 1:
        note(
            f"{path}: the autopilot's clock began anew {len(boots) - 1} times; its drives are kept apart: "
            + ", ".join(f"{drive.dt_s * len(drive.rpm):.0f} s" for drive in drives)
        )
    for _, error in wrong:
        note(f"left out, {error}")
    return drives


def read_imported(path: Path, vehicle_cfg: VehicleConfig) -> list[Drive]:
    """The drives of a log of ``uuv log import``, as ``read_ardusub`` finds them."""
    heard, flip = _Heard(), np.array([1.0, -1.0, -1.0])
    into = {
        "/motors/pulses": lambda data: [(heard.pulse, [*data["us"][:8], *[0.0] * 8])],
        "/sensors/dvl": lambda data: [(heard.dvl, flip * data["velocity"])],
        "/sensors/imu": lambda data: [
            (heard.angle, flip * data["attitude"]),
            (heard.rate, flip * data["rates"]),
        ],
    }
    try:
        for message in read_messages(path, into):
            for series, values in into[message.topic](message.data):
                series.add(message.time_s, *map(float, values))
    except ODD:
        raise DriveError(
            f"{path}: a message is not as its schema says; import its recordings again"
        ) from None
    return _drives(path, heard, vehicle_cfg)


def _drives(path: Path, heard: _Heard, vehicle_cfg: VehicleConfig) -> list[Drive]:
    for name, series in (
        ("pulse widths (RCOU, SERVO_OUTPUT_RAW)", heard.pulse),
        ("attitude (ATT, ATTITUDE)", heard.angle),
        ("rates (IMU, ATTITUDE)", heard.rate),
        ("velocity (VISO, XKF1, NKF1, VISION_POSITION_DELTA, LOCAL_POSITION_NED)", _velocity(heard)),
    ):
        if len(series.time_s) < 2:
            raise DriveError(
                f"{path}: holds no {name}; log it (LOG_BITMASK) and drive again, with a DVL, or give a CSV"
            )
    times = _times(heard, path)
    if len(times) < 2:
        raise DriveError(f"{path}: was never armed while pulses and attitude were logged")
    grid = _LogTimes(times)
    after = np.stack([grid.after(series) for series in (_velocity(heard), heard.rate)], axis=1)
    rpm, jumped = _asked(times, heard, vehicle_cfg)
    return drives_of(np.column_stack([_rows(times, grid, heard), rpm]), path, "line", after, jumped)


def _velocity(heard: _Heard) -> _Readings:
    if len(heard.dvl.time_s) > 1:
        return heard.dvl
    flown = heard.parameters.get("AHRS_EKF_TYPE", 3.0)
    return heard.older if len(heard.filtered.time_s) < 2 or flown == _EKF2 else heard.filtered


def _times(heard: _Heard, path: Path) -> np.ndarray:
    """Every STEP_S while armed, without holes of the inputs. Raises DriveError."""
    inputs = [np.array(series.time_s) for series in (heard.pulse, heard.angle, heard.rate)]
    start, end = max(known[0] for known in inputs), min(known[-1] for known in inputs)
    holes = [(known[i], known[i + 1]) for known in inputs for i in np.flatnonzero(np.diff(known) > _HOLE_S)]
    spans, begin = [], start
    for last, first in [*sorted(holes), (end, end)]:
        if begin < min(last, end):
            spans.append(np.ceil((np.array([begin, min(last, end)]) - start) / STEP_S))
        begin = max(begin, first)
    refuse_long(path, sum(int(last - first) for first, last in spans))
    times = np.concatenate([np.empty(0), *(start + STEP_S * np.arange(*span) for span in spans)])
    if heard.armed.time_s:
        place = np.searchsorted(heard.armed.time_s, times, side="right") - 1
        times = times[(place >= 0) & (heard.armed.values[place, 0] > 0)]
    return times


def _rows(times: np.ndarray, grid: _LogTimes, heard: _Heard) -> np.ndarray:
    """(n, 10) as ``drives_of`` wants them, without rotor speeds."""
    unwound = np.unwrap(heard.angle.values, axis=0).ravel().tolist()  # without jumps of a turn
    angle, rate = _Readings(heard.angle.time_s, unwound).at(times), heard.rate.at(times)
    if _velocity(heard) is heard.dvl:
        velocity = grid.near(heard.dvl)
    else:
        velocity = _to_body(grid.near(_velocity(heard)), angle)
    turn = grid.near(heard.rate)[:, 2]
    up = up_axis(angle[:, 0], -angle[:, 1])
    flipped = [velocity[:, 0], -velocity[:, 1], -velocity[:, 2], -turn, rate[:, 0], -rate[:, 1]]
    return np.column_stack([times, *flipped, up])


class _LogTimes:
    """Times of the rows on the whole grid that they are cut from."""

    def __init__(self, times: np.ndarray) -> None:
        self.first, self.rows = times[0], np.rint((times - times[0]) / STEP_S).astype(int)

    def near(self, series: _Readings) -> np.ndarray:
        """(n, values) readings at the rows next to them, NaN elsewhere."""
        values = series.values
        found = np.full((len(self.rows), values.shape[1]), np.nan)
        row, read, _ = self._placed(series)
        found[row] = values[read]
        return found

    def after(self, series: _Readings) -> np.ndarray:
        """(n,) [s] by how much later than its row each of them was read; 0 where there is none."""
        found = np.zeros(len(self.rows))
        row, _, late_s = self._placed(series)
        found[row] = late_s
        return found

    def _placed(self, series: _Readings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows, the readings (bool) next to them, by how much these are later [s]."""
        known = np.array(series.time_s)
        place = np.rint((known - self.first) / STEP_S).astype(int)
        row = np.minimum(np.searchsorted(self.rows, place), len(self.rows) - 1)
        read = self.rows[row] == place
        return row[read], read, (known - (self.first + STEP_S * place))[read]


def _to_body(velocity: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """(n, 3) ahead, right, down of north, east, down (Fossen, Handbook of Marine Craft, 2011, eq. 2.18)."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(angle).T, np.cos(angle).T
    north, east, down = velocity.T
    ahead = cp * cy * north + cp * sy * east - sp * down
    right = (sr * sp * cy - cr * sy) * north + (sr * sp * sy + cr * cy) * east + sr * cp * down
    below = (cr * sp * cy + sr * sy) * north + (cr * sp * sy - sr * cy) * east + cr * cp * down
    return np.stack([ahead, right, below], axis=1)


def _asked(times: np.ndarray, heard: _Heard, vehicle_cfg: VehicleConfig) -> tuple[np.ndarray, np.ndarray]:
    """(n, thrusters) and (n, thrusters) [rpm] asked for. Between two messages thrust goes on a straight line:
    so it does in the mean over all moments at which a stick may have been pushed. Or it jumps halfway."""
    motors, known = Motors(vehicle_cfg), np.array(heard.pulse.time_s)
    speeds = np.array([motors.rpm(by_motor(row, heard.parameters)) for row in heard.pulse.values])
    thrust = thrust_of(speeds, vehicle_cfg)
    pushed = np.stack([np.interp(times, known, column) for column in thrust.T], axis=1)
    table = np.arange(-motors.most_rpm, motors.most_rpm + 1.0)
    found = np.interp(pushed, thrust_of(table, vehicle_cfg), table)
    nearest = np.searchsorted(0.5 * (known[1:] + known[:-1]), times + 0.5 * STEP_S)
    return np.where(np.abs(pushed) < _STILL_N, 0.0, found), speeds[nearest]


def by_motor(pulse: np.ndarray, parameters: dict[str, float]) -> list[float]:
    """[us] of motors 1 to 8, as if none were reversed."""
    found = pulse[:8].tolist()
    for channel in range(_CHANNELS):
        motor = int(parameters.get(f"SERVO{channel + 1}_FUNCTION", 0)) - _FIRST_MOTOR
        if 0 <= motor < 8:
            found[motor] = float(pulse[channel])
    ways = [parameters.get(f"MOT_{motor + 1}_DIRECTION", 1.0) for motor in range(8)]
    return [
        NEUTRAL_US + (-1.0 if way < 0 else 1.0) * (width - NEUTRAL_US) if width else 0.0
        for way, width in zip(ways, found, strict=True)
    ]


# ----------------------------------------------------------------------------------------------------- files


def _boots(path: Path, system: int | None, note: Callable[[str], None]) -> list[_Heard]:
    """What one vehicle of a file said, by starts of its autopilot. Raises DriveError."""
    unread = f"{path}: cannot be read"
    with refusing(DriveError, unread, "give a .bin or .tlog"), open_file(path, _MOST_BYTES) as file:
        head = file.read(len(_BIN_HEAD))
    is_bin = path.suffix.lower() == ".bin"
    if is_bin and head != _BIN_HEAD:
        raise DriveError(f"{path}: does not begin like a DataFlash log of ArduPilot's")
    if importlib.util.find_spec("pymavlink") is None:
        raise DriveError(f"{path}: is read by pymavlink, which is not here: pip install '{EXTRA}'")
    found, kind = _Sorted(), ""
    try:
        with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
            for count, message in enumerate(messages(path, is_bin, list(_OF_BIN if is_bin else _OF_TLOG))):
                kind = message.get_type()
                if is_bin:
                    found.take_bin(message, count)
                else:
                    found.take_tlog(message)
                if count > _MOST_READINGS:
                    raise DriveError(f"{path}: holds more than {_MOST_READINGS} messages; cut it")
    except (DriveError, MemoryError):
        raise
    except AttributeError as error:
        raise DriveError(
            f"{path}: its messages {kind} are of a firmware that is not read ({error}); give a log of "
            "ArduSub 3.5 or later, or a CSV"
        ) from None
    except Exception as error:  # pymavlink raises this very class for a format that it does not know
        raise DriveError(f"{path}: is damaged ({type(error).__name__}: {error}); give another log") from None
    return found.of(path, _OF_A_BIN if is_bin else system, note)


class _Sorted:
    """A file's messages by vehicle, and by starts of its autopilot."""

    def __init__(self) -> None:
        self._boots: dict[int, list[_Heard]] = {}
        self._clocks: dict[int, SourceClock] = {}
        self._dvls: dict[tuple[int, int], tuple[SourceClock, _Heard]] = {}
        """what DVLs said, by the file's clock"""
        self._left_out: Counter[str] = Counter()

    def take_bin(self, m: Any, count: int) -> None:
        """The ``count``-th message of a DataFlash log."""
        clock, heard = self._of(_OF_A_BIN)
        clock.measured_s(m.TimeUS / 1e6, 1e-6 * count)
        if clock.restarts:
            heard = self._anew(_OF_A_BIN, clock.sent_s, 1e-6 * count)
        _OF_BIN[m.get_type()](heard, m, clock.sent_s)

    def take_tlog(self, m: Any) -> None:
        """A message that a ground station wrote down."""
        name, system, component = m.get_type(), m.get_srcSystem(), m.get_srcComponent()
        sent_s, wrap_s = stamp_of(vars(m))
        if name == "VISION_POSITION_DELTA":
            clock, heard = self._dvls.setdefault((system, component), (SourceClock(), _Heard()))
            _OF_TLOG[name](heard, m, clock.measured_s(sent_s, m._timestamp, wrap_s))
            return
        if component != AUTOPILOT:
            self._left_out[f"{name} of {system}/{component}"] += name != "HEARTBEAT"
            return
        clock, heard = self._of(system)
        if math.isnan(clock.sent_s) and not hasattr(m, "time_boot_ms"):
            if name == "PARAM_VALUE":
                _OF_TLOG[name](heard, m, 0.0)
            return  # a counter that has run over says nothing before the clock is known
        clock.measured_s(sent_s, m._timestamp, wrap_s)
        behind_s = m._timestamp - clock.sent_s
        if hasattr(m, "time_boot_ms"):
            heard.apart = heard.apart + 1 if _APART_S < abs(behind_s - heard.behind_s) < math.inf else 0
        if clock.restarts or heard.apart >= SEVERAL:
            heard = self._anew(system, clock.sent_s, m._timestamp)
        if not heard.apart:
            heard.behind_s = min(heard.behind_s, behind_s)
        _OF_TLOG[name](heard, m, clock.sent_s)

    def _of(self, system: int) -> tuple[SourceClock, _Heard]:
        boots = self._boots.setdefault(system, [_Heard()])
        return self._clocks.setdefault(system, SourceClock()), boots[-1]

    def _anew(self, system: int, sent_s: float, come_s: float) -> _Heard:
        """The content from here on, where the autopilot was started again; parameters stay."""
        self._clocks[system] = SourceClock()
        self._clocks[system].measured_s(sent_s, come_s)
        boots = self._boots[system]
        boots.append(_Heard(parameters=dict(boots[-1].parameters)))
        return boots[-1]

    def of(self, path: Path, system: int | None, note: Callable[[str], None]) -> list[_Heard]:
        """What one vehicle said. Raises DriveError."""
        told = {one: sum(len(heard.pulse.time_s) for heard in boots) for one, boots in self._boots.items()}
        driven = sorted(one for one, pulses in told.items() if pulses)
        if system is not None and system != _OF_A_BIN and system not in driven:
            names = ", ".join(map(str, driven)) or "none"
            raise DriveError(f"{path}: no motors of --system {system} in it; it has those of {names}")
        chosen = max(told, key=lambda one: told[one], default=_OF_A_BIN) if system is None else system
        if len(driven) > 1:
            names = ", ".join(map(str, driven))
            note(f"{path}: holds vehicles {names}, of which {chosen} is read; --system names another")
        boots = self._boots.get(chosen, [_Heard()])
        senders, left_out = Senders(chosen), self._left_out
        heard_dvls = {}
        for sender, (_, heard) in self._dvls.items():
            if senders.counts("VISION_POSITION_DELTA", *sender):
                heard_dvls[sender] = heard.dvl
            else:
                left_out["VISION_POSITION_DELTA of {}/{}".format(*sender)] += len(heard.dvl.time_s)
        best = max(heard_dvls, key=lambda sender: len(heard_dvls[sender].time_s), default=None)
        for sender, series in heard_dvls.items():
            if sender == best:
                for boot in boots:
                    boot.dvl = _of_boot(series, boot)
            else:
                left_out["VISION_POSITION_DELTA of {}/{}".format(*sender)] += len(series.time_s)
        for what, count in (+left_out).most_common(_MOST_NAMED):
            note(f"{path}: left out {count} {what}")
        return boots


def _of_boot(series: _Readings, boot: _Heard) -> _Readings:
    """Readings by the file's clock as those of one start of the autopilot, by its clock."""
    found = _Readings()
    if boot.angle.time_s:
        times = np.array(series.time_s) - boot.behind_s
        kept = (times >= boot.angle.time_s[0] - _HOLE_S) & (times <= boot.angle.time_s[-1] + _HOLE_S)
        found = _Readings(times[kept].tolist(), series.values[kept].ravel().tolist())
    return found


def messages(path: Path, is_bin: bool, names: list[str] | None = None) -> Iterator[Any]:
    """Messages of these types, or all, in the order of the file."""
    from pymavlink import DFReader, mavutil

    kept, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)  # its indexer in C tells of each byte that is no message
    try:
        log: Any = DFReader.DFReader_binary(str(path)) if is_bin else mavutil.mavlogfile(str(path))
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(null)
    try:
        while (message := log.recv_match(type=names)) is not None:
            yield message
    except struct.error:
        return  # the file ends in the middle of a message
    finally:
        (log.filehandle if is_bin else log.f).close()


Take = Callable[[_Heard, Any, float], None]
"""content, message, its time by the autopilot's clock (a DVL's: by the file's)"""


def _vision(heard: _Heard, time_s: float, delta_s: float, moved: tuple[float, ...], sure: float) -> None:
    if delta_s > 0 and sure > 0:
        heard.dvl.add(time_s, *(value / delta_s for value in moved))


def _imu(heard: _Heard, m: Any, time_s: float) -> None:
    if getattr(m, "I", 0) == 0:  # ArduSub before 4.1 has messages IMU2 and IMU3 in its place
        heard.rate.add(time_s, m.GyrX, m.GyrY, m.GyrZ)


def _lane(series: _Readings, m: Any, time_s: float) -> None:
    if getattr(m, "C", 0) == 0:  # of the first core; before 4.1 NKF6 was that of the second
        series.add(time_s, m.VN, m.VE, m.VD)


def _parameter(heard: _Heard, name: Any, value: float) -> None:
    if math.isfinite(value):
        heard.parameters[str(name)] = value


def _event(heard: _Heard, m: Any, time_s: float) -> None:
    if m.Id in (10, 11):  # LogEvent::ARMED, DISARMED
        if m.Id == 11 and not heard.armed.time_s:  # the log begins under way
            heard.armed.add(0.0, 1.0)
        heard.armed.add(time_s, float(m.Id == 10))


_OF_BIN: dict[str, Take] = {
    "PARM": lambda heard, m, time_s: _parameter(heard, m.Name, float(m.Value)),
    "RCOU": lambda heard, m, time_s: heard.pulse.add(
        time_s, *(float(getattr(m, f"C{i}", 0)) for i in range(1, 15)), 0.0, 0.0
    ),
    "ATT": lambda heard, m, time_s: heard.angle.add(
        time_s, *(math.radians(value) for value in (m.Roll, m.Pitch, m.Yaw))
    ),
    "IMU": _imu,
    "VISO": lambda heard, m, time_s: _vision(heard, time_s, m.dt, (m.PosDX, m.PosDY, m.PosDZ), m.conf),
    "XKF1": lambda heard, m, time_s: _lane(heard.filtered, m, time_s),
    "NKF1": lambda heard, m, time_s: _lane(heard.older, m, time_s),
    "EV": _event,
}


def _attitude(heard: _Heard, m: Any, time_s: float) -> None:
    heard.angle.add(time_s, m.roll, m.pitch, m.yaw)
    heard.rate.add(time_s, m.rollspeed, m.pitchspeed, m.yawspeed)


def _servos(heard: _Heard, m: Any, time_s: float) -> None:
    if m.port == 0:
        widths = (float(getattr(m, f"servo{i}_raw", 0)) for i in range(1, 17))
        heard.pulse.add(time_s, *widths)


_OF_TLOG: dict[str, Take] = {
    "PARAM_VALUE": lambda heard, m, time_s: _parameter(heard, m.param_id, float(m.param_value)),
    "SERVO_OUTPUT_RAW": _servos,
    "ATTITUDE": _attitude,
    "VISION_POSITION_DELTA": lambda heard, m, time_s: _vision(
        heard, time_s, m.time_delta_usec / 1e6, tuple(m.position_delta), m.confidence
    ),
    "LOCAL_POSITION_NED": lambda heard, m, time_s: heard.filtered.add(time_s, m.vx, m.vy, m.vz),
    "HEARTBEAT": lambda heard, m, time_s: heard.armed.add(time_s, float(bool(m.base_mode & 128))),
}
