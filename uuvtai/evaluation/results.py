"""What ``uuv eval`` was asked for and what it found: the request, each finished episode on disk as soon as it
is over, paired differences, and the summary of an agent."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from uuvtai.common import statistics
from uuvtai.common.enums import COLLIDED, FINAL_OUTCOMES, PLANNERS, REASONS, TRIGGERS
from uuvtai.common.files import open_to_append, read_bytes, read_text, refuse_links, truncate
from uuvtai.common.presets import built_in_agents
from uuvtai.config import Config
from uuvtai.config.loader import ConfigError, preset_of, read_preset, validated
from uuvtai.evaluation.episodes import EpisodeObserver, EpisodeResult, Job
from uuvtai.logs.run_folder import RunFolderError
from uuvtai.plugins.api import is_plugin, plugin_spec
from uuvtai.sim.behavior_tree import node_use
from uuvtai.sim.sim import Sim

if TYPE_CHECKING:
    from uuvtai.evaluation.agents import AgentSpec
    from uuvtai.sim.scene import SceneOptions


JOURNAL_FILE = "eval/episodes.jsonl"

_SYNC_S = 1.0
"""a kill of the process loses nothing that was flushed; against a failing machine the disk is asked this
often"""

_PLAIN = (
    "seed", "episode", "outcome", "time_s", "episode_return", "min_clearance_m", "path_length_m", "replans",
    "planned_by", "fallbacks",
)  # fmt: skip


class Finished(NamedTuple):
    """An episode that is over."""

    result: EpisodeResult
    wall_s: float
    """time that its agent had taken by then"""


class _Line(BaseModel):
    """A line of the file, checked."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)

    agent: str
    seed: int
    episode: int = Field(ge=0)
    outcome: Literal["success", "collision", "ttc", "out_of_tank", "timeout"]
    time_s: float = Field(ge=0)
    episode_return: float
    min_clearance_m: float
    path_length_m: float
    replans: dict[str, int]
    planned_by: dict[str, int]
    fallbacks: dict[str, int]
    ticks: list[int]
    acted: list[int]
    wall_s: float = Field(ge=0)

    def finished(self) -> Finished:
        plain: dict[str, Any] = {name: getattr(self, name) for name in _PLAIN}
        counts: dict[str, Any] = {
            name: np.array(getattr(self, name), dtype=np.int32) for name in ("ticks", "acted")
        }
        return Finished(EpisodeResult(**plain, **counts), self.wall_s)


class ResultsJournal:
    """The file ``eval/episodes.jsonl`` of a run folder that this process holds. Raises RunFolderError,
    FileError."""

    def __init__(self, folder: Path) -> None:
        """Reads what is there; a last line that a kill cut off is removed."""
        self._path, self._synced = folder / JOURNAL_FILE, time.monotonic()
        refuse_links(folder, self._path)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._found: dict[str, dict[Job, Finished]] = {}
        if self._path.exists():
            truncate(self._path, self._read(folder), folder)
        self._file = open_to_append(self._path, folder)

    def finished(self, agent: str) -> dict[Job, Finished]:
        """An agent's episodes that are over."""
        return self._found.setdefault(agent, {})

    def add(self, agent: str, finished: Finished) -> None:
        """Write an episode down."""
        result = finished.result
        row: dict[str, Any] = {"agent": agent} | {name: getattr(result, name) for name in _PLAIN}
        row |= {name: getattr(result, name).tolist() for name in ("ticks", "acted")}
        row |= {"wall_s": round(finished.wall_s, 3)}
        self._file.write(json.dumps(row, allow_nan=False, separators=(",", ":")).encode() + b"\n")
        self._file.flush()
        if time.monotonic() - self._synced >= _SYNC_S:
            os.fsync(self._file.fileno())
            self._synced = time.monotonic()
        self.finished(agent)[Job(result.seed, result.episode)] = finished

    def close(self) -> None:
        """See all of it on the disk."""
        if not self._file.closed:
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()

    def _read(self, folder: Path) -> int:
        """Length of the whole lines [bytes], which are taken in."""
        kept = 0
        for number, line in enumerate(read_bytes(self._path, folder=folder).splitlines(keepends=True), 1):
            if not line.endswith(b"\n"):
                break
            try:
                found = _Line.model_validate_json(line)
            except ValidationError as error:
                reason = error.errors()[0]["msg"]
                raise RunFolderError(
                    f"{self._path}, line {number}: is no finished episode ({reason}); take that line out"
                ) from None
            self.finished(found.agent)[Job(found.seed, found.episode)] = found.finished()
            kept += len(line)
        return kept


