"""ONNX graphs: what one of a stranger may hold before ONNX Runtime sees it, and sessions that run one."""

from __future__ import annotations

import importlib.util
import math
import os
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from uuvtai.common.errors import UserError

# ------------------------------------------------------------------------------------------------------------
# What an ONNX graph of a stranger may hold before ONNX Runtime sees it: our operators, and memory and work
# that are reckoned first.


_OURS = """
Add And Cast Clip Concat ConstantOfShape Div Elu Exp Floor GatherND Gemm Greater IsInf IsNaN Less Min Mul Not
LogSoftmax Pow Reciprocal ReduceL2 ReduceMax ReduceMean ReduceMin Relu Shape Slice Softplus Split Sqrt Squeeze
Sub Tanh Unsqueeze Where
"""
_LIKE_OURS = """
Abs Celu Constant Equal Erf Expand Flatten Gather Gelu GreaterOrEqual HardSigmoid HardSwish Identity
LayerNormalization LeakyRelu LessOrEqual Log MatMul Max Mish Neg Or PRelu ReduceProd ReduceSum ReduceSumSquare
Reshape Selu Sigmoid Sign Softmax Softsign Swish Transpose
"""
OPERATORS = frozenset((_OURS + _LIKE_OURS).split())
"""What torch's exporter makes of a policy, and what other versions of it make of the same. No loops,
branches, random numbers or functions. What ConstantOfShape (ours too: features before the first decision) and
Expand make is bounded like all else, by its shape."""
OPSETS = range(9, 27)
_DTYPES = {1: np.float32, 10: np.float16, 11: np.float64}
MAX_NODES = 5000
MAX_BYTES = 64 << 20
"""of the graph with its weights: ONNX Runtime holds them about four times"""
MAX_VALUES = 256 << 20
"""[bytes] all values between the operators together, eight bytes a number"""
MAX_WORK = 1 << 34
"""multiplications of all matrix products, and values as well, of all calls together"""
_RANK = 8


class GraphError(UserError, RuntimeError):
    """policy.onnx is no graph of ours, or ONNX Runtime cannot use it."""

    def __init__(self, reason: str) -> None:
        super().__init__(f"policy.onnx: {reason}; export the policy again")
        self.reason = reason


class GraphInput(NamedTuple):
    """What is to be given."""

    width: int | None
    """of the last axis; None = any"""
    rows: int | None
    """of the first axis; None = any"""
    dtype: Any
    """NumPy's; None = no float"""


class GraphHead(NamedTuple):
    """What a graph says of itself; nothing of it is believed but names."""

    inputs: dict[str, GraphInput]
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
            rows = sizes[0] if len(sizes) > 1 else None
            inputs[value.name] = GraphInput(sizes[-1] if sizes else None, rows, _DTYPES.get(told.elem_type))
    outputs = [value.name for value in model.graph.output]
    if not outputs:
        raise GraphError("gives nothing")
    return GraphHead(inputs, outputs, {entry.key: entry.value for entry in model.metadata_props})


def with_weights(graph: bytes, read: Callable[[str], bytes]) -> bytes:
    """A graph whose weights lie in files beside it, whole: ``read`` gives the content of such a file by its
    plain name. GraphError where a name leads elsewhere, or a weight is not in its file."""
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
        offset, n_bytes = _number(told.get("offset", "0")), math.prod(tensor.dims) * _item_bytes(tensor)
        content = files[name][offset : offset + n_bytes]
        if len(content) != n_bytes or told.get("length", str(n_bytes)) != str(n_bytes):
            raise GraphError(f"has weights {tensor.name[:100]} that are not whole in {name[:100]}")
        if sum(map(len, files.values())) > MAX_BYTES:
            raise GraphError(f"has weights of more than {MAX_BYTES >> 20} MiB")
        tensor.raw_data = content
        tensor.ClearField("external_data")
        tensor.ClearField("data_location")
    return model.SerializeToString() if files else graph


def only(graph: bytes, output: str) -> bytes:
    """The part of a graph that gives this output: value and log-probability of an exported actor are nobody's
    business here."""
    model = _parsed(graph)
    needed, nodes = {output}, []
    for node in reversed(model.graph.node):  # they stand in the order of their use
        if needed & {*node.output}:
            needed |= {*node.input}
            nodes.append(node)
    kept = {"node": nodes[::-1]}
    for part in ("initializer", "input", "output"):
        kept[part] = [value for value in getattr(model.graph, part) if value.name in needed]
    for part, values in kept.items():
        copies = [type(value).FromString(value.SerializeToString()) for value in values]
        model.graph.ClearField(part)
        getattr(model.graph, part).extend(copies)
    return model.SerializeToString()


def _number(text: str) -> int:
    return int(text) if text.isascii() and text.isdigit() and len(text) < 12 else 1 << 40


def _item_bytes(tensor: Any) -> int:
    import onnx

    try:
        return onnx.helper.tensor_dtype_to_np_dtype(tensor.data_type).itemsize
    except (KeyError, TypeError, ValueError):
        raise GraphError(f"has weights {tensor.name[:100]} of no known kind") from None


