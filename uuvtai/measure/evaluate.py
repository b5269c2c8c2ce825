"""Evaluate controllers on fixed scenarios: every method meets exactly the same episodes, whatever the batch
size or order."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch

from uuvtai.config import Config
from uuvtai.measure.paired import paired
from uuvtai.measure.statistics import bootstrap_interval, mean, rate, time_to_success_s, wilson_interval
from uuvtai.measure.stopwatch import StepClock, env_steps_left
from uuvtai.outcomes import COLLIDED, ENDINGS, OUTCOMES, RUNNING
from uuvtai.plan_codes import PLANNERS, REASONS, TRIGGERS
from uuvtai.scenario import Scene
from uuvtai.sim import Sim
from uuvtai.tree import node_use

if TYPE_CHECKING:
    from uuvtai.learn.pilot import PilotDecision

_REFILL_SHARE = 16
"""Ended rows wait until this part of the batch can be reset together, or until nothing runs: fewer reset
passes, same results."""


_TOLD_EVERY = 50
"""passes between two words about the progress while no episode ends"""


@dataclass(frozen=True)
class Job:
    """One episode to play."""

    seed: int
    episode: int
    scene: Scene | None = None
    """(S, D, v [m/s]) of its scenario; None = the simulator's own. One of ``run_episodes``'s jobs has one
    only if all have"""


@dataclass(frozen=True)
class EpisodeResult:
    """How one episode ended."""

    seed: int
    episode: int
    outcome: str
    time_s: float
    episode_return: float
    min_clearance_m: float
    path_length_m: float
    replans: dict[str, int]
    planned_by: dict[str, int]
    fallbacks: dict[str, int]
    ticks: np.ndarray
    acted: np.ndarray


class EpisodeObserver(Protocol):
    """Watches chosen episodes as they run."""

    def begin(self, sim: Sim, row: int, job: Job) -> None:
        """An episode has just been reset in this row."""

    def step(self, sim: Sim) -> None:
        """A control step has been done."""

    def end(self, sim: Sim, row: int, result: EpisodeResult) -> None:
        """The episode of this row is over."""


class Recorders:
    """Several recorders as one."""

    def __init__(self, parts: Iterable[EpisodeObserver | None]) -> None:
        """None among them is nobody."""
        self._parts = [part for part in parts if part is not None]

    def begin(self, sim: Sim, row: int, job: Job) -> None:
        """The episode ``job`` begins in this row."""
        for part in self._parts:
            part.begin(sim, row, job)

    def step(self, sim: Sim) -> None:
        """A control step has been done."""
        for part in self._parts:
            part.step(sim)

    def end(self, sim: Sim, row: int, result: EpisodeResult) -> None:
        """The episode of this row is over."""
        for part in self._parts:
            part.end(sim, row, result)


class Driver(Protocol):
    """Chooses the actions of all rows from their observations (``learn.pilot.Pilot``)."""

    def reset(self, rows: torch.Tensor) -> None:
        """New episodes have begun in the rows (n_env,) where this is not 0."""

    def decide(self, obs: torch.Tensor) -> PilotDecision:
        """What to do now; asking again changes nothing."""
        ...

    def advance(self) -> None:
        """What was decided last has been done."""


Progress = Callable[[int, int, int, int | None], None]
"""Called with (episodes done, episodes in all, env steps done, env steps still to come); (0, n, 0, None)
before the first pass, which may compile; the last is None where it is too early to guess."""


def jobs_of(seeds: Iterable[int], episodes: int) -> list[Job]:
    """Episodes 0 .. episodes - 1 of every seed."""
    return [Job(seed, episode) for seed in seeds for episode in range(episodes)]


def run_episodes(
    sim: Sim,
    jobs: list[Job],
    recorder: EpisodeObserver | None = None,
    progress: Progress | None = None,
    driver: Driver | None = None,
    clock: StepClock | None = None,
) -> tuple[list[EpisodeResult], int]:
    """Play every job; results in the order of ``jobs``, and the env steps it took. Without a driver the
    simulator's tree drives.

    ``clock`` is told the time of simulating, without what the recorder takes.
    """
    observed = sim.observation
    wheel = _Wheel(sim, driver)
    waiting = list(enumerate(jobs))[::-1]
    playing: dict[int, int] = {}
    results: dict[int, EpisodeResult] = {}
    free = list(range(sim.num_envs))[::-1]
    begun: dict[int, int] = {}
    passes = env_steps = 0
    clock = clock or StepClock()

    def left() -> int | None:
        over = (round(r.time_s / sim.config.episode.control_dt_s) for r in results.values())
        return env_steps_left(over, (passes - begun[row] for row in playing), len(waiting))

    if progress:
        progress(0, len(jobs), 0, None)
    while waiting or playing:
        if waiting and free and (len(free) * _REFILL_SHARE >= sim.num_envs or not playing):
            with clock.counting("reset"):
                rows = _refill(sim, wheel, jobs, waiting, free, playing)
            begun |= dict.fromkeys(rows, passes)
            if recorder:
                for row in rows:
                    recorder.begin(sim, row, jobs[playing[row]])
        passes, env_steps = passes + 1, env_steps + len(playing)
        with clock.counting("step", len(playing)):
            wheel.step()
            outcome = sim.rows(sim.s.referee.outcome)
        if recorder:
            recorder.step(sim)
        if progress and passes % _TOLD_EVERY == 1:
            progress(len(results), len(jobs), env_steps, left())
        ended = [row for row in sorted(playing) if outcome[row] != RUNNING]
        if not ended:
            continue
        for row, result in zip(
            ended, _results(sim, ended, [jobs[playing[row]] for row in ended]), strict=True
        ):
            results[playing.pop(row)] = result
            free.append(row)
            if recorder:
                recorder.end(sim, row, result)
        sim.sleep_ended()
        if progress:
            progress(len(results), len(jobs), env_steps, left())
    sim.observation = observed
    return [results[i] for i in range(len(jobs))], env_steps


class _Wheel:
    """Steps the simulator by a driver, or by its tree where there is none."""

    def __init__(self, sim: Sim, driver: Driver | None) -> None:
        self._sim, self._driver = sim, driver
        self._obs = sim.observe() if driver else None
        self._action: torch.Tensor | None = None

    def step(self) -> None:
        """One control step, and what to do in the next."""
        self._sim.step(self._action)
        if self._driver:
            self._driver.advance()
            self._decide(self._driver)

    def reset(self, mask: torch.Tensor, seed: torch.Tensor, number: torch.Tensor) -> None:
        """Begin episodes as ``Sim.reset`` does."""
        self._sim.reset(mask, seed, number)
        if self._driver:
            self._driver.reset(mask)
            self._decide(self._driver)

    def _decide(self, driver: Driver) -> None:
        assert self._obs is not None  # observed since the beginning
        self._action = driver.decide(self._obs).action


def _refill(
    sim: Sim, wheel: _Wheel, jobs: list[Job], waiting: list, free: list[int], playing: dict[int, int]
) -> list[int]:
    """Begin as many jobs as there are free rows; the rows."""
    mask, seed, number = (torch.zeros(sim.num_envs, dtype=torch.int32) for _ in range(3))
    begun: list[tuple[int, Job]] = []
    while waiting and free:
        index, job = waiting.pop()
        row = free.pop()
        playing[row] = index
        mask[row], seed[row], number[row] = 1, job.seed, job.episode
        begun.append((row, job))
    _set_scenes(sim, begun)
    wheel.reset(mask.to(sim.device), seed.to(sim.device), number.to(sim.device))
    return [row for row, _job in begun]


def _set_scenes(sim: Sim, begun: list[tuple[int, Job]]) -> None:
    """Give the rows about to be reset the scenes of their jobs; the others have drawn their scenarios
    already."""
    scenes = {row: job.scene for row, job in begun if job.scene is not None}
    if scenes:
        any_scene = next(iter(scenes.values()))
        sim.set_scenes([scenes.get(row, any_scene) for row in range(sim.num_envs)])


def _results(sim: Sim, rows: list[int], jobs: list[Job]) -> list[EpisodeResult]:
    s, dt = sim.s, sim.config.episode.control_dt_s
    read = {
        name: sim.rows(field, rows)
        for name, field in {
            "outcome": s.referee.outcome,
            "step": s.clock.step,
            "return": s.reward.episode_return,
            "clearance": s.referee.min_clearance_m,
            "length": s.referee.path_length_m,
            "replans": s.route.replans,
            "planned_by": s.route.planned_by,
            "fallbacks": s.route.fallbacks,
            "ticks": s.teacher.ticks,
            "acted": s.teacher.acted,
        }.items()
    }
    return [
        EpisodeResult(
            seed=job.seed,
            episode=job.episode,
            outcome=OUTCOMES[int(read["outcome"][i])],
            time_s=round(int(read["step"][i]) * dt, 6),
            episode_return=float(read["return"][i]),
            min_clearance_m=float(read["clearance"][i]),
            path_length_m=float(read["length"][i]),
            replans=_named(TRIGGERS, read["replans"][i]),
            planned_by=_named(PLANNERS, read["planned_by"][i]),
            fallbacks=_named(REASONS, read["fallbacks"][i]),
            ticks=read["ticks"][i][: len(sim.tree.names)].copy(),
            acted=read["acted"][i][: len(sim.tree.names)].copy(),
        )
        for i, job in enumerate(jobs)
    ]


def _named(names: tuple[str, ...], counts: np.ndarray) -> dict[str, int]:
    return {name: int(count) for name, count in zip(names, counts, strict=True)}


# ---------------------------------------------------------------------------------------------------- summary


def summary(
    name: str,
    results: list[EpisodeResult],
    env_steps: int,
    wall_s: float,
    env_steps_per_s: float | None = None,
) -> dict[str, Any]:
    """One method's entry of ``uuv eval --json`` (docs: interfaces); rates without episodes are None, never
    NaN.

    ``env_steps_per_s`` is a ``StepClock``'s: of simulating alone, where ``wall_s`` is all the time that the
    method took.
    """
    n = len(results)
    outcomes = {outcome: sum(r.outcome == outcome for r in results) for outcome in ENDINGS}
    collided = sum(outcomes[o] for o in COLLIDED)
    time_mean, to_goal = (
        mean([r.time_s for r in results]),
        [r.time_s for r in results if r.outcome == "success"],
    )
    return {
        "name": name,
        "episodes": n,
        "outcomes": outcomes,
        "success_rate": rate(outcomes["success"], n),
        "success_ci95": _as_list(wilson_interval(outcomes["success"], n)),
        "collision_rate": rate(collided, n),
        "collision_ci95": _as_list(wilson_interval(collided, n)),
        "return_mean": mean([r.episode_return for r in results]),
        "return_ci95": _as_list(bootstrap_interval([r.episode_return for r in results])),
        "time_mean_s": time_mean,
        "tts_s": time_to_success_s(time_mean, rate(outcomes["success"], n)),
        "time_to_success_mean_s": mean(to_goal),
        "time_to_success_ci95": _as_list(bootstrap_interval(to_goal)),
        "min_clearance_mean_m": mean([r.min_clearance_m for r in results]),
        "path_length_mean_m": mean([r.path_length_m for r in results]),
        "replans_per_episode": mean([float(sum(r.replans.values())) for r in results]),
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
    config: Config, world: str, sensors: str, seeds: list[int], episodes: int, methods: list[dict[str, Any]]
) -> dict[str, Any]:
    """The whole ``uuv eval --json`` document."""
    return {
        "schema": 1,
        "world": world,
        "S": config.world.n_static,
        "D": config.world.n_dynamic,
        "v_m_s": config.world.dynamic_speed_m_s,
        "sensors": sensors,
        "seeds": seeds,
        "episodes_per_seed": episodes,
        "methods": methods,
        "paired": paired(methods),
    }


def _as_list(interval: tuple[float, float] | None) -> list[float] | None:
    return None if interval is None else list(interval)


def _summed(names: tuple[str, ...], counts: list[dict[str, int]]) -> dict[str, int]:
    return {name: sum(c[name] for c in counts) for name in names}