class JournalWriter(EpisodeObserver):
    """Recorder that writes an agent's episodes into the journal as they end; behind those whose work an
    episode needs to be whole."""

    def __init__(self, journal: ResultsJournal, agent: str) -> None:
        self._journal, self._method = journal, agent
        self.before_s = max((found.wall_s for found in journal.finished(agent).values()), default=0.0)
        self._begun = time.perf_counter()

    @property
    def wall_s(self) -> float:
        """Time that the agent has taken, that of earlier processes included."""
        return self.before_s + time.perf_counter() - self._begun

    def end(self, sim: Sim, row: int, result: EpisodeResult) -> None:
        self._journal.add(self._method, Finished(result, self.wall_s))


# ---- Agents compared on the same episodes: who alone arrives, how sure that is, and the difference in time
# where both do.

Episode = dict[str, Any]
"""an entry of ``episodes_detail``: seed, episode, outcome, time_s at least"""


def paired(agents: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Every pair of agents (entries of ``uuv eval --json``): only_a and only_b arrive, McNemar's exact p,
    times where both arrive.

    ``time_difference_mean_s`` is a's time minus b's, with a bootstrap interval over episodes.
    """
    return [_compared(a, b) for a, b in itertools.combinations(agents, 2)]


def _compared(a: dict[str, Any], b: dict[str, Any]) -> dict[str, Any]:
    pairs = _pairs(a["episodes_detail"], b["episodes_detail"])
    arrived = [tuple(e["outcome"] == "success" for e in pair) for pair in pairs]
    times = [
        (one["time_s"], other["time_s"])
        for (one, other), both in zip(pairs, arrived, strict=True)
        if all(both)
    ]
    only_a, only_b = arrived.count((True, False)), arrived.count((False, True))
    differences = [one - other for one, other in times]
    interval = statistics.bootstrap_interval(differences)
    return {
        "a": a["name"],
        "b": b["name"],
        "episodes": len(pairs),
        "both": len(times),
        "only_a": only_a,
        "only_b": only_b,
        "mcnemar_p": statistics.mcnemar_p(only_a, only_b),
        "time_a_mean_s": statistics.mean([one for one, _other in times]),
        "time_b_mean_s": statistics.mean([other for _one, other in times]),
        "time_difference_mean_s": statistics.mean(differences),
        "time_difference_ci95": None if interval is None else list(interval),
    }


def _pairs(a: list[Episode], b: list[Episode]) -> list[tuple[Episode, Episode]]:
    """Entries of the same (seed, episode), in the order of ``a``."""
    of_b = {(e["seed"], e["episode"]): e for e in b}
    return [(e, of_b[key]) for e in a if (key := (e["seed"], e["episode"])) in of_b]


# ---- What ``uuv eval --json`` says of ran episodes: one entry per agent, and the whole document.


def summary(
    name: str,
    results: list[EpisodeResult],
    env_steps: int,
    wall_s: float,
    env_steps_per_s: float | None = None,
) -> dict[str, Any]:
    """One agent's entry of ``uuv eval --json``; rates without episodes are None, never NaN.

    ``env_steps_per_s`` is a ``StepClock``'s: of simulating alone, where ``wall_s`` is all the time that the
    agent took.
    """
    n = len(results)
    outcomes = {outcome: sum(r.outcome == outcome for r in results) for outcome in FINAL_OUTCOMES}
    collided = sum(outcomes[o] for o in COLLIDED)
    time_mean = statistics.mean([r.time_s for r in results])
    to_goal = [r.time_s for r in results if r.outcome == "success"]
    return {
        "name": name,
        "episodes": n,
        "outcomes": outcomes,
        "success_rate": statistics.rate(outcomes["success"], n),
        "success_ci95": _as_list(statistics.wilson_interval(outcomes["success"], n)),
        "collision_rate": statistics.rate(collided, n),
        "collision_ci95": _as_list(statistics.wilson_interval(collided, n)),
        "return_mean": statistics.mean([r.episode_return for r in results]),
        "return_ci95": _as_list(statistics.bootstrap_interval([r.episode_return for r in results])),
        "time_mean_s": time_mean,
        "tts_s": statistics.time_to_success_s(time_mean, statistics.rate(outcomes["success"], n)),
        "time_to_success_mean_s": statistics.mean(to_goal),
        "time_to_success_ci95": _as_list(statistics.bootstrap_interval(to_goal)),
        "min_clearance_mean_m": statistics.mean([r.min_clearance_m for r in results]),
        "path_length_mean_m": statistics.mean([r.path_length_m for r in results]),
        "replans_per_episode": statistics.mean([float(sum(r.replans.values())) for r in results]),
        "replans_by_trigger": _summed(TRIGGERS, [r.replans for r in results]),
        "planned_by": _summed(PLANNERS, [r.planned_by for r in results]),
        "fallbacks_by_reason": _summed(REASONS, [r.fallbacks for r in results]),
        "env_steps": env_steps,
        "wall_s": round(wall_s, 3),
        "env_steps_per_s": None if env_steps_per_s is None else round(env_steps_per_s, 1),
        "episodes_detail": [
            {
                "seed": r.seed,
                "episode": r.episode,
                "outcome": r.outcome,
                "time_s": r.time_s,
                "return": r.episode_return,
                "min_clearance_m": r.min_clearance_m,
                "path_length_m": r.path_length_m,
                "replans": sum(r.replans.values()),
            }
            for r in results
        ],
    }


def tree_use(sim: Sim, results: list[EpisodeResult]) -> list[dict[str, Any]]:
    """Per node of the tree: the share of episodes that ticked it, its ticks, and the control steps in which
    it set the action."""
    ticks, acted = (
        np.stack([getattr(r, which) for r in results]).astype(np.int64) for which in ("ticks", "acted")
    )
    return [vars(use) for use in node_use(ticks, acted, len(sim.tree.names))]


def document(
    config: Config,
    world: str,
    sensors: str,
    vehicle: str,
    seeds: list[int],
    episodes: int,
    agents: list[dict[str, Any]],
) -> dict[str, Any]:
    """The whole ``uuv eval --json`` document."""
    return {
        "schema": 1,
        "world": world,
        **config.world.obstacles,
        "v_m_s": config.world.dynamic_speed_m_s,
        "sensors": sensors,
        "vehicle": vehicle,
        "localization": config.sensors.localization,
        "seeds": seeds,
        "episodes_per_seed": episodes,
        "agents": agents,
        "paired": paired(agents),
    }


def _as_list(interval: tuple[float, float] | None) -> list[float] | None:
    return None if interval is None else list(interval)


def _summed(names: tuple[str, ...], counts: list[dict[str, int]]) -> dict[str, int]:
    return {name: sum(c.get(name, 0) for c in counts) for name in names}


# ---- What ``uuv eval`` was asked for: an object, and the file by which an interrupted evaluation goes on.

REQUEST_FILE = "eval/request.json"
ORACLE = "oracle"  # agent that is asked, and does not drive: the privileged upper bound

_MAX_BYTES = 1 << 22
_GIVE = "give the folder that an interrupted 'uuv eval' printed"


@dataclass(frozen=True)
class Request:
    """What ``uuv eval`` was asked for."""

    config: Config
    world: str
    sensors: str
    agents: list[str]
    """as ``agents.load_agents`` takes them, and ``oracle``"""
    seeds: list[int]
    episodes: int
    vehicle: str = ""
    """name of its preset; of old requests ''"""
    num_envs: int | None = None
    record: int = 0
    depth_images: bool = False
    explain: bool = False
    explain_record: int = 3
    device: str = "auto"
    run_dir: Path | None = None

    @classmethod
    def typed(cls, scene: SceneOptions, agents: list[str], **rest: Any) -> Request:
        """What a command line asks for: the scene as it was typed, observed as the policies were trained.
        Raises ConfigError, CheckpointError."""
        from uuvtai.evaluation.agents import observation_of

        config, world = scene.config(observation_of(agents)), scene.world_name
        named = {kind: preset_of(kind, world, getattr(scene, kind)) for kind in ("sensors", "vehicle")}
        return cls(config=config, world=world, **named, agents=agents, **rest)


class _Document(BaseModel):
    """The file, checked."""

    model_config = ConfigDict(strict=True, extra="forbid")

    schema_: int = Field(alias="schema", ge=1, le=1)
    config: dict[str, Any]
    world: str
    sensors: str
    vehicle: str = ""
    agents: list[str]
    seeds: list[int] = Field(min_length=1)
    episodes: int = Field(ge=1)
    num_envs: int = Field(ge=1)
    record: int = Field(ge=0)
    depth_images: bool
    explain: bool
    explain_record: int = Field(ge=0)
    device: str
    cwd: str
    digests: dict[str, str]


def document_of(request: Request, num_envs: int, device: str, digests: dict[str, str]) -> dict[str, Any]:
    """The request with what was chosen for it, as JSON; ``digests``: sha256 of what drives, by agent."""
    given = {name: value for name, value in vars(request).items() if name not in ("config", "run_dir")}
    return {
        "schema": 1,
        **given,
        "num_envs": num_envs,
        "device": device,
        "config": request.config.model_dump(mode="json"),
        "cwd": os.getcwd(),
        "digests": digests,
    }


def read_request(place: Path) -> tuple[Request, dict[str, str]]:
    """The request of a run folder, and the sha256 of what drove by agent. Raises RunFolderError,
    FileError."""
    file = place / REQUEST_FILE
    try:
        found = _Document.model_validate_json(read_text(file, _MAX_BYTES, place))
        config = validated(found.config)
    except OSError as error:
        raise RunFolderError(f"{file}: cannot be read ({error.strerror}); {_GIVE}") from None
    except (ValidationError, ConfigError) as error:
        reason = str(error).splitlines()[0]
        if isinstance(error, ValidationError):
            first = error.errors()[0]
            reason = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
        raise RunFolderError(
            f"{file}: is no request of this version of 'uuv eval' ({reason}); {_GIVE}"
        ) from None
    given = found.model_dump(exclude={"schema_", "config", "cwd", "digests"})
    return _found_again(Request(config=config, **given), Path(found.cwd)), found.digests


def _found_again(request: Request, cwd: Path) -> Request:
    """Paths that were typed in another folder, seen from this one; names of what is built in stay names."""

    def seen(name: str) -> str:
        if is_plugin(name):
            return plugin_spec(name).located(cwd).text
        file = name.removesuffix("+truth")
        is_shipped = file in (ORACLE, *built_in_agents())
        return name if is_shipped or Path(file).exists() else str(cwd / name)

    return replace(request, agents=list(map(seen, request.agents)))


def digests_of(agents: list[AgentSpec]) -> dict[str, str]:
    """sha256 of what drives, by agent: of a policy's checkpoint, of a tree as it is run, with its stack,
    of the file of a plugin of the user's."""
    of_file = {agent.name: agent.own or agent.checkpoint for agent in agents}
    return {
        agent.name: source.sha256 if (source := of_file[agent.name]) else _tree_sha256(agent)
        for agent in agents
    }


def refuse_others(place: Path, before: dict[str, str], now: dict[str, str], of: str = "evaluation") -> None:
    """RunFolderError where another tree or policy has an agent's name by now: episodes of both under one name
    would prove nothing."""
    changed = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    if changed:
        raise RunFolderError(
            f"{place}: {', '.join(changed)} has changed since this {of} began; begin a new one with another "
            "--run-dir"
        )


def _tree_sha256(agent: AgentSpec) -> str:
    tree = dataclasses.asdict(agent.tree)
    del tree["source"], tree["xml"]
    stack = [] if agent.stack is None else [read_preset("stack", agent.stack)]
    return hashlib.sha256(json.dumps([tree, agent.privileged, *stack]).encode()).hexdigest()
