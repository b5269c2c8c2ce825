"""``uuv export``: a policy as a folder that drives without uuvtai, and the check of such a folder."""

from __future__ import annotations

import functools
import hashlib
import json
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
import safetensors.torch

from uuvtai.common.errors import UserError
from uuvtai.common.files import refusing, unfinished, whole_folder
from uuvtai.config.loader import ConfigError
from uuvtai.learning.checkpoint import Checkpoint, Note
from uuvtai.learning.export import graph as onnx_session
from uuvtai.learning.export import modules, run_policy
from uuvtai.learning.export.card import evaluations_of, model_card
from uuvtai.learning.export.graph import GraphError, missing_packages, refuse_strange
from uuvtai.learning.export.modules import ONNX
from uuvtai.learning.export.run_policy import FILES, GOLDEN, SPEC, WEIGHTS, Arrays, PolicyError
from uuvtai.logs.container import sync_folder
from uuvtai.logs.run_folder import RunFolderError, write_atomic

EXTRA = "uuvtai[export]"  # extra that brings ONNX


class ExportError(UserError, PolicyError):
    """A ``run_policy.PolicyError``, whose module knows nothing of this package."""


def export(
    checkpoint: Checkpoint, name: str, out: Path, evaluations: Iterable[Path], note: Note, force: bool = False
) -> dict[str, Any]:
    """Write the policy of a checkpoint into a new folder ``out``; ``force`` replaces an exported policy.
    Returns what ``uuv export --json`` prints. Raises ConfigError for a place that is taken, CheckpointError
    for networks that cannot drive, RunFolderError where the disk refuses."""
    _refuse_place(out, force)
    module, rows = modules.module_of(checkpoint), evaluations_of(checkpoint, evaluations)
    golden, missing = modules.golden_of(module), missing_packages()
    weights = safetensors.torch.save(modules.weights_of(module))
    files = {WEIGHTS: weights, GOLDEN: safetensors.numpy.save(golden)}
    if missing:
        told = f"{', '.join(missing)} not installed; pip install '{EXTRA}', then export again"
        note(f"left out {ONNX}: {told}")
    else:
        files[ONNX] = modules.onnx_bytes(module)
    spec = modules.specification(checkpoint, module, name, ONNX in files)
    files["README.md"] = model_card(spec, checkpoint, rows).encode()
    files["run_policy.py"] = Path(run_policy.__file__).read_bytes()
    _publish(out, files, spec)
    return _document(out, [of_torch(module, golden), *_replayed(out, run_policy.read_spec(out), note)])


def check(folder: Path, note: Note) -> dict[str, Any]:
    """Verify the sha256 of every file of an exported policy and replay its golden pairs; nothing in it is
    executed. Returns what ``uuv export --json`` prints. Raises ExportError for what is none."""
    try:
        spec = run_policy.read_spec(folder)
        damages = run_policy.changed_files(folder, spec)
        return _document(folder, [] if damages else _replayed(folder, spec, note), damages)
    except PolicyError as error:
        raise ExportError(str(error)) from None


def _document(folder: Path, engines: list[dict[str, Any]], damages: Sequence[str] = ()) -> dict[str, Any]:
    agrees = not damages and all(engine["agrees"] for engine in engines)
    return {"schema": 1, "folder": str(folder), "agrees": agrees, "damages": [*damages], "engines": engines}


def _replayed(folder: Path, spec: dict[str, Any], note: Note) -> list[dict[str, Any]]:
    golden = run_policy.read_safetensors(folder / GOLDEN)
    policy = run_policy.made(spec, run_policy.read_safetensors(folder / WEIGHTS))
    found = [run_policy.of_numpy(policy, golden)]
    if ONNX in spec["files"] and onnx_session.is_installed():
        found.append(of_onnx(run_policy.content_of(folder / ONNX), golden, policy.inputs))
    elif ONNX in spec["files"]:
        note(f"{ONNX} was not replayed: {onnx_session.NAME} is not installed; pip install '{EXTRA}'")
    return found


def of_torch(module: modules.ExportedModule, golden: Arrays) -> dict[str, Any]:
    """As ``run_policy.compared``."""
    said, rows = functools.partial(modules.said, module), run_policy.golden_rows(golden, module.inputs)
    return run_policy.compared("torch", said, rows, golden)


def of_onnx(graph: bytes, golden: Arrays, inputs: Iterable[str]) -> dict[str, Any]:
    """ONNX Runtime against the golden pairs. Raises GraphError for a graph that is not ours."""
    rows = run_policy.golden_rows(golden, inputs)
    refuse_strange(graph, {name: array.shape for name, array in rows.items()}, run_policy.CALLS)
    try:
        session = onnx_session.session(graph)
        names = [output.name for output in session.get_outputs()]

        def said(given: Arrays) -> Arrays:
            return dict(zip(names, map(np.asarray, session.run(names, given)), strict=True))

        return run_policy.compared("ONNX Runtime", said, rows, golden, at_once=run_policy.MAX_ROWS)
    except Exception as error:  # its own errors share no base class beyond this
        raise GraphError(f"ONNX Runtime cannot use it ({error})") from None


def _refuse_place(out: Path, force: bool) -> None:
    """Raise ConfigError for a place that is taken; with ``force`` an exported policy may be there."""
    if not out.exists() and not out.is_symlink():
        return
    if not force:
        raise ConfigError(f"{out}: is already there; give another folder with --out DIR, or --force")
    ours = out.is_dir() and not out.is_symlink() and {path.name for path in out.iterdir()} <= {SPEC, *FILES}
    if not ours or not (out / SPEC).is_file():
        raise ConfigError(f"{out}: is not just an exported policy; give another folder with --out DIR")


def _publish(out: Path, files: dict[str, bytes], spec: dict[str, Any]) -> None:
    """Write everything into a neighbour, flush it, give it its name. Raises RunFolderError."""
    spec = spec | {"files": {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}}
    text = json.dumps(spec, indent=1, allow_nan=False) + "\n"
    old = unfinished(out)
    try:
        with refusing(RunFolderError, f"{out}: cannot be written", "give a folder that can be: --out DIR"):
            with whole_folder(out) as partial:
                for name, content in {**files, SPEC: text.encode()}.items():
                    write_atomic(partial / name, content)
                sync_folder(partial)
                if out.exists():
                    out.rename(old)
            sync_folder(out.parent)
    finally:
        if out.exists():
            shutil.rmtree(old, ignore_errors=True)
        elif old.exists():
            old.rename(out)
