"""A row of the table of topics: when a topic is written, from what, how, and how it is read back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from uuvtai.logs.moment import EpisodeHeader, Moment
from uuvtai.logs.schemas import Schema

Encode = Callable[[Moment], bytes | list[bytes]]
"""JSON text of a step's message, or of each of its messages. ValueError for numbers that are not finite."""


@dataclass(frozen=True)
class When:
    """The steps in which a topic is written."""

    text: str
    """for the reference"""
    holds: Callable[[Moment, bool], bool]
    """whether a step is one; the second value: the last message is ``1 / hertz`` old, or there is none"""
    reads: tuple[str, ...] = ()
    """what ``holds`` looks at; 'struct.field' of the state"""
    hertz: float = 0.0


@dataclass(frozen=True)
class Topic:
    """One topic of a log. A step that lacks one of ``reads`` has no message on it."""

    name: str
    when: When
    schema: Schema | Callable[[EpisodeHeader], Schema]
    """a function where it depends on the run"""
    encode: Encode
    reads: tuple[str, ...] = ()
    """what ``encode`` looks at; 'struct.field' of the state, or 'driver.' (``moment.Values``)"""
    read: Callable[[dict[str, Any]], Any] | None = None
    """what pictures and videos take of a message: an array, a Layer, or a tuple with some of them"""
    in_picture: bool = False
    """pictures show it too, not videos alone"""
    note: str = ""
    """follows ``when.text`` in the reference"""
    varies: str = ""
    """which of its fields depend on the run, for the reference"""
    on_request: bool = False
    """only in logs with depth images"""

    def schema_for(self, header: EpisodeHeader) -> Schema:
        """Its schema in this run."""
        return self.schema(header) if callable(self.schema) else self.schema


_ROUTE = ("route.n_way", "route.plan_step")
_OUTCOME = ("referee.outcome",)

EVERY_STEP = When("every control step", lambda moment, waited: True)
NEW_SCAN = When("every new scan", lambda moment, waited: bool(moment["scan.fresh"]), ("scan.fresh",))
NEW_IMAGE = When("every new image", lambda moment, waited: bool(moment["image.fresh"]), ("image.fresh",))
REPLAN = When("on every replan", lambda moment, waited: moment.replanned, _ROUTE)
OBSTACLES = When("10 Hz", lambda moment, waited: waited or moment.ended, _OUTCOME, hertz=10.0)
MAPS = When(
    "2 Hz, on every replan, and at the end",
    lambda moment, waited: waited or moment.replanned or moment.ended,
    (*_ROUTE, *_OUTCOME),
    hertz=2.0,
)
IMAGES = When(
    "2 Hz, with `--depth-images`",
    lambda moment, waited: waited and bool(moment["image.fresh"]),
    ("image.fresh",),
    hertz=2.0,
)
SONAR_IMAGES = When(
    "2 Hz, with `--depth-images`, where `sensors.sonar.detector` is on",
    lambda moment, waited: (
        waited and bool(moment["scan.fresh"]) and moment.header.config.sensors.sonar.detector != "none"
    ),
    ("scan.fresh",),
    hertz=2.0,
)
EVADING = When(
    "every decision that looks for an evasion",
    lambda moment, waited: bool(moment["teacher.want_evade"]),
    ("teacher.want_evade",),
)
EVENTS = When(
    "replans, end of the episode",
    lambda moment, waited: moment.replanned or moment.ended,
    (*_ROUTE, *_OUTCOME),
)
