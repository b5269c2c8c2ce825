"""Running episodes as messages for viewers: the topics of the log, as they come, no faster than the clock."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from uuvtai.logs.log_recorder import EpisodeReader, PolicyNote, Recordable, RecordedJob
from uuvtai.logs.moment import EpisodeEnd, EpisodeHeader, Values
from uuvtai.logs.schemas import Schema
from uuvtai.logs.topic import Topic
from uuvtai.logs.topic_stream import TopicMessage, TopicStream


class Viewers(Protocol):
    """Whoever is shown episodes as messages."""

    def begin(self, schemas: Mapping[str, Schema]) -> None:
        """Another episode."""

    def tell_time(self, time_ns: int) -> None:
        """It is now this late in the episode."""

    def send(self, message: TopicMessage) -> None:
        """Show a message."""


class LiveEpisode:
    """One episode for viewers; an ``EpisodeSink``."""

    def __init__(self, viewers: Viewers, header: EpisodeHeader, depth_images: bool) -> None:
        self._viewers, self._stream = viewers, TopicStream(header, depth_images)
        self._dt_s = header.config.episode.control_dt_s
        viewers.begin(self._stream.schemas())

    def due(self, values: Values) -> list[Topic]:
        """Topics that this step has messages on."""
        return self._stream.due(values)

    def write(self, values: Values) -> None:
        """Show one control step."""
        self._viewers.tell_time(round(int(values["clock.step"]) * self._dt_s * 1e9))
        for message in self._stream.messages(values):
            self._viewers.send(message)

    def close(self, result: EpisodeEnd) -> None:
        """Its last messages have told how it ended."""

    def abandon(self) -> None:
        """Nothing is kept."""


class Broadcast(EpisodeReader):
    """Shows every episode of row 0; an ``EpisodeObserver``."""

    def __init__(
        self,
        viewers: Viewers,
        world: str,
        controller: str,
        depth_images: bool = False,
        policy: PolicyNote | None = None,
    ) -> None:
        super().__init__(world, controller, policy)
        self._viewers, self._depth_images = viewers, depth_images

    def sink_for(self, sim: Recordable, row: int, job: RecordedJob) -> LiveEpisode | None:
        """Viewers look at one vehicle."""
        return (
            LiveEpisode(self._viewers, self.header(sim, row, job), self._depth_images) if row == 0 else None
        )


_FORGIVEN_S = 0.25
"""who is later than this does not catch up: a viewer would see a jump"""


class RealTime:
    """Makes every control step take its time; an ``EpisodeObserver``."""

    def __init__(
        self,
        dt_s: float,
        rate: float = 1.0,
        now: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """``rate``: seconds of the episode in one of the clock's; 0 = as fast as it goes."""
        self._dt_s, self._period_s, self._now, self._sleep = dt_s, dt_s / rate if rate else 0.0, now, sleep
        self._due_s = self._begun_s = now()
        self._steps = 0

    def begin(self, sim: Any, row: int, job: Any) -> None:
        """An episode begins."""
        self._due_s = self._begun_s = self._now()
        self._steps = 0

    def step(self, sim: Any) -> None:
        """A control step has been done: wait until it is over."""
        self._steps += 1
        self._due_s += self._period_s
        late = self._now() - self._due_s
        if late < 0:
            self._sleep(-late)
        elif late > _FORGIVEN_S:
            self._due_s += late

    def end(self, sim: Any, row: int, result: Any) -> None:
        """The episode is over."""

    @property
    def real_time_factor(self) -> float:
        """Seconds of the episode in one of the clock's, since the episode began."""
        spent = self._now() - self._begun_s
        return self._steps * self._dt_s / spent if spent > 0 else 0.0
