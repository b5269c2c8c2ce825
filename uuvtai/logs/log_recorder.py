"""Record chosen episodes of a running simulator: read what the table of topics names, hand it to the log."""

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
from uuvtai.logs.mcap_log import SIGNS, McapEpisodeLog
from uuvtai.logs.moment import EpisodeEnd, EpisodeHeader
from uuvtai.logs.scenario_document import scenario_document
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


class EpisodeRecorder:
    """Writes one MCAP file per recorded job; ``paths`` maps each to its file."""

    def __init__(
        self,
        folder: Path,
        world: str,
        controller: str,
        jobs: list[Any],
        depth_images: bool = False,
        policy: PolicyNote | None = None,
    ) -> None:
        """``jobs``: each a RecordedJob; ``policy``: who drives; None = the simulator's tree."""
        self._world, self._controller, self._policy = world, controller, policy
        self._depth_images = depth_images
        self._logs: dict[int, McapEpisodeLog] = {}
        self._applied: dict[int, np.ndarray] = {}
        self.paths = {job: folder / f"{controller}_seed{job.seed}_episode{job.episode}.mcap" for job in jobs}

    def begin(self, sim: Recordable, row: int, job: RecordedJob) -> None:
        """Open the log of an episode that was just reset, and write its first step."""
        if job in self.paths:
            self._logs[row] = McapEpisodeLog(self.paths[job], self._header(sim, row, job), self._depth_images)
            self._applied[row] = np.zeros(4, np.float32)
            self._write(sim, [row])

    def step(self, sim: Recordable) -> None:
        """Write a step of every recorded row."""
        if self._logs:
            self._write(sim, sorted(self._logs))

    def end(self, sim: Recordable, row: int, result: EpisodeEnd) -> None:
        """Close the log with the episode's result."""
        if row in self._logs:
            self._logs.pop(row).close(result)

    def abort(self) -> None:
        """Leave the unfinished logs as they are (``.part``); ``uuv log repair`` reads them."""
        for log in self._logs.values():
            log.abandon()
        self._logs.clear()

    def _header(self, sim: Recordable, row: int, job: RecordedJob) -> EpisodeHeader:
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
        due = {row: self._logs[row].due(values[row]) for row in rows}
        _fill(sim, values, {row: [name for topic in due[row] for name in topic.reads] for row in rows})
        for row in rows:
            self._logs[row].write(values[row])
            self._applied[row] = values[row]["driver.action" if self._policy else "teacher.action"]


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
