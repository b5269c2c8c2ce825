"""Runs the steps of a reproduction, gathers what they found, judges the claims and writes it all down."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

from uuvtai.errors import SettingError
from uuvtai.files import FileError, read_json
from uuvtai.loader import load_config
from uuvtai.measure.episodes.methods import trees_of
from uuvtai.measure.reproduce import claims, paper
from uuvtai.measure.reproduce.markdown import results_page
from uuvtai.measure.reproduce.sections import sections_of
from uuvtai.measure.reproduce.steps import (
    BUDGETS,
    EVALUATION_SEED,
    TRAINED,
    Budget,
    Step,
    is_done,
    result_file,
    run_step,
    steps_of,
)
from uuvtai.outcomes import LETTERS
from uuvtai.own.piece_spec import is_piece, piece_spec, refuse_code
from uuvtai.report.build import report
from uuvtai.run_folder import RunFolder, RunFolderError, default_run_dir, refuse_place

REQUEST, RESULT, PAGE = "reproduce_request.json", "reproduce.json", "results.md"


class ReproductionWatch(Protocol):
    """Shows how far it is."""

    def note(self, text: str) -> None: ...


def reproduce(
    budget: str, run_dir: Path | None, watch: ReproductionWatch, own: Sequence[str] = ()
) -> tuple[dict[str, Any], Path]:
    """Begin a reproduction: its document and its folder. ``own``: pieces of the user's, compared with ours.
    Raises ValueError for an unknown budget, RunFolderError, PieceError."""
    if budget not in BUDGETS:
        raise SettingError(f"--budget {budget!r}: {' or '.join(BUDGETS)}")
    refuse_place(run_dir)
    config, pieces = load_config("pool"), [piece_spec(name).absolute().text for name in own]
    trees_of(pieces, config.teacher.max_node)  # refuses what cannot be loaded before hours have passed
    root = (run_dir or default_run_dir(f"reproduce-{budget}")).absolute()
    folder = RunFolder(root, config, [EVALUATION_SEED])
    request: dict[str, Any] = {"schema": 1, "budget": budget, "own": pieces}
    folder.write_json(REQUEST, request)
    return _run(folder, request, watch), root


def resume(place: Path, watch: ReproductionWatch, allow_code: bool = False) -> tuple[dict[str, Any], Path]:
    """Go on with a reproduction that was killed or interrupted; finished steps stay as they are.
    ``allow_code``: Python files that the folder names may be run. Raises RunFolderError."""
    root = place.absolute()
    folder = RunFolder.held(root, "uuv reproduce")
    try:
        request = _request(root)
        refuse_code(root, request["own"], allow_code)
        folder.go_on({})
        return _run(folder, request, watch), root
    finally:
        folder.release()


def _request(root: Path) -> dict[str, Any]:
    """What a reproduction that was begun had been asked for. Raises RunFolderError."""
    file = root / REQUEST
    try:
        request = read_json(file, folder=root)
        known = request["budget"] in BUDGETS
        known = known and all(isinstance(name, str) and is_piece(name) for name in request.get("own", []))
    except (FileError, OSError, KeyError, TypeError) as error:
        raise RunFolderError(
            f"{file}: cannot be read ({error}); give the folder that 'uuv reproduce' printed"
        ) from None
    if not known:
        raise RunFolderError(f"{file}: no budget of this version; begin a new reproduction")
    return {"own": []} | request


def _run(folder: RunFolder, request: dict[str, Any], watch: ReproductionWatch) -> dict[str, Any]:
    steps = steps_of(BUDGETS[request["budget"]], folder.path, request["own"])
    try:
        with folder.recorded():
            for number, step in enumerate(steps, start=1):
                _step(step, f"{number}/{len(steps)} {step.name}", folder, watch)
            document = document_of(folder.path, request, steps)
            folder.write_json(RESULT, document)
            folder.write(PAGE, results_page(document))
    except KeyboardInterrupt:
        watch.note(f"what is finished is kept; go on with: uuv reproduce --resume {folder.path}")
        raise
    watch.note(f"report: {report([folder.path]).page}")  # the page tells how the run ended
    return document


def _step(step: Step, name: str, folder: RunFolder, watch: ReproductionWatch) -> None:
    if is_done(step, folder.path) and result_file(step, folder.path).exists():
        watch.note(f"{name}: done before")
        return
    watch.note(f"{name}: uuv {' '.join(step.argv(folder.path))}")
    began = time.perf_counter()
    run_step(step, folder.path)
    watch.note(f"{name}: {time.perf_counter() - began:.0f} s")


# -------------------------------------------------------------------------------------------------- gathering


def document_of(root: Path, request: dict[str, Any], steps: Sequence[Step]) -> dict[str, Any]:
    """The ``uuv reproduce --json`` document: results of every step by its folder, and the verdicts."""
    results = {step.folder: read_json(result_file(step, root), folder=root) for step in steps}
    record = read_json(root / "run.json", folder=root)
    budget = BUDGETS[request["budget"]]
    own = [piece_spec(name).label for name in request["own"]]
    by_preset = _by_preset(results["eval/main"], budget, own)
    document = {
        "schema": 1,
        "title": f"The paper reproduced, budget {request['budget']}",
        "budget": request["budget"],
        "seed": EVALUATION_SEED,
        "started": record["started"],
        "git_sha": record["git_sha"],
        "hardware": record["hardware"],
        "versions": record["versions"],
        "python": sys.version.split()[0],
        "commands": {
            step.folder: "uuv " + " ".join(_shown(part, root) for part in step.argv(root)) for step in steps
        },
        "table_main": by_preset,
        "claims": [vars(claim) for claim in _claims(root, results, by_preset, own)],
        "inconsistencies": list(paper.INCONSISTENCIES),
        "ceilings": results["eval/ceilings"],
        "transfer": results["eval/transfer"],
        "sweeps": {
            folder.removeprefix("sweep/"): found
            for folder, found in results.items()
            if folder.startswith("sweep/")
        },
        "profile": results["profile"],
    }
    return document | {"sections": sections_of(document, budget)}


def _shown(part: str, root: Path) -> str:
    """An argument without the machine's paths."""
    return part.replace(str(root), "RUN")


