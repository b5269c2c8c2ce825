"""Compare controllers and trained policies on paired scenarios in one run folder: results, logs, pictures, videos."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from uuvtai.config import Config
from uuvtai.loader import ConfigError
from uuvtai.run_folder import RunFolder, default_run_dir, refuse_place

if TYPE_CHECKING:
    from uuvtai.measure.evaluate import EpisodeResult, Job
    from uuvtai.measure.methods import Method
    from uuvtai.measure.recording import EpisodeRecorder, PolicyNote
    from uuvtai.sim import Sim
    from uuvtai.tree import FlatTree

ORACLE = "oracle"
"""controller that is asked, not driven: the privileged upper bound"""

_BATCH = 256
"""Episodes played together by default: enough to fill the cores, few enough that the last stragglers cost little."""


@dataclass(frozen=True)
class Request:
    """What ``uuv eval`` was asked for."""

    config: Config
    world: str
    sensors: str
    controllers: list[str]
    """names of trees, paths of XML files, either with ``+truth``; ``oracle``"""
    seeds: list[int]
    episodes: int
    policies: tuple[str, ...] = ()
    """run folders, checkpoint folders or shipped names"""
    num_envs: int | None = None
    record: int = 0
    video: bool = False
    depth_images: bool = False
    explain: bool = False
    explain_record: int = 3
    device: str = "auto"
    run_dir: Path | None = None


class Watch(Protocol):
    """Shows how far a comparison is."""

    def start(self, name: str, total: int) -> None: ...
    def note(self, text: str) -> None: ...
    def update(self, done: int, total: int, env_steps: int) -> None: ...
    def stop(self) -> None: ...


@dataclass
class _Played:
    """What a method has done."""

    method: Method
    policy: PolicyNote | None
    results: list[EpisodeResult]
    use: list[dict[str, Any]]
    logs: dict[Job, Path]


def compare(request: Request, watch: Watch) -> tuple[dict[str, Any], Path]:
    """Play every method's episodes; the ``uuv eval --json`` document and the run folder.

    Everything that can be refused is refused before anything is written. Raises ConfigError, ValueError, MemoryError, RunFolderError,
    CheckpointError.
    """
    if request.num_envs is not None and request.num_envs < 1:
        raise ValueError(f"--num-envs {request.num_envs}: at least 1 env is needed, for example --num-envs 64")
    if len(set(request.seeds)) != len(request.seeds):
        raise ConfigError(f"--seeds {','.join(map(str, request.seeds))}: a seed is given twice; its episodes would be the same")
    run_dir = request.run_dir or default_run_dir(request.world)
    refuse_place(run_dir)
    from uuvtai.measure.ceilings import condition_of, remainder_of, scenarios_of
    from uuvtai.measure.evaluate import document, jobs_of
    from uuvtai.sim import Sim

    jobs = jobs_of(request.seeds, request.episodes)
    methods = _methods(request, watch)
    num_envs = request.num_envs or min(len(jobs), _BATCH)
    watch.note(f"starting {num_envs} envs (the first run on a machine compiles its kernels, about a minute)")
    sim = Sim(request.config, num_envs, methods[0].tree if methods else _any_tree(), request.device)
    policies = {method.name: method.driver_for(sim) for method in methods}
    folder = RunFolder(run_dir, request.config, request.seeds)
    played: list[_Played] = []
    entries: list[dict[str, Any]] = []
    try:
        with folder.recorded():
            for method in methods:
                _play(request, sim, method, policies[method.name], jobs, folder, watch, played, entries)
            scenarios = scenarios_of(sim, jobs)
            if ORACLE in request.controllers:
                entries.append(_ask_oracle(request, jobs, scenarios, watch))
            result = document(request.config, request.world, request.sensors, request.seeds, request.episodes, entries)
            result |= {"condition": condition_of(request.config, scenarios), "remainder": remainder_of(entries)}
            _write_results(folder, result, played)
            if request.explain:
                _explain(request, sim, played, result, folder, watch)
            _draw(request, folder.path, [p.logs for p in played if p.logs], watch)
    finally:
        watch.stop()
    return result, folder.path


def _methods(request: Request, watch: Watch) -> list[Method]:
    from uuvtai.measure.methods import differences, policies_of, trees_of

    max_node = request.config.teacher.max_node
    trees = [name for name in request.controllers if name != ORACLE]
    methods = [*trees_of(trees, max_node), *policies_of(list(request.policies), max_node, watch.note)]
    names = [method.name for method in methods] + [ORACLE] * (ORACLE in request.controllers)
    if len(set(names)) != len(names):
        raise ConfigError(f"{', '.join(names)}: a policy and a controller have the same name; rename the run's folder")
    if not methods and (request.record or request.explain):
        raise ConfigError("--record, --explain: the oracle drives no vehicle; add who does, for example --controller bt,oracle")
    for method in methods:
        if told := differences(method, request.config):
            watch.note(f"note: {told}")
    return methods


def _play(
    request: Request,
    sim: Sim,
    method: Method,
    policy: PolicyNote | None,
    jobs: list[Job],
    folder: RunFolder,
    watch: Watch,
    played: list[_Played],
    entries: list[dict[str, Any]],
) -> None:
    """Play one method's episodes and add them to ``played`` and ``entries``."""
    from uuvtai.measure.evaluate import Recorders, run_episodes, summary, tree_use
    from uuvtai.measure.foresight import foresight_of, told

    sim.use_tree(method.tree)
    sim.privileged = method.privileged
    recorder = _recorder(request, folder.path, method.name, jobs, policy)
    foresight = foresight_of(policy.pilot, request.config.episode.control_dt_s) if policy else None
    watch.start(method.name, len(jobs))
    begun = time.perf_counter()
    try:
        results, env_steps = run_episodes(sim, jobs, Recorders([recorder, foresight]), watch.update, policy.pilot if policy else None)
    finally:
        watch.stop()
        if recorder:
            recorder.abort()
    entry = summary(method.name, results, env_steps, time.perf_counter() - begun) | {"privileged": method.privileged}
    entries.append(entry | method.document() | told(foresight))
    played.append(_Played(method, policy, results, tree_use(sim, results), recorder.paths if recorder else {}))


