"""``uuv export``: a policy as a folder that drives without uuvtai, written whole or not at all, and the check
of such a folder."""

from __future__ import annotations

import functools
import hashlib
import json
import shutil
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import safetensors.torch
import torch
from torch import Tensor

from uuvtai.common.errors import UserError
from uuvtai.common.files import unfinished, whole_folder
from uuvtai.config.loader import ConfigError
from uuvtai.learning.checkpoint import Checkpoint
from uuvtai.learning.export import graph as onnx_session
from uuvtai.learning.export import run_policy, run_set_policy
from uuvtai.learning.export.card import Evaluation, evaluations_of, model_card, set_card
from uuvtai.learning.export.graph import (
    INPUTS,
    OUTPUTS,
    SET_OUTPUTS,
    TOLERANCE,
    Arrays,
    ExportedModule,
    GraphError,
    OneDecision,
    golden_of,
    golden_rows,
    inputs_of,
    kind_of,
    missing_packages,
    module_of,
    npz_bytes,
    onnx_bytes,
    refuse_strange,
    set_weights,
)
from uuvtai.learning.export.run_policy import FILES, GOLDEN, SPEC, WEIGHTS, PolicyError
from uuvtai.learning.export.spec import ONNX, set_specification, specification, weights_of
from uuvtai.learning.policy_agent import load_agent
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


def of_numpy(policy: run_policy.Policy, golden: Arrays) -> Agreement:
    """``run_policy.py`` flies the golden mission."""
    found = run_policy.replayed(policy, golden)
    worst = {name: run_policy.difference(values, golden[name]) for name, values in found.items()}
    return Agreement("NumPy", worst, **run_policy.decision_latency_ms(policy, golden["obs"]))


def of_set_numpy(
    policy: run_set_policy.SetPolicy | run_set_policy.TrackForecast, golden: Arrays
) -> Agreement:
    """``run_set_policy.py`` answers the golden inputs."""
    worst = run_set_policy.differences(policy, golden)
    return Agreement("NumPy", worst, **run_set_policy.latency_ms(policy, golden))


def of_torch(decision: ExportedModule, golden: Arrays) -> Agreement:
    """The networks themselves, one decision at a time without memory, against the agent that flew the golden
    mission with its own."""
    tensors = [torch.from_numpy(array) for array in inputs_of(golden, decision.inputs).values()]
    rows = [[tensor[i : i + 1] for tensor in tensors] for i in range(len(tensors[0]))]
    with torch.inference_mode():
        outputs = [torch.cat(parts).numpy() for parts in zip(*(decision(*row) for row in rows), strict=True)]
        time_ms = _in_turn(lambda row: decision(*row), rows)
    return Agreement(
        "torch", _differences(dict(zip(decision.outputs, outputs, strict=True)), golden), **time_ms
    )


def of_onnx(graph: bytes, golden: Arrays, names: Iterable[str] = INPUTS) -> Agreement:
    """ONNX Runtime on one thread, told the golden inputs of these names. Raises GraphError for a graph that
    is not ours or that it cannot use."""
    inputs = inputs_of(golden, names)
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
    rows = [{name: array[i : i + 1] for name, array in inputs.items()} for i in range(count.pop())]
    found = _differences(dict(zip(names, outputs, strict=True)), golden)
    return Agreement("ONNX Runtime", found, **_in_turn(lambda row: session.run(names, row), rows))


def _differences(found: Arrays, golden: Arrays) -> dict[str, float]:
    """Of every output that the golden pairs have; one that is missing differs without end."""
    wanted = [name for name in (*OUTPUTS, *SET_OUTPUTS) if f"pair_{name}" in golden]
    return {
        name: run_policy.difference(found[name], golden[f"pair_{name}"]) if name in found else np.inf
        for name in wanted
    }


def _in_turn(step: Callable[[Any], Any], rows: list[Any]) -> dict[str, float]:
    turn = 0

    def once() -> None:
        nonlocal turn
        step(rows[turn % len(rows)])
        turn += 1

    return run_policy.latency_ms(once)


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
    """Write the policy of a checkpoint into a new folder ``out``; ``note`` is told what it lacks. ``force``
    replaces an exported policy.

    Raises ConfigError for a place that is taken, CheckpointError for networks that cannot drive,
    RunFolderError where the disk refuses.
    """
    _refuse_place(out, force)
    exporter, rows = _exporter_of(checkpoint, name), evaluations_of(checkpoint, evaluations)
    decision, golden, graph = exporter.decision, exporter.golden, None
    if missing := missing_packages():
        note(
            f"left out {ONNX}: {', '.join(missing)} not installed. For an ONNX graph: pip install '{EXTRA}', "
            "then export again"
        )
    else:
        graph = onnx_bytes(decision)
    spec = exporter.spec(graph is not None)
    files = {
        WEIGHTS: safetensors.torch.save(exporter.weights),
        GOLDEN: npz_bytes(golden),
        "README.md": exporter.card(spec, checkpoint, rows).encode(),
        "run_policy.py": _source_of(run_policy),
    } | ({} if graph is None else {ONNX: graph})
    if "kind" in spec:
        files["run_set_policy.py"] = _source_of(run_set_policy)
    _publish(out, files, spec)
    return Export(out, (of_torch(decision, golden), *_replayed(out, run_policy.read_spec(out), note)))


@dataclass(frozen=True)
class _Exporter:
    """What of a checkpoint goes into a folder."""

    decision: ExportedModule
    golden: Arrays
    weights: dict[str, Tensor]
    spec: Callable[[bool], dict[str, Any]]
    """of whether there is a graph"""
    card: Callable[[dict[str, Any], Checkpoint, list[Evaluation]], str]


def _exporter_of(checkpoint: Checkpoint, name: str) -> _Exporter:
    """Raises CheckpointError for networks that cannot drive."""
    if (kind := kind_of(checkpoint)) is None:
        agent = load_agent(checkpoint, 1)
        decision, spec = OneDecision(agent), functools.partial(specification, checkpoint, agent, name)
        return _Exporter(decision.eval(), golden_of(agent), weights_of(agent), spec, model_card)
    decision = module_of(checkpoint, kind)
    spec = functools.partial(set_specification, checkpoint, decision, kind, name)
    return _Exporter(decision.eval(), golden_rows(decision), set_weights(decision), spec, set_card)


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


def _source_of(module: ModuleType) -> bytes:
    """A exporter's own text."""
    return Path(module.__file__ or "").read_bytes()


def _replayed(folder: Path, spec: dict[str, Any], note: Note) -> list[Agreement]:
    """What NumPy and, where it is here, ONNX Runtime make of the folder's files."""
    golden = run_policy.read_golden(folder / GOLDEN)
    try:
        arrays, names = run_policy.read_safetensors(folder / WEIGHTS), tuple(INPUTS)
        if "kind" in spec:
            policy = run_set_policy.made(spec, arrays)
            found, names = [of_set_numpy(policy, golden)], policy.inputs
        else:
            found = [of_numpy(run_policy.Policy(spec, arrays), golden)]
        if ONNX not in spec["files"]:
            return found
        if onnx_session.is_installed():
            return [*found, of_onnx(run_policy.content_of(folder / ONNX), golden, names)]
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
