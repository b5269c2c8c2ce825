"""Run episodes side by side: every agent meets exactly the same ones, whatever the batch size or order."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
import torch

from uuvtai.common.enums import OUTCOMES, PLANNERS, REASONS, RUNNING, TRIGGERS
from uuvtai.compile.taichi_frontend import kernels_made
from uuvtai.sim.setup import Scene
from uuvtai.sim.sim import Sim

if TYPE_CHECKING:
    from uuvtai.learning.policy_agent import AgentDecision


# ---- Time of simulating alone: compiling, recording and drawing are no part of it; and how many steps are
# still to come.


class StepClock:
    """Sums up the time of passes through the simulator. A pass in which a kernel was made does not count, nor
    the first of its kind."""

    def __init__(
        self, now: Callable[[], float] = time.perf_counter, made: Callable[[], int] = kernels_made
    ) -> None:
        """``made``: how many kernels there are by now."""
        self._now, self._made = now, made
        self._known: set[str] = set()
        self.seconds, self.env_steps = 0.0, 0

    @contextlib.contextmanager
    def counting(self, kind: str, env_steps: int = 0) -> Iterator[None]:
        """Time a pass of this kind ('reset', 'step'), which does ``env_steps`` env steps."""
        made, begun = self._made(), self._now()
        yield
        if kind in self._known and self._made() == made:
            self.seconds += self._now() - begun
            self.env_steps += env_steps
        self._known.add(kind)

    @property
    def env_steps_per_s(self) -> float | None:
        """None where no step counted."""
        return self.env_steps / self.seconds if self.env_steps and self.seconds > 0 else None


_WORTH_SHARE = 0.1  # of the episodes must be over before their length says something of the others'
_LEAST_SHARE = 0.25
"""of the mean length lies before an episode that is longer than that already: it may end at any time, but the
last ones take long"""


def env_steps_left(lengths: Iterable[int], ages: Iterable[int], waiting: int) -> int | None:
    """Env steps still to come, a guess: from the ``lengths`` of the episodes that are over, the ``ages`` of
    those that run, and the number that wait for their turn. None where too few are over.
    """
    over, running = list(lengths), list(ages)
    if not over or len(over) < _WORTH_SHARE * (len(over) + len(running) + waiting):
        return None
    mean = sum(over) / len(over)
    return round(mean * waiting + sum(max(mean - age, _LEAST_SHARE * mean) for age in running))


# ---- Jobs side by side: who watches them, who drives, how each ended.

_REFILL_SHARE = 16
"""Ended rows wait until this part of the batch can be reset together, or until nothing runs: fewer reset
passes, same results."""


_PROGRESS_EVERY = 50  # passes between two calls of ``progress`` while no episode ends


@dataclass(frozen=True)
class Job:
    """One episode to run."""

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
        for part in self._parts:
            part.begin(sim, row, job)

    def step(self, sim: Sim) -> None:
        for part in self._parts:
            part.step(sim)

    def end(self, sim: Sim, row: int, result: EpisodeResult) -> None:
        for part in self._parts:
            part.end(sim, row, result)


class Agent(Protocol):
    """Chooses the actions of all rows from their observations (``learn.agent.PolicyAgent``)."""

    def reset(self, rows: torch.Tensor) -> None:
        """New episodes have begun in the rows (n_env,) where this is not 0."""

    def decide(self, obs: torch.Tensor) -> AgentDecision:
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


Ran = tuple[list[EpisodeResult], int]
"""results in the order of the jobs, and the env steps that they took"""


def run_episodes(
    sim: Sim,
    jobs: list[Job],
    recorder: EpisodeObserver | None = None,
    progress: Progress | None = None,
    agent: Agent | None = None,
    clock: StepClock | None = None,
) -> Ran:
    """Run every job: ``episodes_in_steps`` to its end."""
    (ran,) = run_in_turn([episodes_in_steps(sim, jobs, recorder, progress, agent, clock)])
    return ran


def run_in_turn(going: Sequence[Generator[None, None, Ran]]) -> list[Ran]:
    """Advance all of them to their ends, a control step each in turn."""
    ran: dict[int, Ran] = {}
    while len(ran) < len(going):
        for i, one in enumerate(going):
            try:
                if i not in ran:
                    next(one)
            except StopIteration as ended:
                ran[i] = ended.value
    return [ran[i] for i in range(len(going))]


def episodes_in_steps(
    sim: Sim,
    jobs: list[Job],
    recorder: EpisodeObserver | None = None,
    progress: Progress | None = None,
    agent: Agent | None = None,
    clock: StepClock | None = None,
) -> Generator[None, None, Ran]:
    """Run every job, a control step each time. Without an agent the simulator's tree drives.

    ``clock`` is told the time of simulating, without what the recorder takes.
    """
    observed = sim.observation
    stepper = Stepper(sim, agent)
    waiting = list(enumerate(jobs))[::-1]
    running: dict[int, int] = {}
    results: dict[int, EpisodeResult] = {}
    free = list(range(sim.num_envs))[::-1]
    begun: dict[int, int] = {}
    passes = env_steps = 0
    clock = clock or StepClock()

    def left() -> int | None:
        over = (round(r.time_s / sim.config.episode.control_dt_s) for r in results.values())
        return env_steps_left(over, (passes - begun[row] for row in running), len(waiting))

    if progress:
        progress(0, len(jobs), 0, None)
    while waiting or running:
        if waiting and free and (len(free) * _REFILL_SHARE >= sim.num_envs or not running):
            with clock.counting("reset"):
                rows = _refill(sim, stepper, jobs, waiting, free, running)
            begun |= dict.fromkeys(rows, passes)
            if recorder:
                for row in rows:
                    recorder.begin(sim, row, jobs[running[row]])
        passes, env_steps = passes + 1, env_steps + len(running)
        with clock.counting("step", len(running)):
            stepper.step()
            outcome = sim.rows(sim.s.termination.outcome)
        if recorder:
            recorder.step(sim)
        if progress and passes % _PROGRESS_EVERY == 1:
            progress(len(results), len(jobs), env_steps, left())
        yield
        ended = [row for row in sorted(running) if outcome[row] != RUNNING]
        if not ended:
            continue
        for row, result in zip(
            ended, _results(sim, ended, [jobs[running[row]] for row in ended]), strict=True
        ):
            results[running.pop(row)] = result
            free.append(row)
            if recorder:
                recorder.end(sim, row, result)
        sim.deactivate_ended()
        if progress:
            progress(len(results), len(jobs), env_steps, left())
    sim.observation = observed
    return [results[i] for i in range(len(jobs))], env_steps


class Stepper:
    """Steps the simulator by an agent, or by its tree where there is none."""

    def __init__(self, sim: Sim, agent: Agent | None) -> None:
        self._sim, self._agent = sim, agent
        self._obs = sim.observe() if agent else None
        self._action: torch.Tensor | None = None

    def step(self) -> None:
        """One control step, and what to do in the next."""
        self._sim.step(self._action)
        if self._agent:
            self._agent.advance()
            self._decide(self._agent)

    def reset(self, mask: torch.Tensor, seed: torch.Tensor, number: torch.Tensor) -> None:
        """Begin episodes as ``Sim.reset`` does."""
        self._sim.reset(mask, seed, number)
        if self._agent:
            self._agent.reset(mask)
            self._decide(self._agent)

    def _decide(self, agent: Agent) -> None:
        assert self._obs is not None  # observed since the beginning
        self._action = agent.decide(self._obs).action


def _refill(
    sim: Sim, stepper: Stepper, jobs: list[Job], waiting: list, free: list[int], running: dict[int, int]
) -> list[int]:
    """Begin as many jobs as there are free rows; the rows."""
    begun: dict[int, Job] = {}
    while waiting and free:
        index, job = waiting.pop()
        row = free.pop()
        running[row] = index
        begun[row] = job
    scenes = {row: job.scene for row, job in begun.items() if job.scene is not None}
    if scenes:  # the rows that are not reset have drawn their scenarios already
        any_scene = next(iter(scenes.values()))
        sim.set_scenes([scenes.get(row, any_scene) for row in range(sim.num_envs)])
    stepper.reset(*beginning(sim, begun))
    return list(begun)


def beginning(sim: Sim, jobs: dict[int, Job]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """(mask, seed, number) (n_env,), by which ``Sim.reset`` and ``Sim.draw`` begin these jobs in their
    rows."""
    mask, seed, number = (torch.zeros(sim.num_envs, dtype=torch.int32) for _ in range(3))
    for row, job in jobs.items():
        mask[row], seed[row], number[row] = 1, job.seed, job.episode
    return mask.to(sim.device), seed.to(sim.device), number.to(sim.device)


def _results(sim: Sim, rows: list[int], jobs: list[Job]) -> list[EpisodeResult]:
    s, dt = sim.s, sim.config.episode.control_dt_s
    read = {
        name: sim.rows(field, rows)
        for name, field in {
            "outcome": s.termination.outcome,
            "step": s.clock.step,
            "return": s.reward.episode_return,
            "clearance": s.termination.min_clearance_m,
            "length": s.termination.path_length_m,
            "replans": s.route.replans,
            "planned_by": s.route.planned_by,
            "fallbacks": s.route.fallbacks,
            "ticks": s.behavior.ticks,
            "acted": s.behavior.acted,
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
