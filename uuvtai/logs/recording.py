"""A log as arrays, ready to be drawn."""

from __future__ import annotations

import bisect
import contextlib
import itertools
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from uuvtai.logs.log_errors import LogError
from uuvtai.logs.reader import LogHead, read_head, read_messages
from uuvtai.logs.topics import TOPICS
from uuvtai.logs.topics.map_topics import Layer


@dataclass
class Series:
    """Values by time, looked up as of a moment."""

    times: list[float] = field(default_factory=list)
    values: list[Any] = field(default_factory=list)

    def add(self, time_s: float, value: Any) -> None:
        self.times.append(time_s)
        self.values.append(value)

    def at(self, time_s: float) -> Any | None:
        """Newest value at this time, None before the first."""
        i = bisect.bisect_right(self.times, time_s + 1e-9)
        return self.values[i - 1] if i else None

    def until(self, time_s: float) -> Iterator[Any]:
        """Values up to this time, the newest first."""
        for i in reversed(range(bisect.bisect_right(self.times, time_s + 1e-9))):
            yield self.values[i]


@dataclass
class Recording:
    """What is drawn of an episode."""

    path: Path
    head: LogHead
    scenario: dict[str, Any]
    series: dict[str, Series] = field(default_factory=lambda: defaultdict(Series))
    """what the table of topics reads of each topic's messages"""

    def __getitem__(self, topic: str) -> Series:
        return self.series[topic]

    @property
    def method(self) -> str:
        return self.head.metadata.get("uuv.run", {}).get("controller", "?")

    @property
    def outcome(self) -> str:
        return self.head.metadata.get("uuv.result", {}).get("outcome", "cut off")

    @property
    def ending(self) -> str:
        """The outcome in words."""
        return _ENDINGS.get(self.outcome, self.outcome.replace("_", " "))

    @property
    def duration_s(self) -> float:
        return self["/pose"].times[-1]

    @property
    def positions(self) -> np.ndarray:
        """(n, 4) x, y, z, yaw at every control step."""
        return np.array(self["/pose"].values)

    @property
    def min_clearance_m(self) -> float | None:
        return min((value[0] for value in self["/safety"].values), default=None)


_ENDINGS = {"ttc": "TTC stop"}
_MAX_DURATION_S, _MAX_EXTENT_M, _FARTHEST_M, _MAX_BODIES = 3600.0, 1000.0, 1e4, 1000
"""what is drawn must fit a picture and a video that somebody waits for"""
_MAX_NUMBERS = 100_000
"""of a scenario: corners of paths are drawn in every frame"""
_MAX_ARRAYS, _OVERHEAD = 384 << 20, 200
"""[bytes] all that is drawn together, and what a message takes beyond its arrays"""
_READERS = {topic.name: topic.read for topic in TOPICS if topic.read is not None}
VIDEO_TOPICS = tuple(_READERS)
PICTURE_TOPICS = tuple(topic.name for topic in TOPICS if topic.in_picture)


def load_recording(path: Path, topics: tuple[str, ...] = VIDEO_TOPICS) -> Recording:
    """Read a log. Raises LogError, also for a log without poses."""
    path = Path(path)
    head = read_head(path)
    found = Recording(path, head, head.scenario)
    _check_scenario(path, found.scenario)
    size = 0
    try:
        for message in read_messages(path, topics):
            value = read_value(message.topic, message.data)
            found[message.topic].add(message.time_s, value)
            size += _taken(value) + _OVERHEAD
            if size > _MAX_ARRAYS:
                raise LogError(
                    f"{path}: holds more than {_MAX_ARRAYS >> 20} MiB to draw; no episode of ours does"
                )
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise LogError(
            f"{path}: a message is not as its schema says ({error!r}); see what is in it with: uuv log info "
            f"{path}"
        ) from error
    if not found["/pose"].times:
        raise LogError(
            f"{path}: the log has no messages on /pose, so there is nothing to draw; see uuv log info {path}"
        )
    if not found.duration_s <= _MAX_DURATION_S:
        raise LogError(
            f"{path}: claims to last {found.duration_s:g} s; no episode is longer than {_MAX_DURATION_S:g} s"
        )
    return found


def read_value(topic: str, data: dict[str, Any]) -> Any:
    """What the table of topics reads of a message. Raises LogError, and what a message unlike ours raises."""
    return _READERS[topic](data)


@contextlib.contextmanager
def drawing(path: Path) -> Iterator[None]:
    """Turn everything that a scenario or a message unlike ours can raise while it is drawn into a
    LogError."""
    try:
        yield
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, ArithmeticError, cv2.error) as error:
        raise LogError(
            f"{path}: cannot be drawn ({error!r}); give a log that uuv eval --record wrote"
        ) from None


def _check_scenario(path: Path, scenario: Any) -> None:
    """Raise LogError for a tank or bodies that cannot be drawn: what is drawn grows with their extent."""
    try:
        tank, bodies = scenario["tank"], scenario["bodies"]
        extents = [float(tank[axis][1]) - float(tank[axis][0]) for axis in ("x_m", "y_m")]
        if not all(0 < extent <= _MAX_EXTENT_M for extent in extents):
            raise ValueError(f"a tank of {extents[0]:g} x {extents[1]:g} m")
        numbers = list(
            itertools.islice(_numbers([tank, bodies, scenario["goal"], scenario["start"]]), _MAX_NUMBERS + 1)
        )
        if (
            len(numbers) > _MAX_NUMBERS
            or len(bodies) > _MAX_BODIES
            or not all(abs(number) <= _FARTHEST_M for number in numbers)
        ):
            raise ValueError("bodies beyond all bounds")
    except (KeyError, TypeError, ValueError, IndexError, OverflowError, RecursionError) as error:
        raise LogError(
            f"{path}: its scenario.json cannot be drawn ({error!r}); give a log that uuv eval --record wrote"
        ) from None


def _numbers(value: Any) -> Iterator[float]:
    """Every number within."""
    if isinstance(value, int | float):
        yield value
    elif isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from _numbers(inner)


def _taken(value: Any) -> int:
    """Bytes of the arrays that a message's value holds."""
    parts = value if isinstance(value, tuple) else (value,)
    return sum(part.nbytes for part in parts if isinstance(part, np.ndarray | Layer))
