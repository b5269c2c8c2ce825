"""What sensors tell the pilot. Every message carries the time at which it was measured, in seconds of the
pilot's clock (0 = its first step); it may arrive later, out of order, twice or never."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class ImuReading:
    time_s: float
    rpy: np.ndarray  # (3,) [rad] roll, pitch, yaw; yaw counter-clockwise from the world's x axis
    rate_b: np.ndarray  # (3,) [rad/s] gyro, body axes (x ahead, y left, z up)
    specific_force_b: np.ndarray  # (3,) [m/s^2] acceleration less gravity, body axes: at rest (0, 0, 9.81)


@dataclass(frozen=True, eq=False)
class DvlReading:
    """A valid velocity; while the bottom is lost there is no message."""

    time_s: float
    vel_b: np.ndarray  # (3,) [m/s] over ground, body axes


@dataclass(frozen=True, eq=False)
class PressureReading:
    """Depth by pressure."""

    time_s: float
    depth_m: float
    """[m] positive down; zeroed at the known start (less its depth) unless the position is given"""


@dataclass(frozen=True, eq=False)
class PositionFix:
    """A position from elsewhere, needed unless the pilot estimates its own (``sensors.localization``)."""

    time_s: float
    pos_w: np.ndarray  # (3,) [m] world


@dataclass(frozen=True, eq=False)
class SonarPing:
    """A scan of all beams, in the order of ``SonarConfig``; ``time_s`` is that of the ping. Of a mechanical
    beam (``sensors.sonar.mechanical``): the one or the few neighbouring beams that were taken then, n of them
    in place of n_ray."""

    time_s: float
    range_m: np.ndarray
    """(n_ray,) [m] counter-clockwise, beam 0 ahead or at a fan's right edge; finite without return"""
    hit: np.ndarray  # (n_ray,) 1 = return
    doppler_m_s: np.ndarray
    """(n_ray,) [m/s] rate of change of the distance to what returned, own motion included; empty where the
    sonar measures none (``sensors.sonar.doppler``)"""
    first_beam: float = 0
    """number of the first of these beams; 0 unless the beam is a mechanical one. That may look beside its fan
    (beams counted on around the circle) or between two beams (a fraction): the start is checked by those, the
    stack does not see them"""


@dataclass(frozen=True, eq=False)
class DepthShot:
    """An image of the forward depth camera."""

    time_s: float
    depth_m: np.ndarray  # (rows, columns) [m] z-depth, row 0 at the top; no return = maximum range


@dataclass(frozen=True, eq=False)
class ThrusterLoss:
    """A vertical thruster is dead, until the end."""

    time_s: float
    thruster: float  # its number, counted from 1; -1 = not known, or only suspected


SensorMessage = ImuReading | DvlReading | PressureReading | PositionFix | SonarPing | DepthShot | ThrusterLoss
KINDS: dict[str, type] = {
    "imu": ImuReading,
    "dvl": DvlReading,
    "pressure": PressureReading,
    "position": PositionFix,
    "sonar": SonarPing,
    "depth": DepthShot,
    "thruster": ThrusterLoss,
}
"""what a message is called where it is counted, lost or old"""
NAMES = {kind: name for name, kind in KINDS.items()}

LIMITS = {
    "rpy": 100.0,
    "rate_b": 50.0,
    "specific_force_b": 500.0,
    "vel_b": 10.0,
    "pos_w": 1e5,
    "depth_m": 1e5,
    "range_m": 1e5,
    "doppler_m_s": 1e3,
    "hit": 1.0,
    "thruster": 100.0,
    "first_beam": 1e5,
}
"""largest size that is believed, far above what any of these instruments says: a number that is larger, or
not finite, makes the message a bad one"""


# ---- Messages on their way to the pilot: in any order, some twice, some never, some of them nonsense.

MOST_WAITING = 256  # messages of a kind; of more the first ones are lost
ANY = -1  # Length of an axis that may have any


@dataclass
class Tally:
    fed: int = 0
    used: int = 0
    late: int = 0  # as old as one that was used already, or superseded before a step could use it
    bad: int = 0  # with a number that is not finite, or larger than anything believed
    unplaced: int = 0
    """scans and images taken when the own attitude or position was not known; velocities that cannot be"""


