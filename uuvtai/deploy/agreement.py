"""Do torch, NumPy and ONNX Runtime say the same to the golden pairs, and how long does each take for a decision."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch

from uuvtai.deploy import run_policy
from uuvtai.deploy.golden import TOLERANCE, Arrays, inputs_of
from uuvtai.deploy.graph import OUTPUTS, OneDecision
from uuvtai.errors import UserError

RUNTIME = "onnxruntime"
_BRANCHES = ("Loop", "Scan", "If", "SequenceMap")
"""operators that hold graphs of their own"""


class GraphError(UserError, RuntimeError):
    """policy.onnx is no graph of ours, or ONNX Runtime cannot use it."""


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


def of_torch(decision: OneDecision, golden: Arrays) -> Agreement:
    """The networks themselves, one decision at a time without memory, against the pilot that flew the golden mission with its own."""
    tensors = [torch.from_numpy(array) for array in inputs_of(golden).values()]
    rows = [[tensor[i : i + 1] for tensor in tensors] for i in range(len(tensors[0]))]
    with torch.inference_mode():
        outputs = [torch.cat(parts).numpy() for parts in zip(*(decision(*row) for row in rows), strict=True)]
        time_ms = _in_turn(lambda row: decision(*row), rows)
    return Agreement("torch", _differences(dict(zip(decision.outputs, outputs, strict=True)), golden), **time_ms)


def of_onnx(graph: bytes, golden: Arrays) -> Agreement:
    """ONNX Runtime on one thread. Raises RuntimeError where it cannot use the graph."""
    import onnxruntime

    _refuse_strange(graph)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    try:
        session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
        names = [output.name for output in session.get_outputs()]
        outputs = [np.asarray(output) for output in session.run(names, inputs_of(golden))]
    except Exception as error:  # its own errors share no base class beyond this
        raise GraphError(f"policy.onnx: ONNX Runtime cannot use it ({error}); export the policy again") from None
    inputs = inputs_of(golden)
    rows = [{name: array[i : i + 1] for name, array in inputs.items()} for i in range(len(inputs["obs"]))]
    found = _differences(dict(zip(names, outputs, strict=True)), golden)
    return Agreement("ONNX Runtime", found, **_in_turn(lambda row: session.run(names, row), rows))


def has_onnx_runtime() -> bool:
    """Whether the graph can be read and run here."""
    return all(importlib.util.find_spec(name) is not None for name in (RUNTIME, "onnx"))


def _refuse_strange(graph: bytes) -> None:
    """Raise RuntimeError for a graph that reaches beyond itself or may run for ever: other operators, other files, loops, functions."""
    import onnx

    try:
        model = onnx.load_from_string(graph)
    except Exception as error:  # protobuf's own, which this package does not import
        raise GraphError(f"policy.onnx: is no ONNX graph ({error}); export the policy again") from None
    strange = {f"{node.domain or 'onnx'}.{node.op_type}" for node in model.graph.node if node.domain or node.op_type in _BRANCHES}
    strange |= {tensor.name for tensor in model.graph.initializer if tensor.external_data}
    strange |= {function.name for function in model.functions}
    if strange:
        raise GraphError(f"policy.onnx: was not written by uuv export, it has {', '.join(sorted(strange)[:5])}; export the policy again")


def _differences(found: Arrays, golden: Arrays) -> dict[str, float]:
    """Of every output that the golden pairs have; one that is missing differs without end."""
    wanted = [name for name in OUTPUTS if f"pair_{name}" in golden]
    return {name: run_policy.difference(found[name], golden[f"pair_{name}"]) if name in found else np.inf for name in wanted}


def _in_turn(step: Callable[[Any], Any], rows: list[Any]) -> dict[str, float]:
    turn = 0

    def once() -> None:
        nonlocal turn
        step(rows[turn % len(rows)])
        turn += 1

    return run_policy.latency_ms(once)
