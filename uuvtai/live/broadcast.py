"""Running episodes as messages for viewers: the topics of the log, as they come."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

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
