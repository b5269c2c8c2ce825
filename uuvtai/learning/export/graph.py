"""ONNX graphs: what one of a stranger may hold before ONNX Runtime sees it, and sessions that run one."""

from __future__ import annotations

import importlib.util
import math
import os
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from uuvtai.common.errors import UserError

_NAMES = """
Abs Add And Cast Celu Clip Concat Constant ConstantOfShape Div Elu Equal Erf Exp Expand Flatten Floor Gather
GatherND Gelu Gemm Greater GreaterOrEqual HardSigmoid HardSwish Identity IsInf IsNaN LayerNormalization
LeakyRelu Less LessOrEqual Log LogSoftmax MatMul Max Min Mish Mul Neg Not Or PRelu Pow Reciprocal ReduceL2
ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum ReduceSumSquare Relu Reshape Selu Shape Sigmoid Sign
Slice Softmax Softplus Softsign Split Sqrt Squeeze Sub Swish Tanh Transpose Unsqueeze Where
"""
OPERATORS = frozenset(_NAMES.split())
"""what torch's exporters make of a policy: no loops, branches, random numbers or functions"""
_INNER = {"functions", "training_info", "g", "graphs"}
_INNER |= {"sparse_initializer", "sparse_tensor", "sparse_tensors"}
"""fields of a model, a graph or an attribute that no policy needs"""
OPSETS = range(9, 27)
_DTYPES = {1: np.float32, 10: np.float16, 11: np.float64}
MAX_NODES = 5000
MAX_BYTES = 64 << 20  # of the graph with its weights: ONNX Runtime holds them about four times
MAX_VALUES = 256 << 20  # [bytes] all values between the operators together, eight bytes a number
MAX_WORK = 1 << 34  # multiplications of all matrix products, and values as well, of all calls together
_RANK = 8


class GraphError(UserError, RuntimeError):
    """policy.onnx is no graph of ours, or ONNX Runtime cannot use it."""

    def __init__(self, reason: str) -> None:
        super().__init__(f"policy.onnx: {reason}; export the policy again")
        self.reason = reason


class GraphHead(NamedTuple):
    """What a graph says of itself; nothing of it is believed but names."""

    inputs: dict[str, tuple[int | None, int | None, Any]]
    """size of the last axis, size of the first one (None = any), NumPy's dtype (None = no float)"""
    outputs: list[str]
    metadata: dict[str, str]


def head_of(graph: bytes) -> GraphHead:
    """Inputs, outputs and metadata of a graph. GraphError for what is no graph."""
    model = _parsed(graph)
    weights = {tensor.name for tensor in model.graph.initializer}
    inputs = {}
    for value in model.graph.input:
        if value.name not in weights:
            told = value.type.tensor_type
            sizes = [size.dim_value if size.HasField("dim_value") else None for size in told.shape.dim]
            ends = sizes[-1] if sizes else None, sizes[0] if len(sizes) > 1 else None
            inputs[value.name] = (*ends, _DTYPES.get(told.elem_type))
    outputs = [value.name for value in model.graph.output]
    if not outputs:
        raise GraphError("gives nothing")
    return GraphHead(inputs, outputs, {entry.key: entry.value for entry in model.metadata_props})


def with_weights(graph: bytes, read: Callable[[str], bytes]) -> bytes:
    """A graph whose weights lie in files beside it, whole: ``read`` gives the content of a file by its plain
    name. GraphError where a name leads elsewhere, or a weight is not in its file."""
    import onnx

    model, files = _parsed(graph), {}
    for tensor in _tensors(model.graph):
        if not (tensor.external_data or tensor.data_location):
            continue
        told = {entry.key: entry.value for entry in tensor.external_data}
        name = told.get("location", "")
        if not name or name in (".", "..") or set(name) & {*"/\\:\0"}:
            raise GraphError(f"has weights in {name[:100]!r}; they may lie beside it, in no other folder")
        if name not in files:
            files[name] = read(name)
        try:
            item_bytes = onnx.helper.tensor_dtype_to_np_dtype(tensor.data_type).itemsize
            offset, n_bytes = int(told.get("offset", "0")), math.prod(tensor.dims) * item_bytes
        except (KeyError, TypeError, ValueError):
            raise GraphError(f"has weights {tensor.name[:100]} of no known kind or place") from None
        content = files[name][offset : offset + n_bytes] if offset >= 0 else b""
        if len(content) != n_bytes or told.get("length", str(n_bytes)) != str(n_bytes):
            raise GraphError(f"has weights {tensor.name[:100]} that are not whole in {name[:100]}")
        if sum(map(len, files.values())) > MAX_BYTES:
            raise GraphError(f"has weights of more than {MAX_BYTES >> 20} MiB")
        tensor.raw_data = content
        tensor.ClearField("external_data")
        tensor.ClearField("data_location")
    return model.SerializeToString() if files else graph


def only(graph: bytes, output: str) -> bytes:
    """The part of a graph that gives this output."""
    model, needed = _parsed(graph), {output}
    for part in ("node", "output", "initializer", "input"):
        values = getattr(model.graph, part)
        for at in reversed(range(len(values))):  # operators stand in the order of their use
            value = values[at]
            if needed.isdisjoint(value.output if part == "node" else [value.name]):
                del values[at]
            elif part == "node":
                needed |= {*value.input}
    return model.SerializeToString()


