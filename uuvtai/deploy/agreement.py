"""Do torch, NumPy and ONNX Runtime say the same to the golden pairs, and how long does each take for a
decision."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch

from uuvtai.deploy import onnx_session, run_policy, run_set_policy
from uuvtai.deploy.golden import TOLERANCE, Arrays, inputs_of
from uuvtai.deploy.graph import INPUTS, OUTPUTS, ExportedModule
from uuvtai.deploy.graph_check import GraphError, refuse_strange
from uuvtai.deploy.set_graph import SET_OUTPUTS


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
    """The networks themselves, one decision at a time without memory, against the pilot that flew the golden
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
