"""``uuv export``: a policy as a folder that drives without uuvtai, written whole or not at all, and the check
of such a folder."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
import safetensors.torch
import torch

from uuvtai.common.errors import UserError
from uuvtai.common.files import unfinished, whole_folder
from uuvtai.config.loader import ConfigError
from uuvtai.learning.checkpoint import Checkpoint
from uuvtai.learning.export import graph as onnx_session
from uuvtai.learning.export import run_policy
from uuvtai.learning.export.card import evaluations_of, model_card
from uuvtai.learning.export.graph import GraphError, refuse_strange
from uuvtai.learning.export.modules import (
    TOLERANCE,
    Arrays,
    ExportedModule,
    golden_of,
    missing_packages,
    module_of,
    onnx_bytes,
    weights_of,
)
from uuvtai.learning.export.run_policy import FILES, GOLDEN, SPEC, WEIGHTS, PolicyError
from uuvtai.learning.export.spec import ONNX, specification
from uuvtai.logs.container import sync_folder
from uuvtai.logs.run_folder import RunFolderError, write_atomic

# ------------------------------------------------------------------------------------------------------------
# Do torch, NumPy and ONNX Runtime say the same to the golden pairs, and how long does each take for a
# decision.


@dataclass(frozen=True)
class Agreement:
    """One engine against the golden pairs."""

    engine: str
    difference: dict[str, float]
    """largest of every output, in parts of its largest value where that is beyond 1"""
    p50_ms: float
    """of a decision of one vehicle"""
    p99_ms: float

    @property
    def agrees(self) -> bool:
        """Within TOLERANCE everywhere."""
        return max(self.difference.values(), default=np.inf) <= TOLERANCE

    def document(self) -> dict[str, Any]:
        """As JSON; a difference that is not finite is null."""
        differences = {name: value if np.isfinite(value) else None for name, value in self.difference.items()}
        return asdict(self) | {"difference": differences, "agrees": self.agrees}


def of_numpy(policy: run_policy.Exported, golden: Arrays) -> Agreement:
    """``run_policy.py`` answers the golden inputs."""
    worst = run_policy.differences(policy, golden)
    return Agreement("NumPy", worst, **run_policy.latency_ms(policy.said, _inputs(golden, policy.inputs)))


def of_torch(module: ExportedModule, golden: Arrays) -> Agreement:
    """The networks themselves, one decision at a time."""

    def said(row: Arrays) -> list[np.ndarray]:
        return [part.numpy() for part in module(*map(torch.from_numpy, row.values()))]

    inputs = _inputs(golden, module.inputs)
    count = len(next(iter(inputs.values())))
    with torch.inference_mode():
        rows = [said({name: part[i : i + 1] for name, part in inputs.items()}) for i in range(count)]
        time_ms = run_policy.latency_ms(said, inputs)
    outputs = dict(zip(module.outputs, map(np.concatenate, zip(*rows, strict=True)), strict=True))
    return Agreement("torch", _differences(outputs, golden, inputs), **time_ms)


def of_onnx(graph: bytes, golden: Arrays, names: Iterable[str]) -> Agreement:
    """ONNX Runtime on one thread, told the golden inputs of these names. Raises GraphError for a graph that
    is not ours or that it cannot use."""
    inputs = _inputs(golden, names)
    count = {len(array) if array.ndim else 0 for array in inputs.values()}
    if len(count) != 1 or 0 in count:
        raise GraphError("its golden pairs are no rows of inputs")
    refuse_strange(graph, {name: array.shape for name, array in inputs.items()}, run_policy.CALLS)
    try:
        session = onnx_session.session(graph)
        names = [output.name for output in session.get_outputs()]
        outputs = [np.asarray(output) for output in session.run(names, inputs)]
    except Exception as error:  # its own errors share no base class beyond this
        raise GraphError(f"ONNX Runtime cannot use it ({error})") from None
    found = _differences(dict(zip(names, outputs, strict=True)), golden, inputs)
    return Agreement(
        "ONNX Runtime", found, **run_policy.latency_ms(lambda row: session.run(names, row), inputs)
    )


def _inputs(golden: Arrays, names: Iterable[str]) -> Arrays:
    return {name: golden[f"pair_{name}"] for name in names}


def _differences(said: Arrays, golden: Arrays, inputs: Arrays) -> dict[str, float]:
    """Of every output that the golden pairs have; one that is missing differs without end."""
    wanted = [name.removeprefix("pair_") for name in golden]
    return {
        name: run_policy.difference(said[name], golden[f"pair_{name}"]) if name in said else np.inf
        for name in wanted
        if name not in inputs
    }


# ------------------------------------------------------------------------------------------------------------


Note = Callable[[str], None]

EXTRA = "uuvtai[export]"
"""extra that brings ONNX"""


class ExportError(UserError, PolicyError):
    """What a folder lacks to be an exported policy (``run_policy.PolicyError``, whose module knows nothing of
    this package)."""


@dataclass(frozen=True)
class Export:
    """A folder and what its engines say to the golden pairs."""

    folder: Path
    agreements: tuple[Agreement, ...]
    damages: tuple[str, ...] = ()
    """files that are not as the specification says"""

    @property
    def agrees(self) -> bool:
        """Every file is whole and every engine agrees."""
        return not self.damages and all(found.agrees for found in self.agreements)

    def document(self) -> dict[str, Any]:
        """What ``uuv export --json`` prints."""
        engines = [found.document() for found in self.agreements]
        return {
            "schema": 1,
            "folder": str(self.folder),
            "agrees": self.agrees,
            "damages": list(self.damages),
            "engines": engines,
        }


def export(
    checkpoint: Checkpoint, name: str, out: Path, evaluations: Iterable[Path], note: Note, force: bool = False
) -> Export:
    """Write the policy of a checkpoint into a new folder ``out``; ``note`` is told what it lacks.
    ``force`` replaces an exported policy.

    Raises ConfigError for a place that is taken, CheckpointError for networks that cannot drive,
    RunFolderError where the disk refuses.
    """
    _refuse_place(out, force)
    module, rows = module_of(checkpoint), evaluations_of(checkpoint, evaluations)
    golden, graph = golden_of(module), None
    if missing := missing_packages():
        note(
            f"left out {ONNX}: {', '.join(missing)} not installed. For an ONNX graph: pip install '{EXTRA}', "
            "then export again"
        )
    else:
        graph = onnx_bytes(module)
    spec = specification(checkpoint, module, name, graph is not None)
    files = {
        WEIGHTS: safetensors.torch.save(weights_of(module)),
        GOLDEN: safetensors.numpy.save(golden),
        "README.md": model_card(spec, checkpoint, rows).encode(),
        "run_policy.py": Path(run_policy.__file__).read_bytes(),
    } | ({} if graph is None else {ONNX: graph})
    _publish(out, files, spec)
    return Export(out, (of_torch(module, golden), *_replayed(out, run_policy.read_spec(out), note)))


def check(folder: Path, note: Note) -> Export:
    """Verify the sha256 of every file of an exported policy and replay its golden pairs; nothing in it is
    executed.

    Raises ExportError for a folder that is no exported policy.
    """
    try:
        spec = run_policy.read_spec(folder)
        if damages := run_policy.changed_files(folder, spec):
            return Export(folder, (), tuple(damages))
        return Export(folder, tuple(_replayed(folder, spec, note)))
    except PolicyError as error:
        raise ExportError(str(error)) from None


def _replayed(folder: Path, spec: dict[str, Any], note: Note) -> list[Agreement]:
    """What NumPy and, where it is here, ONNX Runtime make of the folder's files."""
    golden = run_policy.read_safetensors(folder / GOLDEN)
    try:
        policy = run_policy.made(spec, run_policy.read_safetensors(folder / WEIGHTS))
        found = [of_numpy(policy, golden)]
        if ONNX not in spec["files"]:
            return found
        if onnx_session.is_installed():
            return [*found, of_onnx(run_policy.content_of(folder / ONNX), golden, policy.inputs)]
    except (LookupError, ValueError, TypeError, AttributeError, ArithmeticError) as error:
        raise PolicyError(
            f"{folder}: its golden pairs do not fit its policy ({error!r}); export it again"
        ) from None
    note(f"{ONNX} was not replayed: {onnx_session.NAME} is not installed; pip install '{EXTRA}'")
    return found


