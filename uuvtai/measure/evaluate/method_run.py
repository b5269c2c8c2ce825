"""One method of an evaluation plays its episodes on its simulator, as far as they are not over."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from uuvtai.logs.log_recorder import EpisodeRecorder, PolicyNote
from uuvtai.measure.episodes.methods import Method
from uuvtai.measure.episodes.playing import EpisodeResult, Job, Recorders, run_episodes
from uuvtai.measure.episodes.stopwatch import StepClock
from uuvtai.measure.evaluate.eval_request import Request
from uuvtai.measure.evaluate.ledger import Ledger, LedgerWriter
from uuvtai.measure.evaluate.summary import summary, tree_use
from uuvtai.rrt import RoutePlanner
from uuvtai.sim import Sim


class EvaluationWatch(Protocol):
    """Shows how far a comparison is."""

    def start(self, name: str, total: int) -> None: ...
    def note(self, text: str) -> None: ...
    def update(self, done: int, total: int, env_steps: int, left: int | None = None) -> None: ...
    def stop(self) -> None: ...


@dataclass(frozen=True)
class Comparison:
    """What is compared, and on what."""

    request: Request
    methods: list[Method]
    sims: dict[str | None, Sim]
    """by the stack that drives; None = the request's own"""
    policies: dict[str, PolicyNote | None]
    """by method, ready for its simulator; None where a tree drives"""
    planners: dict[str, RoutePlanner | None]
    """by method: who plans routes in place of the simulator's planners; None = they do"""
    watch: EvaluationWatch

    def any_simulator(self) -> Sim:
        """For what is the same in all of them."""
        return next(iter(self.sims.values()))

    def simulator_for(self, method: Method) -> Sim:
        """The method's simulator, with its tree, its planner and, where it is a yardstick, with the truth."""
        sim = self.sims[method.stack]
        sim.use_tree(method.tree)
        sim.privileged = method.privileged
        sim.planner = self.planners[method.name]
        return sim


@dataclass(frozen=True)
class MethodRun:
    """What a method has done."""

    method: Method
    policy: PolicyNote | None
    results: list[EpisodeResult]
    entry: dict[str, Any]
    """of ``uuv eval --json``"""
    use: list[dict[str, Any]]
    """of its tree's nodes"""
    logs: dict[Job, Path]


def play(comparison: Comparison, method: Method, jobs: list[Job], ledger: Ledger, folder: Path) -> MethodRun:
    """Play one method's episodes, as far as they are not over; ``folder`` is the run's."""
    policy, watch = comparison.policies[method.name], comparison.watch
    dt = comparison.request.config.episode.control_dt_s
    sim = comparison.simulator_for(method)
    recorder = _recorder(comparison.request, folder, method.name, jobs, policy)
    logs = recorder.paths if recorder else {}
    over = ledger.finished(method.name)
    left = [job for job in jobs if job not in over or (job in logs and not logs[job].exists())]
    before = len(jobs) - len(left)
    watch.start(method.name, len(jobs))
    writer, clock = LedgerWriter(ledger, method.name), StepClock()
    try:
        run_episodes(
            sim,
            left,
            Recorders([recorder, writer]),
            lambda done, _total, env_steps, to_come: watch.update(
                before + done, len(jobs), env_steps, to_come
            ),
            policy.pilot if policy else None,
            clock,
        )
    finally:
        watch.stop()
        if method.own:
            method.own.close()
        if recorder:
            recorder.abort()
    if method.own and (slow := method.own.told()):
        watch.note(slow)
    results = [over[job].result for job in jobs]
    env_steps, wall_s = sum(round(r.time_s / dt) for r in results), writer.wall_s if left else writer.before_s
    entry = summary(method.name, results, env_steps, wall_s, clock.env_steps_per_s)
    entry |= {"privileged": method.privileged} | method.document()
    return MethodRun(method, policy, results, entry, tree_use(sim, results), logs)


def _recorder(
    request: Request, folder: Path, method: str, jobs: list[Job], policy: PolicyNote | None
) -> EpisodeRecorder | None:
    if not request.record:
        return None
    world, chosen = Path(request.world).stem, jobs[: request.record]
    return EpisodeRecorder(folder / "logs", world, method, chosen, request.depth_images, policy)