def _any_tree() -> FlatTree:
    """The oracle drives no vehicle, but a simulator wants a tree."""
    from uuvtai.measure.methods import TRAINING_TREE
    from uuvtai.tree import read_tree

    return read_tree(TRAINING_TREE)


def _ask_oracle(request: Request, jobs: list[Job], scenarios: list[dict[str, Any]], watch: Watch) -> dict[str, Any]:
    from uuvtai.measure.ceilings import oracle_entry

    watch.start(ORACLE, len(jobs))
    try:
        return oracle_entry(request.config, jobs, scenarios, watch.update)
    finally:
        watch.stop()


def _write_results(folder: RunFolder, result: dict[str, Any], played: list[_Played]) -> None:
    """The document, and the trees that drove with the use of their nodes."""
    folder.write_json("eval/result.json", result)
    driving = [p for p in played if p.policy is None]
    for p in driving:
        folder.write(f"eval/trees/{p.method.name}.xml", Path(p.method.tree.source).read_text())
    folder.write_json("eval/tree.json", {"schema": 1, "use": {p.method.name: p.use for p in driving}})


def _explain(request: Request, sim: Sim, played: list[_Played], result: dict[str, Any], folder: RunFolder, watch: Watch) -> None:
    """Replay what failed, add the causes to the document, record the worst. What is known is written before the next long step begins."""
    from uuvtai.measure.explain import chosen_for_recording, explain_failures, failures, record_worst, table_of

    explained = {}
    driven = [entry for entry in result["methods"] if entry["name"] != ORACLE]
    for entry, p in zip(driven, played, strict=True):
        label = entry["name"]
        sim.privileged = p.method.privileged
        watch.start(f"{label}: replaying failures", len(failures(p.results)))
        explained[label] = explain_failures(sim, p.method.tree, p.results, watch.update, p.policy.pilot if p.policy else None)
        watch.stop()
        entry["causes"] = table_of(explained[label])
        entry["explain"] = [row.document() for row in explained[label]]
    _write_causes(folder, result)
    for entry, p in zip(driven, played, strict=True):
        label = entry["name"]
        sim.privileged = p.method.privileged
        chosen = chosen_for_recording(explained[label], request.explain_record)
        names = [one["name"] for one in driven]
        paths = record_worst(sim, p.method.tree, chosen, folder.path / "explain", request.world, label, watch.note, p.policy, names)
        for row, path in zip(chosen, paths, strict=True):
            entry["explain"][explained[label].index(row)]["log"] = str(path.relative_to(folder.path))
    _write_causes(folder, result)


def _write_causes(folder: RunFolder, result: dict[str, Any]) -> None:
    folder.write_json("eval/result.json", result)
    methods = [{"name": m["name"], "causes": m["causes"], "explain": m["explain"]} for m in result["methods"] if "explain" in m]
    folder.write_json("eval/explain.json", {"schema": 1, "methods": methods})


def _recorder(request: Request, folder: Path, label: str, jobs: list[Job], policy: PolicyNote | None) -> EpisodeRecorder | None:
    from uuvtai.measure.recording import EpisodeRecorder

    if not request.record:
        return None
    return EpisodeRecorder(folder / "logs", Path(request.world).stem, label, jobs[: request.record], request.depth_images, policy)


def _draw(request: Request, folder: Path, logs: list[dict[Any, Path]], watch: Watch) -> None:
    """One picture per recorded episode with every method's trajectory, and the videos."""
    if not logs:
        return
    from uuvtai.logs.picture import picture
    from uuvtai.logs.video import SMALL, video

    for job in logs[0]:
        end = f"seed{job.seed}_episode{job.episode}"
        files = [paths[job] for paths in reversed(logs)]  # the map drawn is that of the last method
        names = [file.stem.removesuffix(f"_{end}") for file in reversed(files)]
        picture(files, folder / "pictures" / f"{end}.png", methods=names)
        picture(files, folder / "pictures" / f"{end}_clearance.png", clearance=True, methods=names)
        for file in files if request.video else []:
            watch.note(f"drawing {file.stem}.webm")
            video(file, folder / "videos" / f"{file.stem}.webm", methods=names, **SMALL)