def _refuse_place(out: Path, force: bool) -> None:
    """Raise ConfigError for a place that is taken; with ``force`` a folder that holds an exported policy and
    nothing else may be."""
    if not out.exists() and not out.is_symlink():
        return
    if not force:
        raise ConfigError(
            f"{out}: is already there; give another folder with --out DIR, or --force to replace an exported "
            "policy"
        )
    ours = out.is_dir() and not out.is_symlink() and {path.name for path in out.iterdir()} <= {SPEC, *FILES}
    if not ours or not (out / SPEC).is_file():
        raise ConfigError(
            f"{out}: is not just an exported policy, so it is not replaced; give another folder with --out "
            "DIR"
        )


def _publish(out: Path, files: dict[str, bytes], spec: dict[str, Any]) -> None:
    """Write everything into a neighbour, flush it, give it its name. Raises RunFolderError."""
    spec = spec | {"files": {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}}
    text = json.dumps(spec, indent=1, allow_nan=False) + "\n"
    old = unfinished(out)
    try:
        with whole_folder(out) as partial:
            for name, content in {**files, SPEC: text.encode()}.items():
                write_atomic(partial / name, content)
            sync_folder(partial)
            if out.exists():
                out.rename(old)
        sync_folder(out.parent)
    except OSError as error:
        raise RunFolderError(
            f"{out}: cannot be written ({error.strerror}); give a folder that can be: --out DIR"
        ) from None
    finally:
        if out.exists():
            shutil.rmtree(old, ignore_errors=True)
        elif old.exists():
            old.rename(out)
