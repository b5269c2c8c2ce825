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
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from uuvtai.config import VehicleConfig
from uuvtai.files import open_file
from uuvtai.identify.drive_log import Drive, DriveError, drives_of, up_axis
from uuvtai.identify.rotor_lag import thrust_of
from uuvtai.link.dialect import EXTRA
from uuvtai.link.motors import NEUTRAL_US, Motors

ENDINGS = (".bin", ".tlog")
STEP_S = 0.02
_HOLE_S = 1.0
"""pulses or attitude that are further apart part a log"""
_MOST_BYTES = 2 << 30
_MOST_READINGS = 5_000_000
_BIN_HEAD = b"\xa3\x95\x80"
_CHANNELS = 16
_STILL_N = 1e-6
_FIRST_MOTOR = 33
"""SERVOn_FUNCTION of the first motor; 40 is the eighth"""
_AUTOPILOT = 1
"""MAV_COMP_ID_AUTOPILOT1"""


@dataclass
class _Readings:
    """What one instrument said."""

    time_s: list[float] = field(default_factory=list)
    values: list[tuple[float, ...]] = field(default_factory=list)

    def add(self, time_s: float, *values: float) -> None:
        """A reading; one that is not finite, or does not come after the last one, is left out."""
        if all(map(math.isfinite, (time_s, *values))) and not (self.time_s and time_s <= self.time_s[-1]):
            self.time_s.append(time_s)
            self.values.append(values)

    def at(self, times: np.ndarray) -> np.ndarray:
        """(n, values) on straight lines between the readings."""
        rows = np.array(self.values)
        return np.stack([np.interp(times, self.time_s, column) for column in rows.T], axis=1)

    def near(self, times: np.ndarray) -> np.ndarray:
        """(n, values) each reading at the time next to it, NaN elsewhere."""
        rows = np.array(self.values)
        found = np.full((len(times), rows.shape[1]), np.nan)
        place = np.rint((np.array(self.time_s) - times[0]) / STEP_S).astype(int)
        inside = (place >= 0) & (place < len(times))
        found[place[inside]] = rows[inside]
        return found


@dataclass
class _Heard:
    """A log's content."""

    pulse: _Readings = field(default_factory=_Readings)
    """[us] of 16 channels"""
    angle: _Readings = field(default_factory=_Readings)
    """[rad] roll, pitch, yaw"""
    rate: _Readings = field(default_factory=_Readings)
    """[rad/s]"""
    dvl: _Readings = field(default_factory=_Readings)
    """[m/s] ahead, right, down"""
    filtered: _Readings = field(default_factory=_Readings)
    """[m/s] north, east, down"""
    armed: _Readings = field(default_factory=_Readings)
    behind_s: float = math.inf
    """the file's clock less ArduSub's, by the message that came soonest"""
    parameters: dict[str, float] = field(default_factory=dict)


def read_ardusub(path: Path, vehicle_cfg: VehicleConfig) -> list[Drive]:
    """The drives of a file while it was armed. Raises DriveError, SettingError."""
    heard = _heard(path)
    for name, series in (
        ("pulse widths (RCOU, SERVO_OUTPUT_RAW)", heard.pulse),
        ("attitude (ATT, ATTITUDE)", heard.angle),
        ("rates (IMU, ATTITUDE)", heard.rate),
        ("velocity (VISO, XKF1, VISION_POSITION_DELTA, LOCAL_POSITION_NED)", _velocity(heard)),
    ):
        if len(series.time_s) < 2:
            raise DriveError(
                f"{path}: holds no {name}; log it (LOG_BITMASK) and drive again, with a DVL, or give a CSV"
            )
    times = _times(heard)
    if len(times) < 2:
        raise DriveError(f"{path}: was never armed while pulses and attitude were logged")
    grid = _LogTimes(times)
    after = np.stack([grid.after(series) for series in (_velocity(heard), heard.rate)], axis=1)
    rpm, jumped = _asked(times, heard, vehicle_cfg)
    return drives_of(np.column_stack([_rows(times, grid, heard), rpm]), path, "line", after, jumped)


def _velocity(heard: _Heard) -> _Readings:
    return heard.dvl if len(heard.dvl.time_s) > 1 else heard.filtered


