"""Compare agents on paired scenarios in one run folder: results, logs, pictures."""

from __future__ import annotations

import functools
import hashlib
import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from uuvtai.common.enums import PLANNERS, REASONS, TRIGGERS
from uuvtai.common.errors import SettingError
from uuvtai.common.obstacle_motion import describe_scenario
from uuvtai.common.presets import TRAINING_TREE
from uuvtai.config import Config
from uuvtai.config.learning import LearningConfig
from uuvtai.config.loader import ConfigError
from uuvtai.evaluation import episodes, failure_causes
from uuvtai.evaluation.agents import TRUTH, AgentSpec, differences, load_agents
from uuvtai.evaluation.oracle import earliest_arrival
from uuvtai.evaluation.results import (
    ORACLE,
    JournalWriter,
    Request,
    ResultsJournal,
    digests_of,
    document,
    document_of,
    read_request,
    refuse_others,
    summary,
    tree_use,
)
from uuvtai.evaluation.results import REQUEST_FILE as REQUEST
from uuvtai.logs.run_folder import RunFolder, default_run_dir, refuse_place
from uuvtai.logs.writer import EpisodeRecorder, PolicyNote
from uuvtai.plugins.api import refuse_code, to_resume
from uuvtai.sim.behavior_tree import read_tree
from uuvtai.sim.rrt import RoutePlanner
from uuvtai.sim.sim import Sim

if TYPE_CHECKING:
    from uuvtai.learning.runner import AnyTrainer, Metrics
_BATCH = 256
"""Episodes run together by default: enough to fill the cores, few enough that the last stragglers cost
little."""


def compare(
    request: Request, watch: EvaluationWatch, guest: Guest | None = None
) -> tuple[dict[str, Any], Path]:
    """Run every agent's episodes, a ``guest``'s before them; the ``uuv eval --json`` document and the run
    folder.

    Everything that can be refused is refused before anything is written. Raises ConfigError, ValueError,
    MemoryError, RunFolderError, CheckpointError.
    """
    if request.num_envs is not None and request.num_envs < 1:
        raise SettingError(
            f"--num-envs {request.num_envs}: at least 1 env is needed, for example --num-envs 64"
        )
    if len(set(request.seeds)) != len(request.seeds):
        raise ConfigError(
            f"--seeds {','.join(map(str, request.seeds))}: a seed is given twice; its episodes would be the "
            "same"
        )
    refuse_place(request.run_dir)
    agents = agents_of(request, watch)
    if guest and guest.agent.name in [agent.name for agent in agents]:
        raise ConfigError(f"--agent {guest.agent.name}: somebody else has that name; rename the file")
    agents = [guest.agent, *agents] if guest else agents
    num_envs = request.num_envs or min(len(request.seeds) * request.episodes, _BATCH)
    comparison = replace(comparison_of(request, num_envs, agents, watch), guest=guest)
    folder = RunFolder(request.run_dir or default_run_dir(request.world), request.config, request.seeds)
    with _going_on(folder, watch, request.agents, can_resume=guest is None):
        device = comparison.any_simulator().device.type
        folder.write_json(REQUEST, document_of(request, num_envs, device, digests_of(agents)))
        runs = run_agents(comparison, folder)
        return write_results(comparison, folder, runs), folder.path


def resume(place: Path, watch: EvaluationWatch, allow_code: bool = False) -> tuple[dict[str, Any], Path]:
    """Go on with an evaluation that was interrupted or killed: episodes that are over stay as they are.
    ``allow_code``: Python files that the folder names may be run.

    The document is that of an undisturbed evaluation, times of the machine excepted. Raises RunFolderError,
    FileError, ConfigError, CheckpointError.
    """
    folder = RunFolder.held(place, "uuv eval")
    try:
        request, digests = read_request(place)
        refuse_code(place, request.agents, allow_code)
        agents = agents_of(request, watch)
        refuse_others(place, digests, digests_of(agents))
        folder.go_on({"what": "eval"})
    except BaseException:
        folder.release()
        raise
    with _going_on(folder, watch, request.agents):
        assert request.num_envs is not None  # the file states it
        comparison = comparison_of(request, request.num_envs, agents, watch)
        return write_results(comparison, folder, run_agents(comparison, folder)), place


