"""Compare controllers and trained policies on paired scenarios in one run folder: results, logs, pictures,
videos."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
from uuvtai.own.piece_spec import refuse_code
from uuvtai.run_folder import RunFolder, default_run_dir, refuse_place

if TYPE_CHECKING:
    from uuvtai.measure.episodes.methods import Method
    from uuvtai.measure.episodes.playing import Job
    from uuvtai.measure.evaluate.method_run import Comparison, EvaluationWatch, MethodRun
    from uuvtai.tree import FlatTree

_BATCH = 256
"""Episodes played together by default: enough to fill the cores, few enough that the last stragglers cost
little."""


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
    methods = methods_of(request, watch)
    num_envs = request.num_envs or min(len(request.seeds) * request.episodes, _BATCH)
    comparison = comparison_of(request, num_envs, methods, watch)
    folder = RunFolder(request.run_dir or default_run_dir(request.world), request.config, request.seeds)
    with _going_on(folder, watch):
        device = comparison.any_simulator().device.type
        folder.write_json(REQUEST, document_of(request, num_envs, device, drivers_of(methods)))
        return _compared(comparison, folder), folder.path


def resume(place: Path, watch: EvaluationWatch, allow_code: bool = False) -> tuple[dict[str, Any], Path]:
    """Go on with an evaluation that was interrupted or killed: episodes that are over stay as they are.
    ``allow_code``: Python files that the folder names may be run.

    The document is that of an undisturbed evaluation, times of the machine excepted. Raises RunFolderError,
    FileError, ConfigError, CheckpointError.
    """
    folder = RunFolder.held(place, "uuv eval")
    try:
        request, drivers = read_request(place)
        refuse_code(place, request.controllers, allow_code)
        methods = methods_of(request, watch)
        refuse_others(place, drivers, drivers_of(methods))
        folder.go_on({"what": "eval"})
    except BaseException:
        folder.release()
        raise
    with _going_on(folder, watch):
        assert request.num_envs is not None  # the file states it
        return _compared(comparison_of(request, request.num_envs, methods, watch), folder), place


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


def methods_of(request: Request, watch: EvaluationWatch) -> list[Method]:
    """Who plays. Raises ConfigError, CheckpointError, PieceError."""
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
        if changes := differences(method, request.config):
            watch.note(f"note: {changes}")
    return methods


def comparison_of(
    request: Request, num_envs: int, methods: list[Method], watch: EvaluationWatch
) -> Comparison:
    """A simulator for the request's own config and one for every stack that drives a row: the episodes are
    the same in all. And the policies, ready for them."""
    from uuvtai.measure.evaluate.method_run import Comparison
    from uuvtai.sim import Sim

    watch.note(
        f"starting {num_envs} envs (sizes not used before compile their kernels first, about half a minute)"
    )
    configs = {method.stack: method.config_of(request.config) for method in methods} or {None: request.config}
    tree = methods[0].tree if methods else _any_tree()
    sims = {stack: Sim(config, num_envs, tree, request.device) for stack, config in configs.items()}
    for method in methods:
        if method.own:
            method.own.note = watch.note
    policies = {method.name: method.driver_for(sims[method.stack]) for method in methods}
    planners = {method.name: method.planner_for(sims[method.stack]) for method in methods}
    return Comparison(request, methods, sims, policies, planners, watch)


def _any_tree() -> FlatTree:
    """The oracle drives no vehicle, but a simulator wants a tree."""
    from uuvtai.shipped import TRAINING_TREE
    from uuvtai.tree import read_tree

    return read_tree(TRAINING_TREE)


def _compared(comparison: Comparison, folder: RunFolder) -> dict[str, Any]:
    """Play what is not over yet; the whole document, and all that is written and drawn of it."""
    from uuvtai.measure.episodes.playing import jobs_of
    from uuvtai.measure.evaluate.ceilings import remainder_of, scenarios_of
    from uuvtai.measure.evaluate.explained import explain
    from uuvtai.measure.evaluate.ledger import Ledger
    from uuvtai.measure.evaluate.method_run import play
    from uuvtai.measure.evaluate.summary import document

    request = comparison.request
    jobs = jobs_of(request.seeds, request.episodes)
    ledger = Ledger(folder.path)
    try:
        runs = [play(comparison, method, jobs, ledger, folder.path) for method in comparison.methods]
    finally:
        ledger.close()
    entries = [method_run.entry for method_run in runs]
    scenarios = scenarios_of(comparison.any_simulator(), jobs)
    if ORACLE in request.controllers:
        entries.append(_ask_oracle(comparison, jobs, scenarios))
    named = request.world, request.sensors, request.vehicle
    result = document(request.config, *named, request.seeds, request.episodes, entries)
    result |= {"remainder": remainder_of(entries), "scenarios_sha256": scenarios_sha256(scenarios)}
    _write_results(folder, result, runs)
    if request.explain:
        explain(comparison, runs, result, folder)
    _draw(comparison, folder.path, [method_run.logs for method_run in runs if method_run.logs])
    return result


def _ask_oracle(comparison: Comparison, jobs: list[Job], scenarios: list[dict[str, Any]]) -> dict[str, Any]:
    from uuvtai.measure.evaluate.ceilings import oracle_entry

    comparison.watch.start(ORACLE, len(jobs))
    try:
        return oracle_entry(comparison.request.config, jobs, scenarios, comparison.watch.update)
    finally:
        comparison.watch.stop()


def _write_results(folder: RunFolder, result: dict[str, Any], runs: list[MethodRun]) -> None:
    """The document, and the trees that drove with the use of their nodes."""
    folder.write_json("eval/result.json", result)
    driving = [method_run for method_run in runs if method_run.policy is None]
    for method_run in driving:
        method = method_run.method
        folder.write_bytes(f"eval/trees/{method.name}.xml", method.tree.xml)
    use = {method_run.method.name: method_run.use for method_run in driving}
    folder.write_json("eval/tree.json", {"schema": 1, "use": use})


def _draw(comparison: Comparison, folder: Path, logs: list[dict[Job, Path]]) -> None:
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
        for file in files if comparison.request.video else []:
            target = folder / "videos" / f"{file.stem}.webm"
            if not target.exists():  # an evaluation that goes on may have drawn it before
                comparison.watch.note(f"drawing {target.name}")
                video(file, target, methods=names, **SMALL)


_DIGITS = 3
"""of a number: millimetres"""


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
