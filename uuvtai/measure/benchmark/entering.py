"""``uuv benchmark NAME``: one pilot plays the scenes, and what came of it becomes a file that others can
check."""

from __future__ import annotations

import json
import re
import shlex
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from uuvtai.measure.benchmark.benchmark_scenes import (
    COLUMNS,
    EPISODES,
    SEED,
    TRIAL_EPISODES,
    TRIAL_SEED,
    VERSION,
    BenchmarkScene,
    scenes_of,
)
from uuvtai.measure.benchmark.entrant import Entrant, sha256_of_method
from uuvtai.measure.benchmark.fingerprints import condition_sha256, sealed, sources_sha256
from uuvtai.outcomes import ENDINGS
from uuvtai.run_folder import (
    RunFolderError,
    default_run_dir,
    git_sha,
    hardware,
    refuse_place,
    versions,
    write_atomic,
)
from uuvtai.version import __version__

if TYPE_CHECKING:
    from uuvtai.measure.evaluate.method_run import EvaluationWatch

FILE = "entry.json"
BATCH = 64
"""episodes played together: a size whose kernels other commands compile too"""
_DIGITS = 6
_ROW = re.compile(r"\[\n\s+([^\[\]{}]*?)\n\s+\]")


@dataclass(frozen=True)
class BenchmarkRequest:
    """What ``uuv benchmark NAME`` was asked for."""

    name: str
    entrant: Entrant
    quick: bool = False
    num_envs: int | None = None
    device: str = "auto"
    run_dir: Path | None = None


def enter(asked: BenchmarkRequest, watch: EvaluationWatch) -> tuple[dict[str, Any], Path]:
    """Play; the entry, and the folder where it lies as ``FILE`` beside a run folder for each scene.

    The file is written anew after each scene, so that an interrupt leaves an entry of those that are over.
    Everything that can be refused is refused before anything is written. Raises UserError.
    """
    scenes = scenes_of(asked.name)
    method = asked.entrant.method(scenes[0].config(), watch)
    asked.entrant.files()
    refuse_place(asked.run_dir)
    folder = asked.run_dir or default_run_dir(f"benchmark_{asked.name}")
    pilot = {"name": method.name, "typed": asked.entrant.typed, "is_shipped": asked.entrant.is_shipped}
    pilot["sha256"] = sha256_of_method(method)
    code = {"version": __version__, "sha256": sources_sha256(), "commit": git_sha()}
    played, entry = [], {}
    for bench in scenes:
        played.append(_played(bench, asked, folder, watch))
        entry = _entry(asked, pilot | {"files": asked.entrant.files()}, code, played)
        _write(folder / FILE, entry)
    return entry, folder


def _played(
    bench: BenchmarkScene, asked: BenchmarkRequest, folder: Path, watch: EvaluationWatch
) -> dict[str, Any]:
    """One scene of the entry."""
    from uuvtai.measure.evaluate.compare import compare
    from uuvtai.measure.evaluate.eval_request import Request

    seed, episodes = (TRIAL_SEED, TRIAL_EPISODES) if asked.quick else (SEED, EPISODES)
    who = asked.entrant.asked()
    request = Request.typed(
        bench.options(), who["policies"], controllers=who["controllers"], seeds=[seed],
        episodes=episodes, num_envs=asked.num_envs or BATCH, device=asked.device,
        run_dir=folder / bench.name,
    )  # fmt: skip
    watch.note(f"{bench.name}: {bench.about}")
    result, _ = compare(request, watch)
    (method,) = result["methods"]
    rows = [[detail[name] for name in COLUMNS] for detail in method["episodes_detail"]]
    return {
        "name": bench.name,
        "config_sha256": condition_sha256(bench.config()),
        "scenarios_sha256": result["scenarios_sha256"],
        "seed": seed,
        "outcomes": {name: method["outcomes"][name] for name in ENDINGS},
        "episodes": [[_rounded(value) for value in row] for row in rows],
    }


def _rounded(value: Any) -> Any:
    return round(value, _DIGITS) if isinstance(value, float) else value


def _entry(
    asked: BenchmarkRequest, pilot: dict[str, Any], code: dict[str, Any], played: list[dict[str, Any]]
) -> dict[str, Any]:
    machine = hardware()
    found = {
        "schema": 1,
        "benchmark": asked.name,
        "benchmark_version": VERSION,
        "is_entry": not asked.quick,
        "pilot": pilot,
        "code": code,
        "versions": versions(),
        "machine": f"{machine['cpu']}, {machine['cores']} cores, {machine['system']}",
        "command": shlex.join(["uuv", *sys.argv[1:]]),
        "played": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "columns": list(COLUMNS),
        "scenes": [dict(scene) for scene in played],
    }
    return sealed(found)


def _write(path: Path, entry: dict[str, Any]) -> None:
    text = _ROW.sub(lambda row: "[" + " ".join(row[1].split()) + "]", json.dumps(entry, indent=1))
    try:
        write_atomic(path, (text + "\n").encode())
    except OSError as error:
        raise RunFolderError(
            f"{path}: cannot be written ({error.strerror}); give a folder that can be: --run-dir DIR"
        ) from None