@contextmanager
def _going_on(
    folder: RunFolder, watch: EvaluationWatch, agents: list[str], can_resume: bool = True
) -> Iterator[None]:
    """Record how the work inside ends, and say how to go on where it was interrupted and can be."""
    try:
        with folder.recorded():
            yield
    except KeyboardInterrupt:
        watch.stop()
        if not can_resume:
            raise
        watch.note(f"finished episodes are kept; go on with: uuv eval {to_resume(folder.path, agents)}")
        if any((folder.path / "logs").glob("*.part")):
            watch.note(
                f"{folder.path / 'logs'}: .part files end where it was interrupted; --resume records them "
                "anew, or: uuv log repair"
            )
        raise
    finally:
        watch.stop()


def agents_of(request: Request, watch: EvaluationWatch) -> list[AgentSpec]:
    """The request's agents but the oracle. Raises ConfigError, CheckpointError, PluginError."""
    names = [name for name in request.agents if name != ORACLE]
    agents = load_agents(names, watch.note)
    if not agents and (request.record or request.explain):
        raise ConfigError(
            "--record, --explain: the oracle drives no vehicle; add who does, for example --agent bt,oracle"
        )
    for agent in agents:
        if changes := differences(agent, request.config):
            watch.note(f"note: {changes}")
    return agents


def comparison_of(
    request: Request, num_envs: int, agents: list[AgentSpec], watch: EvaluationWatch
) -> Comparison:
    """A simulator for the request's own config and one for every stack that drives a row: the episodes are
    the same in all. And the policies, ready for them."""
    from uuvtai.sim.sim import Sim

    configs = {agent.stack: agent.config_of(request.config) for agent in agents} or {None: request.config}
    tree = agents[0].tree if agents else read_tree(TRAINING_TREE)  # the oracle drives nothing
    sims = {stack: Sim(config, num_envs, tree, request.device) for stack, config in configs.items()}
    for agent in agents:
        if agent.own:
            agent.own.note = watch.note
    policies = {agent.name: agent.agent_for(sims[agent.stack]) for agent in agents}
    planners = {agent.name: agent.planner_for(sims[agent.stack]) for agent in agents}
    return Comparison(request, agents, sims, policies, planners, watch)


def run_agents(comparison: Comparison, folder: RunFolder) -> list[AgentRun]:
    """Run every agent's episodes that are not over yet."""
    jobs = episodes.jobs_of(comparison.request.seeds, comparison.request.episodes)
    journal = ResultsJournal(folder.path)
    try:
        return [run_agent(comparison, agent, jobs, journal, folder.path) for agent in comparison.agents]
    finally:
        journal.close()


def write_results(comparison: Comparison, folder: RunFolder, runs: list[AgentRun]) -> dict[str, Any]:
    """The whole document of what was run, with the oracle's row, and all that is written and drawn of it: the
    trees that drove, too, with the use of their nodes."""
    request = comparison.request
    jobs = episodes.jobs_of(request.seeds, request.episodes)
    entries = [agent_run.entry for agent_run in runs]
    scenarios = scenarios_of(comparison.any_simulator(), jobs)
    if ORACLE in request.agents:
        entries.append(oracle_entry(request.config, jobs, scenarios, comparison.watch))
    named = request.world, request.sensors, request.vehicle
    result = document(request.config, *named, request.seeds, request.episodes, entries)
    result |= {"remainder": remainder_of(entries), "scenarios_sha256": scenarios_sha256(scenarios)}
    folder.write_json("eval/result.json", result)
    driving = [agent_run for agent_run in runs if agent_run.policy is None]
    for agent_run in driving:
        folder.write_bytes(f"eval/trees/{agent_run.agent.name}.xml", agent_run.agent.tree.xml)
    use = {agent_run.agent.name: agent_run.use for agent_run in driving}
    folder.write_json("eval/tree.json", {"schema": 1, "use": use})
    if request.explain:
        explain(comparison, runs, result, folder)
    _draw(comparison, folder.path, [agent_run.logs for agent_run in runs if agent_run.logs])
    return result