def refuse_strange(
    graph: bytes, inputs: dict[str, tuple[int, ...]], single_calls: int, rows_of_one: int = 1
) -> None:
    """Raise GraphError for a graph that reaches beyond itself or may take more memory or time than ours.
    It will run once with ``inputs`` of these shapes, and ``single_calls`` times with ``rows_of_one``."""
    model = _parsed(graph)
    _refuse_parts(model)
    found = {value.name for value in model.graph.input} - {tensor.name for tensor in model.graph.initializer}
    if found != set(inputs):
        told = ", ".join(sorted(found)) or "nothing"
        raise GraphError(f"takes {told} instead of {', '.join(sorted(inputs))}")
    single = {name: (rows_of_one, *shape[1:]) for name, shape in inputs.items()}
    work = _work(model, inputs) + single_calls * _work(model, single)
    if work > MAX_WORK:
        raise GraphError(f"takes {work:.1e} multiplications")


def _parsed(graph: bytes) -> Any:
    import onnx

    if len(graph) > MAX_BYTES:
        raise GraphError(f"has {len(graph):,} bytes, more than {MAX_BYTES >> 20} MiB")
    try:
        return onnx.load_from_string(graph)
    except Exception as error:  # protobuf's own, which this package does not import
        raise GraphError(f"is no ONNX graph ({error})") from None


def _refuse_parts(model: Any) -> None:
    """Operators, domains, functions, graphs within graphs, other files."""
    graph = model.graph
    attributes = [attribute for node in graph.node for attribute in node.attribute]
    fields = {field.name for part in (model, graph, *attributes) for field, _ in part.ListFields()}
    strange = {name.replace("_", " ") for name in fields & _INNER}
    for node in graph.node:
        if node.domain or node.op_type not in OPERATORS:
            strange.add(f"{node.domain or 'onnx'}.{node.op_type}")
    for opset in model.opset_import:
        if opset.domain or opset.version not in OPSETS:
            strange.add(f"opset {opset.domain or 'onnx'} {opset.version}")
    strange |= {tensor.name for tensor in _tensors(graph) if tensor.external_data or tensor.data_location}
    if strange:
        raise GraphError(f"is no policy's, it has {', '.join(sorted(strange)[:5])}")
    if len(graph.node) > MAX_NODES or len(graph.initializer) > MAX_NODES:
        raise GraphError(f"has more than {MAX_NODES:,} operators or weights")
    for tensor in _tensors(graph):
        is_small = len(tensor.dims) <= _RANK and math.prod(tensor.dims) <= MAX_BYTES
        if not is_small or min(tensor.dims, default=0) < 0:
            raise GraphError(f"has weights {tensor.name} of shape {list(tensor.dims)[:_RANK]}")


def _tensors(graph: Any) -> Iterator[Any]:
    yield from graph.initializer
    for node in graph.node:
        for attribute in node.attribute:
            if attribute.HasField("t"):
                yield attribute.t
            yield from attribute.tensors


def _work(model: Any, inputs: dict[str, tuple[int, ...]]) -> int:
    """Multiplications of the matrix products, and values of everything, of a call with these inputs; what the
    file says of shapes is taken out of ``model``. GraphError for unknown ones, and for too much memory."""
    from onnx import shape_inference

    graph = model.graph
    del graph.value_info[:]
    for value in graph.output:
        value.type.tensor_type.ClearField("shape")
    for value in graph.input:
        if value.name in inputs:
            shape = value.type.tensor_type.shape
            del shape.dim[:]
            for size in inputs[value.name]:
                shape.dim.add().dim_value = size
    try:
        inferred = shape_inference.infer_shapes(model, True, True, True).graph  # checked, strict, with data
    except Exception as error:  # onnx's own, or protobuf's
        raise GraphError(f"does not fit together ({str(error).strip().splitlines()[-1][:200]})") from None
    shapes = {tensor.name: tuple(tensor.dims) for tensor in graph.initializer} | inputs
    for value in (*inferred.value_info, *inferred.output):
        told = value.type.tensor_type
        if told.HasField("shape") and all(size.HasField("dim_value") for size in told.shape.dim):
            shapes[value.name] = tuple(size.dim_value for size in told.shape.dim)
    n_values, n_taken = 0, 0
    for node in graph.node:
        for name in filter(None, node.output):
            if min(shapes.get(name, (-1,)), default=0) < 0:
                raise GraphError(f"has a value whose shape cannot be told: {name[:100]}")
        size = sum(math.prod(shapes[name]) for name in node.output if name)
        n_values += size
        n_taken += sum(math.prod(shapes.get(name, ())) for name in node.input if name)
        if node.op_type in ("Gemm", "MatMul"):
            n_taken += size * max(shapes.get(node.input[0], ()), default=1)
    if 8 * n_values > MAX_VALUES:
        raise GraphError(f"would take more than {MAX_VALUES >> 20} MiB to run")
    return n_values + n_taken


# ------------------------------------------------------------------------------------------------------------
# The one place that imports ONNX Runtime: its telemetry is off before it is loaded.


NAME = "onnxruntime"
VARIABLE = "ORT_DISABLE_TELEMETRY"
"""read by ONNX Runtime when it is loaded, from 1.29 on; before that it had no telemetry outside Windows"""


def missing_packages(*names: str) -> list[str]:
    """Which of these are not installed; of what torch's exporter needs to write a graph, if none is named."""
    return [name for name in names or ("onnx",) if importlib.util.find_spec(name) is None]


def is_installed() -> bool:
    return not missing_packages(NAME, "onnx")


def without_telemetry() -> None:
    """Called by whatever may load ONNX Runtime, torch's exporter included."""
    os.environ[VARIABLE] = "1"


def session(graph: bytes) -> Any:
    """An InferenceSession on one thread of the CPU."""
    without_telemetry()
    import onnxruntime

    onnxruntime.disable_telemetry_events()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
