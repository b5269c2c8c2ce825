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
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from uuvtai.common.obstacle_motion import describe_scenario
from uuvtai.config import Config
from uuvtai.config.loader import to_yaml
from uuvtai.config.task import TERMS
from uuvtai.logs.container import McapFile
from uuvtai.logs.encode import EpisodeEnd, EpisodeHeader, LogError, Moment, Topic, Values, number
from uuvtai.logs.run_folder import git_sha
from uuvtai.logs.scenario import FRAMES, scenario_document
from uuvtai.logs.schemas import Schema
from uuvtai.logs.topics import TOPICS

# ---- One episode as messages, for a file or for viewers: of every control step the topics that are due.

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
        """Topics of this step; what they read must be in the values written. Needs SIGNS alone."""
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


class McapEpisodeLog(contextlib.AbstractContextManager["McapEpisodeLog"]):
    """One episode's log. Raises LogError where the file cannot be written, of which nothing is left then."""

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
        """Topics of this step; what they read must be in the values written. Needs SIGNS alone."""
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

    def __exit__(self, *_error: object) -> None:
        self.abandon()

    def _write_head(self) -> None:
        self._file.add_metadata("uuv.run", _run_metadata(self.header))
        self._file.add_attachment("config.yaml", "application/yaml", self.header.config_yaml.encode())
        scenario = json.dumps(self.header.scenario, indent=1, allow_nan=False)
        self._file.add_attachment("scenario.json", "application/json", scenario.encode())
        if self.header.tree_xml:
            self._file.add_attachment("tree.xml", "application/xml", self.header.tree_xml)

    def _declared(self) -> dict[str, int]:
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
        "agent": header.agent,
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


# ---- Chosen episodes of a running simulator: what the table of topics names, for a log or whoever asks.


class Recordable(Protocol):
    """What a recorder needs of a simulator."""

    config: Config
    s: Any  # the state's structs by name
    tree: Any  # the ``FlatTree`` that drives

    def rows(self, field: Any, envs: list[int] | None = None) -> np.ndarray:
        """Host copy of a field's rows."""
        ...


class RecordedJob(Protocol):
    """An episode: hashable, and equal where it is the same one."""

    @property
    def seed(self) -> int: ...
    @property
    def episode(self) -> int: ...


@dataclass(frozen=True)
class PolicyNote:
    """What a log says of the policy that drives."""

    agent: Any  # its ``learn.agent.PolicyAgent``, or an ``adapters.PluginAgent``, which expects nothing
    checkpoint_sha256: str
    distillation_lambda: float | None  # weight of the distillation when the checkpoint was written

    def outputs(self, row: int) -> dict[str, Any]:
        decision, foresees = self.agent.decision, self.agent.world_model is not None
        return {
            "agent.action": decision.action[row].cpu().numpy(),
            "agent.value": float(decision.value[row]) if len(decision.value) else None,
            "agent.std": decision.std.cpu().numpy() if len(decision.std) else None,
            "agent.distillation_lambda": self.distillation_lambda,
            "agent.residual": float(decision.residual[row]) if foresees else None,
            "agent.uncertainty": float(decision.uncertainty[row]) if foresees else None,
        }


NO_POLICY: dict[str, Any] = dict.fromkeys(
    f"agent.{name}" for name in ("action", "value", "std", "distillation_lambda", "residual", "uncertainty")
)
"""the same where the tree drives"""