def _draw(comparison: Comparison, folder: Path, logs: list[dict[episodes.Job, Path]]) -> None:
    """One picture per recorded episode with every agent's trajectory."""
    if not logs:
        return
    from uuvtai.logs.picture import picture

    for job in logs[0]:
        end = f"seed{job.seed}_episode{job.episode}"
        files = [paths[job] for paths in reversed(logs)]  # the map drawn is that of the last agent
        names = [file.stem.removesuffix(f"_{end}") for file in reversed(files)]
        picture(files, folder / "pictures" / f"{end}.png", agents=names)
        picture(files, folder / "pictures" / f"{end}_clearance.png", clearance=True, agents=names)


_DIGITS = 3  # of a number: millimetres


def scenarios_sha256(scenarios: list[dict[str, Any]]) -> str:
    """Of ``closed_form.describe_scenario``'s documents, to the millimetre. On another processor a number may
    round to the other side: equal digests prove equal scenarios, unequal ones do not prove the contrary."""
    text = json.dumps(_rounded(scenarios), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _rounded(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(inner) for inner in value]
    return round(float(value), _DIGITS) + 0.0 if isinstance(value, float) else value


# ---- One agent of an evaluation runs its episodes on its simulator, as far as they are not over.


class EvaluationWatch(Protocol):
    """Shows how far a comparison, a sweep or a reproduction is."""

    def start(self, name: str, total: int, done: int = 0) -> None: ...
    def note(self, text: str) -> None: ...
    def update(self, done: int, total: int, env_steps: int, left: int | None = None) -> None: ...
    def stop(self) -> None: ...


@dataclass(frozen=True)
class Guest:
    """An agent that no name stands for, and who looks on while it drives."""

    agent: AgentSpec
    observer: episodes.EpisodeObserver


@dataclass(frozen=True)
class Comparison:
    """What is compared, and on what."""

    request: Request
    agents: list[AgentSpec]
    sims: dict[str | None, Sim]
    """by the stack that drives; None = the request's own"""
    policies: dict[str, PolicyNote | None]
    """by agent, ready for its simulator; None where a tree drives"""
    planners: dict[str, RoutePlanner | None]
    """by agent: who plans routes in place of the simulator's planners; None = they do"""
    watch: EvaluationWatch
    guest: Guest | None = None

    def any_simulator(self) -> Sim:
        """For what is the same in all of them."""
        return next(iter(self.sims.values()))

    def simulator_for(self, agent: AgentSpec) -> Sim:
        """The agent's simulator, with its tree, its planner and, where it is an oracle, with the truth."""
        sim = self.sims[agent.stack]
        sim.use_tree(agent.tree)
        sim.privileged = agent.privileged
        sim.planner = self.planners[agent.name]
        return sim


@dataclass(frozen=True)
class AgentRun:
    """What an agent has done."""

    agent: AgentSpec
    policy: PolicyNote | None
    results: list[episodes.EpisodeResult]
    entry: dict[str, Any]
    """of ``uuv eval --json``"""
    use: list[dict[str, Any]]
    """of its tree's nodes"""
    logs: dict[episodes.Job, Path]


def run_agent(
    comparison: Comparison, agent: AgentSpec, jobs: list[episodes.Job], journal: ResultsJournal, folder: Path
) -> AgentRun:
    """Run one agent's episodes, as far as they are not over; ``folder`` is the run's."""
    policy, watch = comparison.policies[agent.name], comparison.watch
    dt = comparison.request.config.episode.control_dt_s
    sim = comparison.simulator_for(agent)
    recorder = _recorder(comparison.request, folder, agent.name, jobs, policy)
    logs = recorder.paths if recorder else {}
    over = journal.finished(agent.name)
    left = [job for job in jobs if job not in over or (job in logs and not logs[job].exists())]
    before = len(jobs) - len(left)
    watch.start(agent.name, len(jobs))
    writer, clock = JournalWriter(journal, agent.name), episodes.StepClock()
    guest = comparison.guest
    looker = guest.observer if guest and guest.agent is agent else None
    try:
        episodes.run_episodes(
            sim,
            left,
            episodes.Recorders([recorder, writer, looker]),
            lambda done, _total, env_steps, to_come: watch.update(
                before + done, len(jobs), env_steps, to_come
            ),
            policy.agent if policy else None,
            clock,
        )
    finally:
        watch.stop()
        if agent.own:
            agent.own.close()
        if recorder:
            recorder.abort()
    if agent.own and (slow := agent.own.told()):
        watch.note(slow)
    results = [over[job].result for job in jobs]
    env_steps, wall_s = sum(round(r.time_s / dt) for r in results), writer.wall_s if left else writer.before_s
    entry = summary(agent.name, results, env_steps, wall_s, clock.env_steps_per_s)
    is_privileged = agent.privileged or bool(agent.own and agent.own.saw_truth())
    entry |= {"privileged": is_privileged} | agent.document()
    return AgentRun(agent, policy, results, entry, tree_use(sim, results), logs)


def _recorder(
    request: Request, folder: Path, agent: str, jobs: list[episodes.Job], policy: PolicyNote | None
) -> EpisodeRecorder | None:
    if not request.record:
        return None
    world, chosen = Path(request.world).stem, jobs[: request.record]
    return EpisodeRecorder(folder / "logs", world, agent, chosen, request.depth_images, policy)


# ---- Evaluations in the course of a training: the policy as it is, on the simulator that it is trained with.


def evaluate_now(trainer: AnyTrainer, config: LearningConfig) -> Metrics:
    """``eval/*``: the policy as it is, without exploration, on scenarios of its own; training goes on as if
    nothing had been."""
    from uuvtai.learning.environments import Simulated
    from uuvtai.learning.trainer import Trainer

    if not isinstance(trainer, Trainer) or not isinstance(trainer.env, Simulated):
        return trainer.evaluate()  # the others run episodes by themselves
    env, agent = trainer.env.env, trainer.env.agent(trainer.policy)  # type: ignore[arg-type]
    held = env.capture()
    try:
        env.sim.sleep()
        env.sim.set_scenes()
        jobs = episodes.jobs_of([config.train.evaluate_seed], config.train.evaluate_episodes)
        results, env_steps = episodes.run_episodes(env.sim, jobs, agent=agent)
    finally:
        env.sim.set_scenes(config.train.scenes)
        env.restore(held)
    results_document = summary("policy", results, env_steps, 0.0)
    names = ("success_rate", "collision_rate", "return_mean", "time_to_success_mean_s")
    return {f"eval/{name}": results_document[name] for name in names if results_document[name] is not None}


# ---- ``uuv eval --explain``: the causes of failures in the document, and logs of the worst.


def explain(comparison: Comparison, runs: list[AgentRun], result: dict[str, Any], folder: RunFolder) -> None:
    """Replay what failed, add the causes to the document, record the worst. What is known is written before
    the next long step begins."""
    rows = {agent_run.agent.name: _explained(comparison, agent_run) for agent_run in runs}
    _write_causes(folder, result)
    for agent_run in runs:
        agent, entry = agent_run.agent, agent_run.entry
        found = rows[agent.name]
        chosen = failure_causes.chosen_for_recording(found, comparison.request.explain_record)
        paths = failure_causes.record_worst(
            comparison.simulator_for(agent),
            chosen,
            folder.path / "explain",
            comparison.request.world,
            agent.name,
            comparison.watch.note,
            agent_run.policy,
            list(rows),
        )
        for row, path in zip(chosen, paths, strict=True):
            entry["explain"][found.index(row)]["log"] = str(path.relative_to(folder.path))
    _write_causes(folder, result)


def _explained(comparison: Comparison, agent_run: AgentRun) -> list[failure_causes.Row]:
    """An agent's failures with their explanations, which its entry then holds too."""
    policy, watch, name = agent_run.policy, comparison.watch, agent_run.agent.name
    watch.start(f"{name}: replaying failures", len(failure_causes.failures(agent_run.results)))
    rows = failure_causes.explain_failures(
        comparison.simulator_for(agent_run.agent),
        agent_run.results,
        watch.update,
        policy.agent if policy else None,
        agent_run.agent.own is not None,
    )
    watch.stop()
    if lost := len(failure_causes.failures(agent_run.results)) - len(rows):
        watch.note(
            f"{name}: {lost} failures ended otherwise when they were run again and are not explained: "
            "your code depends on more than it is shown (random numbers, the clock, older episodes)"
        )
    agent_run.entry["causes"] = failure_causes.table_of(rows)
    agent_run.entry["explain"] = [row.document() for row in rows]
    return rows


def _write_causes(folder: RunFolder, result: dict[str, Any]) -> None:
    folder.write_json("eval/result.json", result)
    agents = [
        {"name": entry["name"], "causes": entry["causes"], "explain": entry["explain"]}
        for entry in result["agents"]
        if "explain" in entry
    ]
    folder.write_json("eval/explain.json", {"schema": 1, "agents": agents})


# ---- Privileged oracles beside the agents: the oracle's row of the table, and what an agent lacks of it.

_UNKNOWN = (
    "return_mean",
    "min_clearance_mean_m",
    "path_length_mean_m",
    "replans_per_episode",
    "env_steps_per_s",
)
"""What the oracle does not tell: it drives no vehicle."""

_UNKNOWN_OF_EPISODE = ("return", "min_clearance_m", "path_length_m", "replans")


def scenarios_of(sim: Sim, jobs: list[episodes.Job]) -> list[dict[str, Any]]:
    """``describe_scenario``'s document of every job. No row of the simulator runs afterwards."""
    found = [
        scenario
        for first in range(0, len(jobs), sim.num_envs)
        for scenario in _drawn(sim, jobs[first : first + sim.num_envs])
    ]
    sim.sleep()
    return found


def _drawn(sim: Sim, jobs: list[episodes.Job]) -> list[dict[str, Any]]:
    sim.draw(*episodes.beginning(sim, dict(enumerate(jobs))))
    rows = list(range(len(jobs)))
    read = functools.cache(lambda name: sim.rows(attrgetter(name)(sim.s), rows))
    return [describe_scenario(lambda name, row=row: read(name)[row]) for row in rows]


def oracle_entry(
    config: Config, jobs: list[episodes.Job], scenarios: list[dict[str, Any]], watch: EvaluationWatch
) -> dict[str, Any]:
    """The oracle's entry of ``uuv eval --json``: success with the earliest arrival, or timeout, which here
    means "not reachable"."""
    begun, results = time.perf_counter(), []
    watch.start(ORACLE, len(jobs))
    try:
        for job, scenario in zip(jobs, scenarios, strict=True):
            results.append(_result(job, earliest_arrival(scenario, config), config))
            watch.update(len(results), len(jobs), 0, None)
    finally:
        watch.stop()
    entry = summary(ORACLE, results, 0, time.perf_counter() - begun)
    details = [detail | dict.fromkeys(_UNKNOWN_OF_EPISODE) for detail in entry["episodes_detail"]]
    return entry | dict.fromkeys(_UNKNOWN) | {"episodes_detail": details, "privileged": True}


def _result(job: episodes.Job, time_s: float | None, config: Config) -> episodes.EpisodeResult:
    horizon = config.episode.horizon_steps * config.episode.control_dt_s
    return episodes.EpisodeResult(
        seed=job.seed,
        episode=job.episode,
        outcome="timeout" if time_s is None else "success",
        time_s=round(horizon if time_s is None else time_s, 6),
        episode_return=0.0,
        min_clearance_m=0.0,
        path_length_m=0.0,
        replans=dict.fromkeys(TRIGGERS, 0),
        planned_by=dict.fromkeys(PLANNERS, 0),
        fallbacks=dict.fromkeys(REASONS, 0),
        ticks=np.zeros(0),
        acted=np.zeros(0),
    )


def remainder_of(entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What each agent lacks of 100 %, split: ``remainder`` of ``uuv eval --json``, for agents whose
    ``+truth`` and the oracle are there.

    Episodes, as differences of successes that add up to ``missed``: sensing = with the true tracks less
    without, forecast_decision = the oracle's less that (with the vehicle's inertia, which the oracle has
    not), physics = what the oracle cannot reach either. A part may be negative where knowing more did not
    help; ``lost_with_truth`` counts the episodes that the agent won and its ``+truth`` did not.
    """
    won = {
        entry["name"]: {
            (one["seed"], one["episode"]) for one in entry["episodes_detail"] if one["outcome"] == "success"
        }
        for entry in entries
    }
    if ORACLE not in won:
        return []
    ceiling = won[ORACLE]
    return [
        {
            "agent": name,
            "episodes": entries[0]["episodes"],
            "missed": entries[0]["episodes"] - len(own),
            "sensing": len(with_truth) - len(own),
            "forecast_decision": len(ceiling) - len(with_truth),
            "physics": entries[0]["episodes"] - len(ceiling),
            "lost_with_truth": len(own - with_truth),
        }
        for name, own in won.items()
        if (with_truth := won.get(f"{name}+{TRUTH}")) is not None
    ]
