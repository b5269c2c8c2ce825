"""Messages on their way to the pilot: in any order, some twice, some never, some of them nonsense."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from uuvtai.pilot.sensor_messages import LIMITS, NAMES, SensorMessage

ANY = -1
"""Length of an axis that may have any"""


@dataclass
class Tally:
    """What became of one sensor's messages."""

    fed: int = 0
    used: int = 0
    late: int = 0
    """as old as one that was used already, or superseded before a step could use it"""
    bad: int = 0
    """with a number that is not finite, or larger than anything believed"""
    unplaced: int = 0
    """scans and images taken when the own attitude or position was not known"""


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
        values = {field.name: getattr(message, field.name) for field in dataclasses.fields(message)}
        time_s = float(values.pop("time_s"))
        arrays = {key: np.asarray(value, np.float64) for key, value in values.items()}
        for key, array in arrays.items():
            self._check_shape(name, key, array.shape)
        if math.isfinite(time_s) and all(_believed(key, array) for key, array in arrays.items()):
            self._waiting[name].append(message)
        else:
            tally.bad += 1

    def newest(self, name: str, now_s: float) -> SensorMessage | None:
        """The newest message measured until ``now_s`` that is newer than the last one taken, else None; what
        is older is forgotten, what lies ahead waits."""
        ready = [message for message in self._waiting[name] if message.time_s <= now_s]
        if not ready:
            return None
        self._waiting[name] = [message for message in self._waiting[name] if message.time_s > now_s]
        best = max(ready, key=lambda message: message.time_s)
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


def _believed(key: str, array: np.ndarray) -> bool:
    return bool((np.abs(array) <= LIMITS[key]).all())  # false for NaN too
