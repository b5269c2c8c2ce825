"""Compare controllers and trained policies on paired scenarios in one run folder: results, logs, pictures,
videos."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from uuvtai.errors import SettingError
from uuvtai.loader import ConfigError
from uuvtai.measure.evaluate.eval_request import FILE as REQUEST
from uuvtai.measure.evaluate.eval_request import (
    ORACLE,
    Request,
    document_of,
    drivers_of,
    read_request,
    refuse_others,
)
from uuvtai.run_folder import RunFolder, default_run_dir, refuse_place

if TYPE_CHECKING:
    from uuvtai.measure.episodes.methods import Method
    from uuvtai.measure.episodes.playing import EpisodeResult, Job
    from uuvtai.measure.evaluate.foresight import Foresight, RiskMoments
    from uuvtai.measure.evaluate.ledger import Finished, Ledger
    from uuvtai.measure.log_recorder import EpisodeRecorder, PolicyNote
    from uuvtai.sim import Sim
    from uuvtai.tree import FlatTree

    Simulators = dict[str | None, Sim]
    """by the stack that drives; None = the request's own"""

_BATCH = 256
"""Episodes played together by default: enough to fill the cores, few enough that the last stragglers cost
little."""

_STARTING = "starting {} envs (sizes not used before compile their kernels first, about half a minute)"


class EvaluationWatch(Protocol):
    """Shows how far a comparison is."""

    def start(self, name: str, total: int) -> None: ...
    def note(self, text: str) -> None: ...
    def update(self, done: int, total: int, env_steps: int, left: int | None = None) -> None: ...
    def stop(self) -> None: ...


@dataclass
class _Played:
    """What a method has done."""

    method: Method
    policy: PolicyNote | None
    results: list[EpisodeResult]
    use: list[dict[str, Any]]
    logs: dict[Job, Path]