def refuse_strange(
    graph: bytes, inputs: dict[str, tuple[int, ...]], single_calls: int, rows_of_one: int = 1
) -> None:
    """Raise GraphError for a graph that reaches beyond itself or may take more memory or time than a policy
    does.

    ``inputs``: shapes (rows, ...) with which it will run once; it will run ``single_calls`` times with one
    row, or ``rows_of_one``, where a graph takes no fewer.
    """
    model = _parsed(graph)
    _refuse_parts(model)
    _refuse_interface(model, set(inputs))
    work = 0
    for rows, calls in ((None, 1), (rows_of_one, single_calls)):
        shapes = _shapes(model, {name: (rows or shape[0], *shape[1:]) for name, shape in inputs.items()})
        work += calls * _work(model, shapes)
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
    strange = {
        f"{node.domain or 'onnx'}.{node.op_type}"
        for node in graph.node
        if node.domain or node.op_type not in OPERATORS
    }
    strange |= {
        f"a graph in {node.op_type}"
        for node in graph.node
        for a in node.attribute
        if a.HasField("g") or a.graphs
    }
    strange |= {tensor.name for tensor in _tensors(graph) if tensor.external_data or tensor.data_location}
    strange |= {function.name for function in model.functions}
    strange |= {"training" for _ in model.training_info}
    strange |= {"sparse weights" for _ in graph.sparse_initializer}
    strange |= {
        "sparse weights"
        for node in graph.node
        for a in node.attribute
        if a.HasField("sparse_tensor") or a.sparse_tensors
    }
    strange |= {
        f"opset {o.domain or 'onnx'} {o.version}"
        for o in model.opset_import
        if o.domain or o.version not in OPSETS
    }
    if strange:
        raise GraphError(f"is no policy's, it has {', '.join(sorted(strange)[:5])}")
    if len(graph.node) > MAX_NODES or len(graph.initializer) > MAX_NODES:
        raise GraphError(f"has more than {MAX_NODES:,} operators or weights")
    for tensor in _tensors(graph):
        if (
            len(tensor.dims) > _RANK
            or not all(size >= 0 for size in tensor.dims)
            or math.prod(tensor.dims) > MAX_BYTES
        ):
            raise GraphError(f"has weights {tensor.name} of shape {list(tensor.dims)[:_RANK]}")


def _tensors(graph: Any) -> Iterator[Any]:
    yield from graph.initializer
    for node in graph.node:
        for attribute in node.attribute:
            if attribute.HasField("t"):
                yield attribute.t
            yield from attribute.tensors


def _refuse_interface(model: Any, wanted: set[str]) -> None:
    """Inputs are those that will be given; nothing else is asked for."""
    weights = {tensor.name for tensor in model.graph.initializer}
    found = {value.name for value in model.graph.input} - weights
    if found != wanted:
        raise GraphError(
            f"takes {', '.join(sorted(found)) or 'nothing'} instead of {', '.join(sorted(wanted))}"
        )


def _shapes(model: Any, inputs: dict[str, tuple[int, ...]]) -> dict[str, tuple[int, ...]]:
    """Shape of every value for these inputs, reckoned without what the file itself says about them;
    GraphError where one is unknown."""
    import onnx
    from onnx import shape_inference

    bare = onnx.ModelProto()
    bare.CopyFrom(model)
    graph = bare.graph
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
        inferred = shape_inference.infer_shapes(bare, check_type=True, strict_mode=True, data_prop=True).graph
    except Exception as error:  # onnx's own, or protobuf's
        raise GraphError(f"does not fit together ({str(error).strip().splitlines()[-1][:200]})") from None
    found = {tensor.name: tuple(tensor.dims) for tensor in graph.initializer} | dict(inputs)
    for value in (*inferred.value_info, *inferred.output):
        shape = value.type.tensor_type.shape
        if value.type.tensor_type.HasField("shape") and all(size.HasField("dim_value") for size in shape.dim):
            found[value.name] = tuple(size.dim_value for size in shape.dim)
    values = [name for node in graph.node for name in node.output if name]
    for name in values:
        if name not in found or min(found[name], default=0) < 0:
            raise GraphError(f"has a value whose shape cannot be told: {name[:100]}")
    if 8 * sum(math.prod(found[name]) for name in values) > MAX_VALUES:
        raise GraphError(f"would take more than {MAX_VALUES >> 20} MiB to run")
    return found


def _work(model: Any, shapes: dict[str, tuple[int, ...]]) -> int:
    """Multiplications of the matrix products and values of everything."""
    total = 0
    for node in model.graph.node:
        size = sum(math.prod(shapes[name]) for name in node.output if name)
        taken = sum(math.prod(shapes.get(name, ())) for name in node.input if name)
        total += size + taken
        if node.op_type in ("Gemm", "MatMul"):
            first = shapes.get(node.input[0], ())
            total += size * max(first, default=1)
    return total


# ------------------------------------------------------------------------------------------------------------
# The one place that imports ONNX Runtime: its telemetry is off before it is loaded, and its sessions run on
# one thread.


NAME = "onnxruntime"
VARIABLE = "ORT_DISABLE_TELEMETRY"
"""read by ONNX Runtime when it is loaded, from 1.29 on; before that it had no telemetry outside Windows"""


def is_installed() -> bool:
    """Whether graphs can be read and run here."""
    return all(importlib.util.find_spec(name) is not None for name in (NAME, "onnx"))


def without_telemetry() -> None:
    """Set the variable; whoever may cause ONNX Runtime to be loaded, torch's exporter included, calls this
    first."""
    os.environ[VARIABLE] = "1"


def session(graph: bytes) -> Any:
    """An InferenceSession on one thread of the CPU. Raises what ONNX Runtime raises."""
    without_telemetry()
    import onnxruntime

    onnxruntime.disable_telemetry_events()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
