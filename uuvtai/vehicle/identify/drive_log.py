"""Drives as arrays: from our logs (MCAP) and from tables (CSV, SI units; body axes ahead, to port, up)."""

from __future__ import annotations

import csv
import io
import math
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from uuvtai.common.errors import UserError
from uuvtai.common.files import open_file, refusing
from uuvtai.config import VehicleConfig
from uuvtai.kernels.vehicle.dynamics import KGF, edge_rpm
from uuvtai.logs.reader import read_messages

_MAX_CSV_BYTES = 256 << 20
MAX_SAMPLES = 1_000_000
_GAP = 0.3  # A step that differs from the usual one by more than this share parts a log in two.
_SLOWEST_S = 0.5
_NEEDED = ("t", "u", "v", "w", "r")


Command = Literal["", "held", "line"]


class DriveError(UserError, ValueError):
    """A log that cannot be identified from: what it lacks, and what to do."""


@dataclass(frozen=True)
class Drive:
    """One drive without a gap, n samples ``dt_s`` apart."""

    dt_s: float
    velocity: np.ndarray  # (n, 4) surge, sway, heave [m/s] and yaw rate [rad/s]; NaN = no reading
    tilt_rate: np.ndarray  # (n, 2) roll and pitch rate [rad/s]
    up: np.ndarray  # (n, 3) world z axis in body axes
    rpm: np.ndarray  # (n, thrusters) rotor speeds, as turned
    command: Command = ""
    """whether they are as commanded instead: each ``held`` until the next sample, or on a ``line`` to it"""
    after: np.ndarray | None = None
    """(n, 2) [s] by how much later than their sample velocity and yaw rate were read; None = not at all"""

    jumped: np.ndarray | None = None
    """(n, thrusters) commands held until the next sample, as they were if each jumped halfway between two
    messages of the log, of which ``rpm`` takes a line; None = the log does not leave that open"""
    straight: bool = False
    """whether speeds as turned run on straight lines between samples, not as the vehicle's lag has it"""

    @property
    def is_asked(self) -> bool:
        return self.command != ""

    def otherwise(self) -> Drive | None:
        """The drive by another reading of its log, which does not say how speeds ran between two samples or
        messages; None = it leaves nothing open."""
        if self.jumped is not None:
            return replace(self, rpm=self.jumped, command="held", jumped=None)
        return None if self.is_asked else replace(self, straight=True)


def read_drives(path: Path, truth: bool = False) -> list[Drive]:
    """The drives of a file: ``.csv``, else MCAP. ``truth``: what a log of ours says of the truth, in place of
    what the instruments said. Raises DriveError, FileError, LogError."""
    if path.suffix.lower() != ".csv":
        return drives_of(_log(path, truth), path)
    rows, is_asked = _table(path)
    return drives_of(rows, path, "held" if is_asked else "")


def drives_of(
    rows: np.ndarray,
    path: Path,
    command: Command = "",
    after: np.ndarray | None = None,
    jumped: np.ndarray | None = None,
) -> list[Drive]:
    """Rows (n, 10 + thrusters) of a file, cut where samples are missing: time, velocity (3) and yaw rate,
    rates of roll and pitch, world z axis in body axes, rotor speeds; ``command``, ``after`` (n, 2) and
    ``jumped`` as in ``Drive``. Raises DriveError."""
    time_s = rows[:, 0]
    if len(rows) < 2 or not np.isfinite(time_s).all() or (np.diff(time_s) <= 0).any():
        raise DriveError(f"{path}: times must rise from row to row; give a log of one drive")
    dt_s = float(np.median(np.diff(time_s)))
    if dt_s > _SLOWEST_S:
        raise DriveError(
            f"{path}: has a sample every {dt_s:g} s, and two a second are needed; give times in seconds"
        )
    cuts = np.flatnonzero(np.abs(np.diff(time_s) / dt_s - 1) > _GAP) + 1
    late = np.zeros((len(rows), 2)) if after is None else after
    other = [None] * (len(cuts) + 1) if jumped is None else np.split(jumped, cuts)
    return [
        Drive(dt_s, part[:, 1:5], part[:, 5:7], part[:, 7:10], part[:, 10:], command, own, jumps)
        for part, own, jumps in zip(np.split(rows, cuts), np.split(late, cuts), other, strict=True)
        if len(part) > 1
    ]


def up_axis(roll: np.ndarray, pitch: np.ndarray) -> np.ndarray:
    """(n, 3) world z axis in body axes, from angles [rad]."""
    return np.stack([-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)], axis=1)


# ------------------------------------------------------------------------------------------------------ logs


