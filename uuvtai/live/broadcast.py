"""Running episodes as messages for viewers: the topics of the log, as they come."""

from __future__ import annotations

from uuvtai.live.viewer_server import ViewerServer
from uuvtai.logs.log_recorder import EpisodeReader, PolicyNote, Recordable, RecordedJob
from uuvtai.logs.moment import EpisodeEnd, EpisodeHeader, Values
from uuvtai.logs.topic import Topic
from uuvtai.logs.topic_stream import TopicStream


class LiveEpisode:
    """One episode for the viewers of a server; an ``EpisodeSink``."""

    def __init__(self, server: ViewerServer, header: EpisodeHeader, depth_images: bool) -> None:
        self._server, self._stream = server, TopicStream(header, depth_images)
        self._dt_s = header.config.episode.control_dt_s
        server.begin(self._stream.schemas())

    def due(self, values: Values) -> list[Topic]:
        """Topics that this step has messages on."""
        return self._stream.due(values)

    def write(self, values: Values) -> None:
        """Show one control step."""
        self._server.tell_time(round(int(values["clock.step"]) * self._dt_s * 1e9))
        for message in self._stream.messages(values):
            self._server.send(message)

    def close(self, result: EpisodeEnd) -> None:
        """Its last messages have told how it ended."""

    def abandon(self) -> None:
        """Nothing is kept."""


class Broadcast(EpisodeReader):
    """Shows every episode of row 0; an ``EpisodeObserver``."""

    def __init__(
        self,
        server: ViewerServer,
        world: str,
        controller: str,
        depth_images: bool = False,
        policy: PolicyNote | None = None,
    ) -> None:
        super().__init__(world, controller, policy)
        self._server, self._depth_images = server, depth_images

    def sink_for(self, sim: Recordable, row: int, job: RecordedJob) -> LiveEpisode | None:
        """Viewers look at one vehicle."""
        return LiveEpisode(self._server, self.header(sim, row, job), self._depth_images) if row == 0 else None