def _by_preset(main: dict[str, Any], budget: Budget, own: Sequence[str]) -> dict[str, list[dict[str, Any]]]:
    """Entries of the methods' table by preset; of their single episodes how each ended."""
    entries = {
        entry["name"]: {k: v for k, v in entry.items() if k != "episodes_detail"}
        | {"ends": "".join(LETTERS[e["outcome"]] for e in entry["episodes_detail"])}
        for entry in main["methods"]
    }
    trained = {
        preset: [entries[f"{preset}-{seed}"] for seed in range(budget.training_seeds)] for preset in TRAINED
    }
    return trained | {name: [entries[name]] for name in ("bt", "planner", "straight", *own)}


def _claims(
    root: Path,
    results: dict[str, Any],
    by_preset: dict[str, Any],
    own: Sequence[str],
) -> list[claims.Claim]:
    cells = results["sweep/pool"]["cells"]
    names = list(dict.fromkeys(cell["method"] for cell in cells))
    pilot = next(name for name in names if name not in ("bt", *own))
    there = next(entry for entry in results["eval/transfer"]["methods"] if entry["name"] not in ("bt", *own))
    found = [
        *claims.of_table_main(by_preset),
        *claims.of_training(_metrics(root / "train" / "curriculum-0")),
        *(claim for name in (pilot, "bt") for claim in claims.of_sweep(cells, name)),
        *claims.of_timing(results["profile"]),
        *(claims.of_transfer(by_preset["curriculum"][0], there)),
    ]
    return claims.judged(found)


def _metrics(run: Path) -> list[dict[str, Any]]:
    from uuvtai.learn.recorder import read_metrics

    return read_metrics(run)