def _log(path: Path, truth: bool) -> np.ndarray:
    cells, width, last = array("d"), 0, None
    for message in read_messages(path, ("/state",)):
        data = message.data
        try:
            source = data if truth else data["measured"]
            velocity = [float(value) for value in source["velocity"]]
            held = not truth and (velocity == last or not source["velocity_valid"])
            last = velocity
            p, q, r = (float(value) for value in source["rates"])
            up = _up_of(data["orientation"])
            rpm = [float(value) for value in data["rpm"]]
        except (KeyError, TypeError, ValueError):
            raise DriveError(
                f"{path}: /state at {message.time_s:.2f} s lacks velocity, rates, orientation or rpm; give a "
                "log of uuv eval --record, or a CSV"
            ) from None
        seen = [math.nan] * 3 if held else velocity
        row = [message.time_s, *seen, r, p, q, *up, *rpm]
        width = width or len(row)
        if len(row) != width:
            raise DriveError(f"{path}: changes its number of thrusters on the way; give a log of one vehicle")
        cells.extend(row)
        refuse_long(path, len(cells) // width)
    if not cells:
        raise DriveError(f"{path}: has no messages on /state; give a log of uuv eval --record, or a CSV")
    return np.frombuffer(cells).reshape(-1, width)


def _up_of(quaternion: Sequence[float]) -> list[float]:
    w, x, y, z = (float(value) for value in quaternion)
    return [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]


# ---------------------------------------------------------------------------------------------------- tables


def _table(path: Path) -> tuple[np.ndarray, bool]:
    """(rows, whether their rotor speeds are as commanded)"""
    try:
        with refusing(DriveError, f"{path}: cannot be read", "give a log, .mcap or .csv"):
            file = open_file(path, _MAX_CSV_BYTES)
            with io.TextIOWrapper(file, "utf-8-sig", newline="") as text:
                head, values = _columns(path, csv.reader(text))
    except (csv.Error, UnicodeDecodeError) as error:
        raise DriveError(f"{path}: is no table ({error}); save it as CSV in UTF-8") from None
    asked, turned = ([name for name in head if name.startswith(prefix)] for prefix in ("asked_", "rpm_"))
    if not len(values):
        raise DriveError(f"{path}: has no rows below its first line")
    column = {name: values[:, i] for i, name in enumerate(head)}
    nothing = np.zeros(len(values))
    p, q, roll, pitch = (column.get(name, nothing) for name in ("p", "q", "roll", "pitch"))
    seen = [column[name] for name in _NEEDED]
    rpm = [column[name] for name in sorted(turned or asked, key=lambda name: (len(name), name))]
    inputs = np.column_stack([p, q, up_axis(roll, pitch), *rpm])
    if not np.isfinite(inputs).all():
        raise DriveError(f"{path}: only u, v, w and r may have empty cells (no reading); fill the others")
    return np.column_stack([*seen, inputs]), bool(asked)


def _columns(path: Path, lines: Any) -> tuple[list[str], np.ndarray]:
    """(names, values (n, names)) of the lines of a ``csv.reader``; NaN in empty cells."""
    head = [name.strip() for name in next(lines, [])]
    asked, turned = (any(name.startswith(prefix) for name in head) for prefix in ("asked_", "rpm_"))
    if asked and turned:
        raise DriveError(
            f"{path}: names rotor speeds as turned (rpm_1, ..) and as commanded (asked_1, ..); give one of "
            "the two"
        )
    missing = [name for name in _NEEDED if name not in head] + ([] if asked or turned else ["rpm_1"])
    if missing or len(set(head)) < len(head):
        raise DriveError(
            f"{path}: its first line must name the columns t,u,v,w,r,rpm_1,rpm_2,.. (or asked_1,..) once "
            f"each (also p,q,roll,pitch); missing: {', '.join(missing) or 'none'}"
        )
    cells = array("d")
    for row in lines:
        if row:
            cells.extend(_numbers(path, lines.line_num, row, len(head)))
            refuse_long(path, len(cells) // len(head))
    return head, np.frombuffer(cells).reshape(-1, len(head)) if cells else np.empty((0, len(head)))


def refuse_long(path: Path, samples: int) -> None:
    """Raise DriveError for more samples of a log than are fitted."""
    if samples > MAX_SAMPLES:
        raise DriveError(
            f"{path}: holds more than {MAX_SAMPLES:,} samples; cut it, or log fewer rows a second: five "
            "minutes are enough"
        )


def _numbers(path: Path, number: int, row: list[str], width: int) -> list[float]:
    try:
        values = [float(cell) if cell.strip() else math.nan for cell in row]
        if len(values) != width or any(math.isinf(value) for value in values):
            raise ValueError
    except ValueError:
        raise DriveError(
            f"{path}: line {number} must hold {width} numbers (an empty cell: no reading)"
        ) from None
    return values


# ---- From rotor speeds to thrust: speeds as turned, or as commanded and followed with a lag of first order.

LEAST_LAG_S = 1e-3
_INSTANTS = (0.03, 0.1025, 0.20125, 0.3325, 0.50375, 0.7, 0.9)
_SHARES = (0.06, 0.085, 0.1125, 0.15, 0.1925, 0.2, 0.2)
"""of a step, at which thrust is taken, and for how much of it: denser where a lagging rotor turns quickest"""
_WEIGHTS = np.array([_SHARES, np.multiply(_SHARES, np.subtract(1, _INSTANTS))])
_WEIGHTS /= _WEIGHTS.sum(axis=1, keepdims=True)
_NEAREST_RPM = 1e-3
"""A lagging rotor never quite arrives: one that comes to the dead band's edge from within does not push."""

_STRAIGHT = 1e-6  # of a step to a lag, at which what decays runs straight


def mean_wrench(drive: Drive, vehicle_cfg: VehicleConfig, lags_s: np.ndarray) -> np.ndarray:
    """(2, lags, n - 1, thrusters) [N] mean thrust of each step with each lag: the plain mean, and that
    weighted by the time left of the step, which says how early it came. Speeds as turned approach the next
    one as the vehicle's own lag has it, or straight, whatever ``lags_s`` says."""
    if drive.is_asked:
        lag = drive.dt_s / lags_s[:, None, None]
        risen = np.diff(drive.rpm, axis=0) if drive.command == "line" else np.zeros_like(drive.rpm[:-1])
        off = _behind(drive, risen, lags_s)
        speeds = (
            drive.rpm[:-1] + (instant - 1 / lag) * risen + np.exp(-instant * lag) * (off + risen / lag)
            for instant in _INSTANTS
        )
    else:
        lag = np.full((len(lags_s), 1, 1), drive.dt_s / vehicle_cfg.rotor_tau_s)
        before, goal = drive.rpm[None, :-1], drive.rpm[None, 1:]
        if drive.straight:
            lag = np.full_like(lag, _STRAIGHT)
        ways = [np.expm1(-instant * lag) / np.expm1(-lag) for instant in _INSTANTS]
        speeds = (before + way * (goal - before) for way in ways)
    found = np.zeros((2, len(lags_s), len(drive.rpm) - 1, drive.rpm.shape[1]))
    for weights, speed in zip(_WEIGHTS.T, speeds, strict=True):
        pushed = thrust_of(speed, vehicle_cfg)
        for row, weight in enumerate(weights):
            found[row] += weight * pushed
    return found


def _behind(drive: Drive, risen: np.ndarray, lags_s: np.ndarray) -> np.ndarray:
    """(lags, n - 1, thrusters) [rpm] by how much the rotors are beyond the command at the begin of each step:
    a lag of first order behind a straight line (speed = line - slope * lag + what decays)."""
    kept = np.exp(-drive.dt_s / lags_s)[:, None]
    behind = (lags_s / drive.dt_s)[:, None, None] * risen
    jumps = np.diff(drive.rpm, axis=0) - risen
    off = np.zeros((len(risen), len(lags_s), drive.rpm.shape[1]))
    off[1:] = np.moveaxis((kept[:, None] - 1) * behind - jumps, 0, 1)[:-1]
    for k in range(1, len(off)):
        off[k] += kept * off[k - 1]
    off = np.moveaxis(off, 0, 1)
    return np.where(np.abs(off) < _NEAREST_RPM, np.copysign(_NEAREST_RPM, off), off)


def thrust_of(rpm: np.ndarray, vehicle_cfg: VehicleConfig) -> np.ndarray:
    """[N] of rotors, as the simulator has it."""
    ahead = edge_rpm(vehicle_cfg.thrust_forward, vehicle_cfg.dead_band_rpm[0], 1.0)
    astern = edge_rpm(vehicle_cfg.thrust_reverse, vehicle_cfg.dead_band_rpm[1], -1.0)
    forward, reverse = (np.polyval(c, rpm) for c in (vehicle_cfg.thrust_forward, vehicle_cfg.thrust_reverse))
    return (
        KGF
        * vehicle_cfg.thrust_scale
        * np.where(rpm >= ahead, forward, np.where(rpm <= astern, reverse, 0.0))
    )
