"""Chosen episodes of a running simulator: read what the table of topics names, hand it to a log or whoever
asks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from uuvtai.closed_form import describe_scenario
from uuvtai.config import Config
from uuvtai.config.task import TERMS
from uuvtai.loader import to_yaml
from uuvtai.logs.mcap_log import McapEpisodeLog
from uuvtai.logs.moment import EpisodeEnd, EpisodeHeader
from uuvtai.logs.scenario_document import scenario_document
from uuvtai.logs.topic_stream import SIGNS, EpisodeSink
from uuvtai.run_folder import git_sha


class Recordable(Protocol):
    """What a recorder needs of a simulator."""

    config: Config
    s: Any
    """the state's structs by name"""
    tree: Any
    """the ``FlatTree`` that drives"""

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

    pilot: Any
    """its ``learn.pilot.Pilot``, or an ``own.own_driver.OwnDriver``, which expects nothing"""
    checkpoint_sha256: str
    distill_lambda: float | None
    """weight of the distillation when the checkpoint was written"""

    def outputs(self, row: int) -> dict[str, Any]:
        """What the policy chooses and expects in this row."""
        decision, foresees = self.pilot.decision, self.pilot.world_model is not None
        return {
            "driver.action": decision.action[row].cpu().numpy(),
            "driver.value": float(decision.value[row]) if len(decision.value) else None,
            "driver.std": decision.std.cpu().numpy() if len(decision.std) else None,
            "driver.distill_lambda": self.distill_lambda,
            "driver.residual": float(decision.residual[row]) if foresees else None,
            "driver.uncertainty": float(decision.uncertainty[row]) if foresees else None,
        }


NO_POLICY: dict[str, Any] = dict.fromkeys(
    f"driver.{name}" for name in ("action", "value", "std", "distill_lambda", "residual", "uncertainty")
)
"""the same where the tree drives"""


class EpisodeReader:
    """Reads chosen episodes out of a running simulator and hands them, step by step, to a sink each."""

    def __init__(self, world: str, controller: str, policy: PolicyNote | None = None) -> None:
        """``policy``: who drives; None = the simulator's tree."""
        self._world, self._controller, self._policy = world, controller, policy
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
        """The episode of this row is over."""
        if row in self._sinks:
            self._sinks.pop(row).close(result)

    def abort(self) -> None:
        """Leave the unfinished episodes as they are."""
        for sink in self._sinks.values():
            sink.abandon()
        self._sinks.clear()

    def header(self, sim: Recordable, row: int, job: RecordedJob) -> EpisodeHeader:
        """What comes before the first step."""
        described = describe_scenario(lambda name: sim.rows(attrgetter(name)(sim.s), [row])[0])
        return EpisodeHeader(
            controller=self._controller,
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
                "driver.applied": self._applied[row],
                **(self._policy.outputs(row) if self._policy else NO_POLICY),
            }
            for row in rows
        }
        _fill(sim, values, dict.fromkeys(rows, SIGNS))
        due = {row: self._sinks[row].due(values[row]) for row in rows}
        _fill(sim, values, {row: [name for topic in due[row] for name in topic.reads] for row in rows})
        for row in rows:
            self._sinks[row].write(values[row])
            self._applied[row] = values[row]["driver.action" if self._policy else "teacher.action"]


class EpisodeRecorder(EpisodeReader):
    """Writes one MCAP file per recorded job; ``paths`` maps each to its file. Unfinished ones stay ``.part``;
    ``uuv log repair`` reads them."""

    def __init__(
        self,
        folder: Path,
        world: str,
        controller: str,
        jobs: list[Any],
        depth_images: bool = False,
        policy: PolicyNote | None = None,
    ) -> None:
        """``jobs``: each a RecordedJob."""
        super().__init__(world, controller, policy)
        self._depth_images = depth_images
        self.paths = {job: folder / f"{controller}_seed{job.seed}_episode{job.episode}.mcap" for job in jobs}

    def sink_for(self, sim: Recordable, row: int, job: RecordedJob) -> McapEpisodeLog | None:
        """The log of a recorded job."""
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