def compare(request: Request, watch: EvaluationWatch) -> tuple[dict[str, Any], Path]:
    """Play every method's episodes; the ``uuv eval --json`` document and the run folder.

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
    methods = _methods(request, watch)
    num_envs = request.num_envs or min(len(request.seeds) * request.episodes, _BATCH)
    watch.note(_STARTING.format(num_envs))
    sims = _simulators(request, num_envs, methods)
    policies = {method.name: method.driver_for(sims[method.stack]) for method in methods}
    folder = RunFolder(request.run_dir or default_run_dir(request.world), request.config, request.seeds)
    with _going_on(folder, watch):
        folder.write_json(
            REQUEST, document_of(request, num_envs, _any_of(sims).device.type, drivers_of(methods))
        )
        return _compared(request, sims, methods, policies, folder, watch), folder.path


def resume(place: Path, watch: EvaluationWatch) -> tuple[dict[str, Any], Path]:
    """Go on with an evaluation that was interrupted or killed: episodes that are over stay as they are.

    The document is that of an undisturbed evaluation, times of the machine excepted. Raises RunFolderError,
    FileError, ConfigError, CheckpointError.
    """
    folder = RunFolder.held(place, "uuv eval")
    try:
        request, drivers = read_request(place)
        methods = _methods(request, watch)
        refuse_others(place, drivers, drivers_of(methods))
        folder.go_on({"what": "eval"})
    except BaseException:
        folder.release()
        raise
    with _going_on(folder, watch):
        watch.note(_STARTING.format(request.num_envs))
        assert request.num_envs is not None  # the file states it
        sims = _simulators(request, request.num_envs, methods)
        policies = {method.name: method.driver_for(sims[method.stack]) for method in methods}
        return _compared(request, sims, methods, policies, folder, watch), place


@contextmanager
def _going_on(folder: RunFolder, watch: EvaluationWatch) -> Iterator[None]:
    """Record how the work inside ends, and say how to go on where it was interrupted."""
    try:
        with folder.recorded():
            yield
    except KeyboardInterrupt:
        watch.stop()
        watch.note(f"finished episodes are kept; go on with: uuv eval --resume {folder.path}")
        if any((folder.path / "logs").glob("*.part")):
            watch.note(
                f"{folder.path / 'logs'}: .part files end where it was interrupted; --resume records them "
                "anew, or: uuv log repair"
            )
        raise
    finally:
        watch.stop()


def _simulators(request: Request, num_envs: int, methods: list[Method]) -> Simulators:
    """A simulator for the request's own config and one for every stack that drives a row; the episodes are
    the same in all."""
    from uuvtai.sim import Sim

    configs = {method.stack: method.config_of(request.config) for method in methods} or {None: request.config}
    tree = methods[0].tree if methods else _any_tree()
    return {stack: Sim(config, num_envs, tree, request.device) for stack, config in configs.items()}


def _any_of(sims: Simulators) -> Sim:
    """For what is the same in all of them."""
    return next(iter(sims.values()))


def _compared(
    request: Request,
    sims: Simulators,
    methods: list[Method],
    policies: dict[str, PolicyNote | None],
    folder: RunFolder,
    watch: EvaluationWatch,
) -> dict[str, Any]:
    """Play what is not over yet; the whole document, and all that is written and drawn of it."""
    from uuvtai.measure.episodes.playing import jobs_of
    from uuvtai.measure.evaluate.ceilings import condition_of, remainder_of, scenarios_of
    from uuvtai.measure.evaluate.ledger import Ledger
    from uuvtai.measure.evaluate.summary import document

    jobs = jobs_of(request.seeds, request.episodes)
    played: list[_Played] = []
    entries: list[dict[str, Any]] = []
    ledger = Ledger(folder.path)
    try:
        for method in methods:
            _play(
                request,
                sims[method.stack],
                method,
                policies[method.name],
                jobs,
                folder,
                ledger,
                watch,
                played,
                entries,
            )
    finally:
        ledger.close()
    scenarios = scenarios_of(_any_of(sims), jobs)
    if ORACLE in request.controllers:
        entries.append(_ask_oracle(request, jobs, scenarios, watch))
    result = document(
        request.config, request.world, request.sensors, request.seeds, request.episodes, entries
    )
    result |= {"condition": condition_of(request.config, scenarios), "remainder": remainder_of(entries)}
    _write_results(folder, result, played)
    if request.explain:
        _explain(request, sims, played, result, folder, watch)
    _draw(request, folder.path, [p.logs for p in played if p.logs], watch)
    return result


def _methods(request: Request, watch: EvaluationWatch) -> list[Method]:
    from uuvtai.measure.episodes.methods import differences, policies_of, trees_of

    max_node = request.config.teacher.max_node
    trees = [name for name in request.controllers if name != ORACLE]
    methods = [*trees_of(trees, max_node), *policies_of(list(request.policies), max_node, watch.note)]
    names = [method.name for method in methods] + [ORACLE] * (ORACLE in request.controllers)
    if len(set(names)) != len(names):
        raise ConfigError(
            f"{', '.join(names)}: a policy and a controller have the same name; rename the run's folder"
        )
    if not methods and (request.record or request.explain):
        raise ConfigError(
            "--record, --explain: the oracle drives no vehicle; add who does, for example --controller "
            "bt,oracle"
        )
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
    ledger: Ledger,
    watch: EvaluationWatch,
    played: list[_Played],
    entries: list[dict[str, Any]],
) -> None:
    """Play one method's episodes, as far as they are not over, and add them to ``played`` and ``entries``."""
    from uuvtai.measure.episodes.playing import Recorders, run_episodes
    from uuvtai.measure.episodes.stopwatch import StepClock
    from uuvtai.measure.evaluate.foresight import foresight_of, told
    from uuvtai.measure.evaluate.ledger import Keeper
    from uuvtai.measure.evaluate.summary import summary, tree_use

    sim.use_tree(method.tree)
    sim.privileged = method.privileged
    recorder = _recorder(request, folder.path, method.name, jobs, policy)
    foresight = foresight_of(policy.pilot, request.config.episode.control_dt_s) if policy else None
    logs = recorder.paths if recorder else {}
    over = ledger.finished(method.name)
    left = [job for job in jobs if job not in over or (job in logs and not logs[job].exists())]
    before = len(jobs) - len(left)
    watch.start(method.name, len(jobs))
    keeper, clock = Keeper(ledger, method.name, foresight), StepClock()
    try:
        run_episodes(
            sim,
            left,
            Recorders([recorder, foresight, keeper]),
            lambda done, _total, env_steps, to_come: watch.update(
                before + done, len(jobs), env_steps, to_come
            ),
            policy.pilot if policy else None,
            clock,
        )
    finally:
        watch.stop()
        if recorder:
            recorder.abort()
    results = [over[job].result for job in jobs]
    dt = request.config.episode.control_dt_s
    env_steps, wall_s = sum(round(r.time_s / dt) for r in results), keeper.wall_s if left else keeper.before_s
    entry = summary(method.name, results, env_steps, wall_s, clock.env_steps_per_s)
    entry |= (
        {"privileged": method.privileged}
        | method.document()
        | told(foresight, _moments(foresight, [over[job] for job in jobs], dt))
    )
    entries.append(entry)
    played.append(_Played(method, policy, results, tree_use(sim, results), logs))