class Inbox:
    """Keeps what was fed until a step takes the newest of it.

    ``shapes`` maps 'kind.field' to the shape that its array must have; what is not named there is a vector of
    three or a number.
    """

    def __init__(self, shapes: dict[str, tuple[int, ...]]) -> None:
        self.tallies = {name: Tally() for name in NAMES.values()}
        self._shapes = shapes
        self._waiting: dict[str, list[SensorMessage]] = {name: [] for name in NAMES.values()}
        self._newest = dict.fromkeys(NAMES.values(), -math.inf)
        self._used_s, self._used_before_s = dict(self._newest), -math.inf

    def feed(self, message: SensorMessage) -> None:
        """Take a message. TypeError for what is none, ValueError for arrays of the wrong shape; one with
        numbers that cannot be is counted as bad and forgotten."""
        name = NAMES.get(type(message))
        if name is None:
            raise TypeError(
                f"a {type(message).__name__} is no message of a sensor: {', '.join(NAMES.values())}"
            )
        tally = self.tallies[name]
        tally.fed += 1
        for key, value in vars(message).items():
            if key != "time_s":
                self._check_shape(name, key, np.shape(value))
        if is_believed(message):
            self._waiting[name].append(message)
            if len(self._waiting[name]) > MOST_WAITING:
                self._waiting[name].pop(0)
                tally.late += 1
        else:
            tally.bad += 1

    def newest(self, name: str, now_s: float, in_turn: bool = False) -> SensorMessage | None:
        """The newest message measured until ``now_s`` that is newer than the last one taken, else None; what
        is older is forgotten, what lies ahead waits. ``in_turn``: the first that is newer than the last one
        taken, for each tells of something else; the others wait."""
        ready = [message for message in self._waiting[name] if message.time_s <= now_s]
        if not ready:
            return None
        newer = [message for message in ready if message.time_s > self._newest[name]]
        if in_turn and newer:
            best = min(newer, key=lambda message: message.time_s)
            self._waiting[name] = [message for message in self._waiting[name] if message.time_s > best.time_s]
            ready = [message for message in ready if message.time_s <= best.time_s]
        else:
            best = max(reversed(ready), key=lambda message: message.time_s)
            self._waiting[name] = [message for message in self._waiting[name] if message.time_s > now_s]
        tally = self.tallies[name]
        if best.time_s <= self._newest[name]:
            tally.late += len(ready)
            return None
        tally.late += len(ready) - 1
        tally.used += 1
        self._newest[name] = best.time_s
        self._used_before_s, self._used_s[name] = self._used_s[name], best.time_s
        return best

    def reject(self, name: str) -> None:
        """The message that was taken last could not be placed: it counts as never used."""
        tally = self.tallies[name]
        tally.used, tally.unplaced = tally.used - 1, tally.unplaced + 1
        self._used_s[name] = self._used_before_s

    def age_s(self, name: str, now_s: float) -> float:
        """How old the newest message used is; infinite = there was none."""
        return now_s - self._used_s[name]

    def _check_shape(self, name: str, key: str, shape: tuple[int, ...]) -> None:
        wanted = self._shapes.get(f"{name}.{key}", () if name in ("pressure", "thruster") else (3,))
        if len(shape) != len(wanted) or any(w not in (s, ANY) for s, w in zip(shape, wanted, strict=True)):
            raise ValueError(f"{name}: {key} must have the shape {wanted}, got {shape}")


def is_believed(message: SensorMessage) -> bool:
    """Whether its time is finite and no number is larger than any of these instruments says."""
    numbers = dict(vars(message))
    time_s = float(numbers.pop("time_s"))
    sound = (np.abs(np.asarray(value, np.float64)) <= LIMITS[key] for key, value in numbers.items())
    return math.isfinite(time_s) and all(bool(each.all()) for each in sound)  # false for NaN too


# ---- One vehicle under way without a world: what it is told.


def three(values: Iterable[float]) -> tuple[float, float, float]:
    """A place, or a vector. ValueError for another number of them."""
    x, y, z = (float(value) for value in values)
    return x, y, z


@dataclass(frozen=True)
class Mission:
    """What a vehicle is told before it begins."""

    start: tuple[float, float, float]  # [m] world, where it begins
    goal: tuple[float, float, float]  # [m] world
    seed: int = 0  # with ``episode``: of the fallback planner's random numbers
    episode: int = 0
    spread: tuple[float, ...] = ()
    """covariance of start and heading (x, y [m], yaw [rad]), upper triangle of six; none = exactly known"""

    def places(self) -> dict[str, tuple[float, float, float]]:
        """By the array that holds it."""
        return {"mission.start_w": self.start, "mission.goal_w": self.goal, "vehicle.pos_w": self.start}


# ---- What the stack's frame needs to know of a config, as plain numbers: without Taichi, torch and pydantic.


@dataclass(frozen=True)
class PilotNumbers:
    """Of one vehicle with its sensors and its tree."""

    dt_s: float  # control step
    top: tuple[float, float, float, float]  # [m/s, m/s, m/s, rad/s] full command in surge, sway, heave, yaw
    nodes: tuple[str, ...]  # the tree's nodes as logs name them
    gravity_m_s2: float
    estimated: bool  # the pilot estimates its own position, nobody gives it
    dvl_steps: int  # control steps from one expected reading to the next
    beams: int
    circle: int  # beams that fill a whole circle; of a ring those that it has
    mechanical: bool
    doppler: bool
    sonar_latency_steps: int  # control steps from a ping to its scan, always
    sonar_m: float  # maximum range
    image: tuple[int, int]  # rows, columns of a depth image
    camera_m: float  # maximum range