class EpisodeReader:
    """Reads chosen episodes out of a running simulator and hands them, step by step, to a sink each."""

    def __init__(self, world: str, agent: str, policy: PolicyNote | None = None) -> None:
        """``policy``: who drives; None = the simulator's tree."""
        self._world, self._agent, self._policy = world, agent, policy
        self._sinks: dict[int, EpisodeSink] = {}
        self._applied: dict[int, np.ndarray] = {}

    def sink_for(self, sim: Recordable, row: int, job: RecordedJob) -> EpisodeSink | None:
        """Where the episode that was just reset in this row goes; None = nowhere."""
        raise NotImplementedError

    def begin(self, sim: Recordable, row: int, job: RecordedJob) -> None:
        """An episode was just reset: hand over its first step."""
        sink = self.sink_for(sim, row, job)
        if sink is not None:
            self._sinks[row] = sink
            self._applied[row] = np.zeros(4, np.float32)
            self._write(sim, [row])

    def step(self, sim: Recordable) -> None:
        """Hand over a step of every chosen row."""
        if self._sinks:
            self._write(sim, sorted(self._sinks))

    def end(self, sim: Recordable, row: int, result: EpisodeEnd) -> None:
        if row in self._sinks:
            self._sinks.pop(row).close(result)

    def abort(self) -> None:
        """Leave the unfinished episodes as they are."""
        for sink in self._sinks.values():
            sink.abandon()
        self._sinks.clear()

    def header(self, sim: Recordable, row: int, job: RecordedJob) -> EpisodeHeader:
        described = describe_scenario(lambda name: sim.rows(attrgetter(name)(sim.s), [row])[0])
        return EpisodeHeader(
            agent=self._agent,
            config=sim.config,
            config_yaml=to_yaml(sim.config),
            scenario=scenario_document(sim.config, described, self._world, job.seed, job.episode),
            reward_terms=TERMS,
            tree_nodes=sim.tree.names,
            tree_xml=sim.tree.xml,
            git_sha=git_sha() or "unknown",
            checkpoint_sha256=self._policy.checkpoint_sha256 if self._policy else "",
        )

    def _write(self, sim: Recordable, rows: list[int]) -> None:
        values = {
            row: {
                "agent.applied": self._applied[row],
                **(self._policy.outputs(row) if self._policy else NO_POLICY),
            }
            for row in rows
        }
        _fill(sim, values, dict.fromkeys(rows, SIGNS))
        due = {row: self._sinks[row].due(values[row]) for row in rows}
        _fill(sim, values, {row: [name for topic in due[row] for name in topic.reads] for row in rows})
        for row in rows:
            self._sinks[row].write(values[row])
            self._applied[row] = values[row]["agent.action" if self._policy else "behavior.action"]


class EpisodeRecorder(EpisodeReader):
    """Writes an MCAP file per recorded job, ``paths``; unfinished ones stay ``.part`` for uuv log repair."""

    def __init__(
        self,
        folder: Path,
        world: str,
        agent: str,
        jobs: list[Any],
        depth_images: bool = False,
        policy: PolicyNote | None = None,
    ) -> None:
        """``jobs``: each a RecordedJob."""
        super().__init__(world, agent, policy)
        self._depth_images = depth_images
        self.paths = {job: folder / f"{agent}_seed{job.seed}_episode{job.episode}.mcap" for job in jobs}

    def sink_for(self, sim: Recordable, row: int, job: RecordedJob) -> McapEpisodeLog | None:
        if job not in self.paths:
            return None
        for left in self.paths[job].parent.glob(f"{self.paths[job].name}.{'[0-9a-f]' * 8}.part"):
            left.unlink()  # of an interrupted run, whose folder this one holds
        return McapEpisodeLog(self.paths[job], self.header(sim, row, job), self._depth_images)


def _fill(sim: Recordable, values: dict[int, dict[str, Any]], names: Mapping[int, Iterable[str]]) -> None:
    """Read these fields of these rows from the simulator, each at once for all rows that lack it."""
    wanted: dict[str, dict[int, None]] = {}
    for row, needed in names.items():
        for name in needed:
            if name not in values[row]:
                wanted.setdefault(name, {})[row] = None
    for name, rows in wanted.items():
        for row, value in zip(rows, sim.rows(attrgetter(name)(sim.s), list(rows)), strict=True):
            values[row][name] = value
