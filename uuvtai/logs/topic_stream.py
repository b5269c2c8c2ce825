"""One episode as messages: of every control step the topics that are due, encoded. What becomes of them is
another's: ``mcap_log`` writes them to a file, ``live.broadcast`` shows them to viewers."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, Protocol

from uuvtai.logs.moment import EpisodeEnd, EpisodeHeader, Moment, Values
from uuvtai.logs.schemas import Schema
from uuvtai.logs.topic import Topic
from uuvtai.logs.topics import TOPICS

SIGNS = ("clock.step", *dict.fromkeys(name for topic in TOPICS for name in topic.when.reads))
"""what ``TopicStream.due`` looks at"""


class TopicMessage(NamedTuple):
    """JSON text on a topic."""

    topic: str
    time_ns: int
    data: bytes


class EpisodeSink(Protocol):
    """Takes one episode, step by step."""

    def due(self, values: Values) -> list[Topic]:
        """Topics that this step has messages on; what they read must be in the values written. Needs SIGNS
        alone."""
        ...

    def write(self, values: Values) -> None:
        """Take one control step."""

    def close(self, result: EpisodeEnd) -> None:
        """The episode is over."""

    def abandon(self) -> None:
        """Stop without a result."""


class TopicStream:
    """One episode's messages, in order."""

    def __init__(self, header: EpisodeHeader, depth_images: bool = False) -> None:
        self._header = header
        self._topics = [topic for topic in TOPICS if depth_images or not topic.on_request]
        self._written: dict[str, float] = {}

    def schemas(self) -> dict[str, Schema]:
        """JSON schema of every topic in this run."""
        return {topic.name: topic.schema_for(self._header) for topic in self._topics}

    def due(self, values: Values) -> list[Topic]:
        """Topics that this step has messages on. Needs SIGNS alone."""
        return self._due(Moment(self._header, values))

    def messages(self, values: Values) -> Iterator[TopicMessage]:
        """Those of one control step, each encoded as it is asked for. A topic whose values are not given has
        none. Raises ValueError for numbers that are not finite."""
        moment = Moment(self._header, values)
        for topic in self._due(moment):
            if all(name in values for name in topic.reads):
                data = topic.encode(moment)
                self._written[topic.name] = moment.time_s
                for message in data if isinstance(data, list) else [data]:
                    yield TopicMessage(topic.name, moment.time_ns, message)

    def _due(self, moment: Moment) -> list[Topic]:
        return [
            topic for topic in self._topics if topic.when.holds(moment, self._waited(topic, moment.time_s))
        ]

    def _waited(self, topic: Topic, time_s: float) -> bool:
        """Its last message is old enough for its rate."""
        hertz, last = topic.when.hertz, self._written.get(topic.name)
        return last is None or not hertz or time_s - last >= 1.0 / hertz - 1e-6