def _times(heard: _Heard) -> np.ndarray:
    """Every STEP_S while armed, without holes of the inputs."""
    inputs = (heard.pulse, heard.angle, heard.rate)
    begin = max(series.time_s[0] for series in inputs)
    end = min(series.time_s[-1] for series in inputs)
    times = np.arange(begin, end, STEP_S)
    kept = np.ones(len(times), bool)
    for series in inputs:
        known = np.array(series.time_s)
        for hole in np.flatnonzero(np.diff(known) > _HOLE_S):
            kept &= (times <= known[hole]) | (times >= known[hole + 1])
    if heard.armed.time_s:
        place = np.searchsorted(heard.armed.time_s, times, side="right") - 1
        kept &= (place >= 0) & (np.array(heard.armed.values)[place, 0] > 0)
    return times[kept]


def _rows(times: np.ndarray, grid: _LogTimes, heard: _Heard) -> np.ndarray:
    """(n, 10) as ``drives_of`` wants them, without rotor speeds."""
    angle, rate = _unwound(heard.angle).at(times), heard.rate.at(times)
    if _velocity(heard) is heard.dvl:
        velocity = grid.near(heard.dvl)
    else:
        velocity = _to_body(grid.near(heard.filtered), angle)
    turn = grid.near(heard.rate)[:, 2]
    up = up_axis(angle[:, 0], -angle[:, 1])
    flipped = [velocity[:, 0], -velocity[:, 1], -velocity[:, 2], -turn, rate[:, 0], -rate[:, 1]]
    return np.column_stack([times, *flipped, up])


class _LogTimes:
    """Times of the rows on the whole grid that they are cut from."""

    def __init__(self, times: np.ndarray) -> None:
        count = round((times[-1] - times[0]) / STEP_S) + 1
        self.whole = times[0] + STEP_S * np.arange(count)
        self.rows = np.rint((times - times[0]) / STEP_S).astype(int)

    def near(self, series: _Readings) -> np.ndarray:
        """Readings at the rows next to them."""
        return series.near(self.whole)[self.rows]

    def after(self, series: _Readings) -> np.ndarray:
        """(n,) [s] by how much later than its row each of them was read; 0 where there is none."""
        known = np.array(series.time_s)
        place = np.rint((known - self.whole[0]) / STEP_S).astype(int)
        inside = (place >= 0) & (place < len(self.whole))
        found = np.zeros(len(self.whole))
        found[place[inside]] = known[inside] - self.whole[place[inside]]
        return found[self.rows]


def _unwound(series: _Readings) -> _Readings:
    """Angles without jumps of a turn."""
    rows = np.unwrap(np.array(series.values), axis=0)
    return _Readings(series.time_s, [tuple(row) for row in rows.tolist()])


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
    speeds = np.array([motors.rpm(_by_motor(np.array(row), heard.parameters)) for row in heard.pulse.values])
    thrust = thrust_of(speeds, vehicle_cfg)
    pushed = np.stack([np.interp(times, known, column) for column in thrust.T], axis=1)
    table = np.arange(-motors.most_rpm, motors.most_rpm + 1.0)
    found = np.interp(pushed, thrust_of(table, vehicle_cfg), table)
    nearest = np.searchsorted(0.5 * (known[1:] + known[:-1]), times + 0.5 * STEP_S)
    return np.where(np.abs(pushed) < _STILL_N, 0.0, found), speeds[nearest]


def _by_motor(pulse: np.ndarray, parameters: dict[str, float]) -> list[float]:
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


def _heard(path: Path) -> _Heard:
    try:
        with open_file(path, _MOST_BYTES) as file:
            head = file.read(len(_BIN_HEAD))
    except OSError as error:
        raise DriveError(f"{path}: cannot be read ({error.strerror}); give a .bin or .tlog") from None
    is_bin = path.suffix.lower() == ".bin"
    if is_bin and head != _BIN_HEAD:
        raise DriveError(f"{path}: does not begin like a DataFlash log of ArduPilot's")
    if importlib.util.find_spec("pymavlink") is None:
        raise DriveError(f"{path}: is read by pymavlink, which is not here: pip install '{EXTRA}'")
    heard, takers = _Heard(), _OF_BIN if is_bin else _OF_TLOG
    try:
        with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
            for count, message in enumerate(_messages(path, is_bin, list(takers))):
                takers[message.get_type()](heard, message)
                if count > _MOST_READINGS:
                    raise DriveError(f"{path}: holds more than {_MOST_READINGS} messages; cut it")
    except (ValueError, TypeError, IndexError, KeyError, AttributeError, OverflowError, OSError) as error:
        if isinstance(error, DriveError):
            raise
        raise DriveError(f"{path}: is damaged ({type(error).__name__}: {error})") from None
    if not is_bin:  # a DVL has a clock of its own: its readings count from when they came
        heard.dvl.time_s = [time_s - heard.behind_s for time_s in heard.dvl.time_s]
    return heard


