"""What goes wrong between a log's sensors and the pilot: messages lost or late, a sensor dead for a while."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from uuvtai.errors import SettingError
from uuvtai.measure.replay.log_feed import Delivery
from uuvtai.pilot.sensor_messages import KINDS, NAMES


@dataclass(frozen=True)
class Outage:
    """A sensor that says nothing of what is measured from ``from_s`` to ``to_s``."""

    sensor: str
    from_s: float
    to_s: float


@dataclass(frozen=True)
class Faults:
    """All together; nothing at all unless asked for. Random ones depend on ``seed`` alone."""

    drop: float = 0.0
    """share of the messages that is lost"""
    jitter_s: float = 0.0
    """a message arrives up to this much later, uniformly: out of order too"""
    outages: tuple[Outage, ...] = ()
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.drop <= 1:
            raise SettingError(f"--drop {self.drop:g}: must be a share from 0 to 1, for example --drop 0.2")
        if not 0 <= self.jitter_s <= 10:
            raise SettingError(f"--jitter {self.jitter_s:g}: must be 0 to 10 s, for example --jitter 0.1")

    @property
    def any(self) -> bool:
        """Whether anything goes wrong."""
        return self.drop > 0 or self.jitter_s > 0 or bool(self.outages)


@dataclass
class Disturbed:
    """What reaches the pilot, in the order in which it does, and how much was lost, by sensor."""

    arrivals: list[Delivery]
    lost: Counter[str] = field(default_factory=Counter)


def outage_of(text: str) -> Outage:
    """Outage of 'dvl:10:15'. Raises SettingError."""
    sensor, _, span = text.partition(":")
    try:
        first, last = (float(part) for part in span.split(":"))
    except ValueError:
        first, last = math.nan, math.nan
    if sensor not in KINDS or not 0 <= first < last < math.inf:
        raise SettingError(
            f"--lose {text}: must be SENSOR:FROM:TO in seconds, with a sensor of {', '.join(KINDS)}; for "
            "example --lose dvl:10:15"
        )
    return Outage(sensor, first, last)


def disturbed(arrivals: Sequence[Delivery], faults: Faults) -> Disturbed:
    """What is left of the messages, and when it comes."""
    draws = np.random.default_rng(faults.seed).random((len(arrivals), 2))
    found = Disturbed([])
    for arrival, (luck, delay) in zip(arrivals, draws.tolist(), strict=True):
        name, measured_s = NAMES[type(arrival.message)], arrival.message.time_s
        dead = any(o.sensor == name and o.from_s <= measured_s < o.to_s for o in faults.outages)
        if dead or luck < faults.drop:
            found.lost[name] += 1
        else:
            found.arrivals.append(Delivery(arrival.time_s + delay * faults.jitter_s, arrival.message))
    found.arrivals.sort(key=lambda arrival: arrival.time_s)
    return found