def _moments(foresight: Foresight | None, finished: list[Finished], dt: float) -> RiskMoments | None:
    """What the risk head said along the episodes, in their order, whoever has played them."""
    from uuvtai.measure.evaluate.foresight import joined, moments_of

    if foresight is None:
        return None
    rows = [(f.said or [], round(f.result.time_s / dt), f.result.outcome) for f in finished]
    return joined([moments_of(*row, foresight.horizon_steps, number) for number, row in enumerate(rows)])


def _any_tree() -> FlatTree:
    """The oracle drives no vehicle, but a simulator wants a tree."""
    from uuvtai.shipped import TRAINING_TREE
    from uuvtai.tree import read_tree

    return read_tree(TRAINING_TREE)


def _ask_oracle(
    request: Request, jobs: list[Job], scenarios: list[dict[str, Any]], watch: EvaluationWatch
) -> dict[str, Any]:
    from uuvtai.measure.evaluate.ceilings import oracle_entry

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
        folder.write_bytes(f"eval/trees/{p.method.name}.xml", p.method.tree.xml)
    folder.write_json("eval/tree.json", {"schema": 1, "use": {p.method.name: p.use for p in driving}})


def _explain(
    request: Request,
    sims: Simulators,
    played: list[_Played],
    result: dict[str, Any],
    folder: RunFolder,
    watch: EvaluationWatch,
) -> None:
    """Replay what failed, add the causes to the document, record the worst. What is known is written before
    the next long step begins."""
    from uuvtai.measure.explain.failures import (
        chosen_for_recording,
        explain_failures,
        failures,
        record_worst,
        table_of,
    )

    explained = {}
    driven = [entry for entry in result["methods"] if entry["name"] != ORACLE]
    for entry, p in zip(driven, played, strict=True):
        label, sim = entry["name"], sims[p.method.stack]
        sim.privileged = p.method.privileged
        watch.start(f"{label}: replaying failures", len(failures(p.results)))
        explained[label] = explain_failures(
            sim, p.method.tree, p.results, watch.update, p.policy.pilot if p.policy else None
        )
        watch.stop()
        entry["causes"] = table_of(explained[label])
        entry["explain"] = [row.document() for row in explained[label]]
    _write_causes(folder, result)
    for entry, p in zip(driven, played, strict=True):
        label, sim = entry["name"], sims[p.method.stack]
        sim.privileged = p.method.privileged
        chosen = chosen_for_recording(explained[label], request.explain_record)
        names = [one["name"] for one in driven]
        paths = record_worst(
            sim,
            p.method.tree,
            chosen,
            folder.path / "explain",
            request.world,
            label,
            watch.note,
            p.policy,
            names,
        )
        for row, path in zip(chosen, paths, strict=True):
            entry["explain"][explained[label].index(row)]["log"] = str(path.relative_to(folder.path))
    _write_causes(folder, result)


def _write_causes(folder: RunFolder, result: dict[str, Any]) -> None:
    folder.write_json("eval/result.json", result)
    methods = [
        {"name": m["name"], "causes": m["causes"], "explain": m["explain"]}
        for m in result["methods"]
        if "explain" in m
    ]
    folder.write_json("eval/explain.json", {"schema": 1, "methods": methods})


def _recorder(
    request: Request, folder: Path, label: str, jobs: list[Job], policy: PolicyNote | None
) -> EpisodeRecorder | None:
    from uuvtai.measure.log_recorder import EpisodeRecorder

    if not request.record:
        return None
    return EpisodeRecorder(
        folder / "logs", Path(request.world).stem, label, jobs[: request.record], request.depth_images, policy
    )


def _draw(request: Request, folder: Path, logs: list[dict[Any, Path]], watch: EvaluationWatch) -> None:
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
            target = folder / "videos" / f"{file.stem}.webm"
            if not target.exists():  # an evaluation that goes on may have drawn it before
                watch.note(f"drawing {target.name}")
                video(file, target, methods=names, **SMALL)
