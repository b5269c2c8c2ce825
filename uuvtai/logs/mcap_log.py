"""Record one episode as MCAP: what the table of topics asks of every control step.

    with McapEpisodeLog(path, header) as log:
        log.write(values)            # step 0, then after every control step
        log.close(result)

The file grows as ``<path>.XXXXXXXX.part`` and gets its name when it is complete. A killed process leaves that
file, which lacks at most the messages of the last control step or the last hundredth, whichever is more;
``uuv log repair`` makes it whole.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

from uuvtai.logs.container import McapFile
from uuvtai.logs.encode import number
from uuvtai.logs.log_errors import LogError
from uuvtai.logs.moment import EpisodeEnd, EpisodeHeader, Values
from uuvtai.logs.scenario_document import FRAMES
from uuvtai.logs.topic import Topic
from uuvtai.logs.topic_stream import TopicStream


class McapEpisodeLog:
    """One episode's log. Raises LogError where the file cannot be written; nothing half-written is left
    then."""

    def __init__(self, path: Path, header: EpisodeHeader, depth_images: bool = False) -> None:
        self.path, self.header = Path(path), header
        self._stream = TopicStream(header, depth_images)
        self._closed = False
        with self._guarded():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = McapFile(self.path)
        with self._guarded():
            self._write_head()
            self._channels = self._declared()

    def due(self, values: Values) -> list[Topic]:
        """Topics that this step has messages on; what they read must be in the values written. Needs SIGNS
        alone."""
        return self._stream.due(values)

    def write(self, values: Values) -> None:
        """Add one control step. Raises ValueError for numbers that are not finite."""
        with self._guarded():
            for message in self._stream.messages(values):
                self._file.add_message(self._channels[message.topic], message.time_ns, message.data)
            self._file.settle()

    def close(self, result: EpisodeEnd) -> None:
        """Add how it ended and finish the file under its name."""
        with self._guarded():
            self._file.add_metadata("uuv.result", _result_metadata(result))
            self._file.finish()
            self._closed = True

    def abandon(self) -> None:
        """Stop without a result: the ``.part`` file stays, complete up to the last step written."""
        if not self._closed:
            with self._guarded():
                self._file.leave()
            self._closed = True

    def __enter__(self) -> McapEpisodeLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.abandon()

    def _write_head(self) -> None:
        self._file.add_metadata("uuv.run", _run_metadata(self.header))
        self._file.add_attachment("config.yaml", "application/yaml", self.header.config_yaml.encode())
        scenario = json.dumps(self.header.scenario, indent=1, allow_nan=False)
        self._file.add_attachment("scenario.json", "application/json", scenario.encode())
        if self.header.tree_xml:
            self._file.add_attachment("tree.xml", "application/xml", self.header.tree_xml)

    def _declared(self) -> dict[str, int]:
        """Channel of every topic."""
        channels: dict[str, int] = {}
        known: dict[str, int] = {}
        for topic, schema in self._stream.schemas().items():
            name = schema["title"]
            if name not in known:
                text = json.dumps(schema, separators=(",", ":"))
                known[name] = self._file.add_schema(name, "jsonschema", text.encode())
            channels[topic] = self._file.add_channel(topic, known[name])
        return channels

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self._closed = True
            if hasattr(self, "_file"):
                self._file.discard()
            raise LogError(
                f"{self.path}: cannot write the log ({error.strerror or error}); nothing of it was kept. "
                "Make room or choose a folder that can be written: --run-dir DIR"
            ) from error


def _run_metadata(header: EpisodeHeader) -> dict[str, str]:
    scenario, config = header.scenario, header.config
    return {
        "version": header.version,
        "git_sha": header.git_sha,
        "controller": header.controller,
        "world": str(scenario["world"]),
        "seed": str(scenario["seed"]),
        "episode": str(scenario["episode"]),
        "config_sha256": hashlib.sha256(header.config_yaml.encode()).hexdigest(),
        "checkpoint_sha256": header.checkpoint_sha256,
        "control_dt_s": repr(config.episode.control_dt_s),
        "sonar_max_range_m": repr(config.sensors.sonar.max_range_m),
        "frames": json.dumps(FRAMES),
    }


def _result_metadata(result: EpisodeEnd) -> dict[str, str]:
    return {
        "outcome": result.outcome,
        "return": number(result.episode_return),
        "time_s": number(result.time_s),
        "min_clearance_m": number(result.min_clearance_m),
        "replans": str(sum(result.replans.values())),
        "replans_by_trigger": json.dumps(result.replans),
        "planned_by": json.dumps(result.planned_by),
    }
