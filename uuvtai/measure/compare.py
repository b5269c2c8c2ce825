"""Compare controllers on paired scenarios in one run folder: results, logs, pictures, videos."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from uuvtai.config import Config
from uuvtai.loader import ConfigError
from uuvtai.run_folder import RunFolder, default_run_dir

_BATCH = 256
"""Episodes played together by default: enough to fill the cores, few enough that the last stragglers cost little."""


@dataclass(frozen=True)
class Request:
    """What ``uuv eval`` was asked for."""

    config: Config
    world: str
    sensors: str
    controllers: list[str]
    seeds: list[int]
    episodes: int
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


def compare(request: Request, watch: Watch) -> tuple[dict[str, Any], Path]:
    """Play every controller's episodes; the ``uuv eval --json`` document and the run folder.

    Everything that can be refused is refused before anything is written. Raises ConfigError, ValueError, MemoryError, RunFolderError.
    """
    from uuvtai.measure.evaluate import EpisodeResult, document, jobs_of, run_episodes, summary, tree_use
    from uuvtai.sim import Sim
    from uuvtai.tree import read_tree

    if request.num_envs is not None and request.num_envs < 1:
        raise ValueError(f"--num-envs {request.num_envs}: at least 1 env is needed, for example --num-envs 64")
    if len(set(request.seeds)) != len(request.seeds):
        raise ConfigError(f"--seeds {','.join(map(str, request.seeds))}: a seed is given twice; its episodes would be the same")
    jobs = jobs_of(request.seeds, request.episodes)
    trees = {_label(name): read_tree(name, request.config.teacher.max_node) for name in request.controllers}
    num_envs = request.num_envs or min(len(jobs), _BATCH)
    watch.note(f"starting {num_envs} envs (the first run on a machine compiles its kernels, about a minute)")
    sim = Sim(request.config, num_envs, next(iter(trees.values())), request.device)
    folder = RunFolder(request.run_dir or default_run_dir(request.world), request.config, request.seeds)
    methods, use, logs = [], {}, []
    played: dict[str, list[EpisodeResult]] = {}
    status, code, recorder = "failed", 1, None
    try:
        for label, tree in trees.items():
            sim.use_tree(tree)
            recorder = _recorder(request, folder.path, label, jobs)
            watch.start(label, len(jobs))
            begun = time.perf_counter()
            results, env_steps = run_episodes(sim, jobs, recorder, watch.update)
            methods.append(summary(label, results, env_steps, time.perf_counter() - begun))
            watch.stop()
            played[label] = results
            use[label] = tree_use(sim, results)
            if recorder:
                logs.append(recorder.paths)
        result = document(request.config, request.world, request.sensors, request.seeds, request.episodes, methods)
        folder.write_json("eval/result.json", result)
        for label, tree in trees.items():
            folder.write(f"eval/trees/{label}.xml", Path(tree.source).read_text())
        folder.write_json("eval/tree.json", {"schema": 1, "use": use})
        if request.explain:
            _explain(request, sim, trees, played, result, folder, watch)
        _draw(request, folder.path, logs, watch)
        status, code = "finished", 0
    except KeyboardInterrupt:
        status, code = "interrupted", 130
        raise
    finally:
        watch.stop()
        if recorder:
            recorder.abort()
        folder.finish(status, code)
    return result, folder.path


def _explain(request: Request, sim: Any, trees: dict, played: dict, result: dict[str, Any], folder: RunFolder, watch: Watch) -> None:
    """Replay what failed, add the causes to the document, record the worst. What is known is written before the next long step begins."""
    from uuvtai.measure.explain import chosen_for_recording, explain_failures, failures, record_worst, table_of

    explained = {}
    for method in result["methods"]:
        label = method["name"]
        watch.start(f"{label}: replaying failures", len(failures(played[label])))
        explained[label] = explain_failures(sim, trees[label], played[label], watch.update)
        watch.stop()
        method["causes"] = table_of(explained[label])
        method["explain"] = [row.document() for row in explained[label]]
    _write_causes(folder, result)
    for method in result["methods"]:
        label = method["name"]
        chosen = chosen_for_recording(explained[label], request.explain_record)
        paths = record_worst(sim, trees[label], chosen, folder.path / "explain", request.world, label, watch.note)
        for row, path in zip(chosen, paths, strict=True):
            method["explain"][explained[label].index(row)]["log"] = str(path.relative_to(folder.path))
    _write_causes(folder, result)


def _write_causes(folder: RunFolder, result: dict[str, Any]) -> None:
    folder.write_json("eval/result.json", result)
    methods = [{"name": m["name"], "causes": m["causes"], "explain": m["explain"]} for m in result["methods"]]
    folder.write_json("eval/explain.json", {"schema": 1, "methods": methods})


def _recorder(request: Request, folder: Path, label: str, jobs: list) -> Any:
    from uuvtai.measure.recording import EpisodeRecorder

    if not request.record:
        return None
    return EpisodeRecorder(folder / "logs", Path(request.world).stem, label, jobs[: request.record], request.depth_images)


def _label(name: str) -> str:
    return Path(name).stem if name.endswith(".xml") else name


def _draw(request: Request, folder: Path, logs: list[dict[Any, Path]], watch: Watch) -> None:
    """One picture per recorded episode with every method's trajectory, and the videos."""
    if not logs:
        return
    from uuvtai.logs.picture import picture
    from uuvtai.logs.video import video

    for job in logs[0]:
        files = [paths[job] for paths in reversed(logs)]  # the map drawn is that of the last method
        picture(files, folder / "pictures" / f"seed{job.seed}_episode{job.episode}.png")
        picture(files, folder / "pictures" / f"seed{job.seed}_episode{job.episode}_clearance.png", clearance=True)
        for file in files if request.video else []:
            watch.note(f"drawing {file.stem}.webm")
            video(file, folder / "videos" / f"{file.stem}.webm")