def _messages(path: Path, is_bin: bool, names: list[str]) -> Iterator[Any]:
    """Messages of these types, in the order of the file."""
    from pymavlink import DFReader, mavutil

    log: Any = DFReader.DFReader_binary(str(path)) if is_bin else mavutil.mavlogfile(str(path))
    try:
        while (message := log.recv_match(type=names)) is not None:
            yield message
    except struct.error:
        return  # the file ends in the middle of a message
    finally:
        (log.filehandle if is_bin else log.f).close()


Take = Callable[[_Heard, Any], None]


def _vision(heard: _Heard, time_s: float, delta_s: float, moved: tuple[float, ...], sure: float) -> None:
    if delta_s > 0 and sure > 0:
        heard.dvl.add(time_s, *(value / delta_s for value in moved))


def _imu(heard: _Heard, m: Any) -> None:
    if m.I == 0:
        heard.rate.add(m.TimeUS / 1e6, m.GyrX, m.GyrY, m.GyrZ)


def _lane(heard: _Heard, m: Any) -> None:
    if m.C == 0:
        heard.filtered.add(m.TimeUS / 1e6, m.VN, m.VE, m.VD)


def _event(heard: _Heard, m: Any) -> None:
    if m.Id in (10, 11):  # LogEvent::ARMED, DISARMED
        if m.Id == 11 and not heard.armed.time_s:  # the log begins under way
            heard.armed.add(0.0, 1.0)
        heard.armed.add(m.TimeUS / 1e6, float(m.Id == 10))


_OF_BIN: dict[str, Take] = {
    "PARM": lambda heard, m: heard.parameters.update({str(m.Name): float(m.Value)}),
    "RCOU": lambda heard, m: heard.pulse.add(
        m.TimeUS / 1e6, *(float(getattr(m, f"C{i}", 0)) for i in range(1, 15)), 0.0, 0.0
    ),
    "ATT": lambda heard, m: heard.angle.add(
        m.TimeUS / 1e6, *(math.radians(value) for value in (m.Roll, m.Pitch, m.Yaw))
    ),
    "IMU": _imu,
    "VISO": lambda heard, m: _vision(heard, m.TimeUS / 1e6, m.dt, (m.PosDX, m.PosDY, m.PosDZ), m.conf),
    "XKF1": _lane,
    "EV": _event,
}


def _attitude(heard: _Heard, m: Any) -> None:
    heard.behind_s = min(heard.behind_s, m._timestamp - m.time_boot_ms / 1e3)
    heard.angle.add(m.time_boot_ms / 1e3, m.roll, m.pitch, m.yaw)
    heard.rate.add(m.time_boot_ms / 1e3, m.rollspeed, m.pitchspeed, m.yawspeed)


def _servos(heard: _Heard, m: Any) -> None:
    if m.port == 0:
        widths = (float(getattr(m, f"servo{i}_raw", 0)) for i in range(1, 17))
        heard.pulse.add(m.time_usec / 1e6, *widths)


def _beat(heard: _Heard, m: Any) -> None:
    if m.get_srcComponent() == _AUTOPILOT and heard.angle.time_s:
        heard.armed.add(heard.angle.time_s[-1], float(bool(m.base_mode & 128)))


_OF_TLOG: dict[str, Take] = {
    "PARAM_VALUE": lambda heard, m: heard.parameters.update({str(m.param_id): float(m.param_value)}),
    "SERVO_OUTPUT_RAW": _servos,
    "ATTITUDE": _attitude,
    "VISION_POSITION_DELTA": lambda heard, m: _vision(
        heard, m._timestamp, m.time_delta_usec / 1e6, tuple(m.position_delta), m.confidence
    ),
    "LOCAL_POSITION_NED": lambda heard, m: heard.filtered.add(m.time_boot_ms / 1e3, m.vx, m.vy, m.vz),
    "HEARTBEAT": _beat,
}
