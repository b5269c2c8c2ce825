"""One decision without memory as a torch module and as an ONNX graph; whoever calls it remembers the last
decision."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import logging
import math
import os
import warnings
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from uuvtai.common.enums import COLUMNS, EGO_COLUMNS, N_OBSTACLE, OBSTACLE_WIDTH
from uuvtai.common.errors import UserError
from uuvtai.learning.checkpoint import Checkpoint
from uuvtai.learning.networks import NUM_ACTIONS, MixtureNet
from uuvtai.learning.policy_agent import PolicyAgent
from uuvtai.learning.set_networks import SetActor, actor_of, mixture_net_of
from uuvtai.learning.world_model import N_FEATURES, N_TARGET, deviation

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


# ------------------------------------------------------------------------------------------------------------


INPUTS = {
    "obs": "(N, n_obs) float32: the newest observation, raw SI units; what is not finite counts as the "
    "training's mean",
    "last_obs": "(N, n_obs) float32: the observation of the last decision; anything where has_last is false",
    "last_action": "(N, 4) float32: the action of the step in which the last decision was made",
    "has_last": "(N,) bool: there was a decision before in this mission",
}
OUTPUTS = {
    "mean_action": "(N, 4) float32: mean action, not yet cut off to [-1, 1]",
    "value": "(N,) float32: expected return",
    "features": "(N, 2) float32: residual and uncertainty of the world model's last prediction",
}
PACKAGES = ("onnx", "onnxscript")
"""what torch's exporter needs"""
OPSET = 20


class ExportedModule(nn.Module):
    """What is exported as a graph: inputs and outputs by name."""

    inputs: dict[str, str]
    """what each one is, in the order of ``forward``"""

    @property
    def outputs(self) -> list[str]:
        """Names of what ``forward`` returns."""
        raise NotImplementedError

    def example(self) -> tuple[tuple[Tensor, ...], dict[str, dict[int, torch.export.Dim]]]:
        """Inputs of two rows, and which of their axes may have any size."""
        raise NotImplementedError


class OneDecision(ExportedModule):
    """``PolicyAgent`` for one decision: outputs by the names of OUTPUTS."""

    inputs = INPUTS
    fill: Tensor
    """(n_obs,) what counts where a value is not finite"""

    def __init__(self, agent: PolicyAgent) -> None:
        super().__init__()
        self.policy, self.world_model = agent.policy, agent.world_model
        self.register_buffer(
            "fill", agent.policy.observation_norm.mean[: agent.policy.n_in - N_FEATURES].float()
        )

    @property
    def outputs(self) -> list[str]:
        """Names of what ``forward`` returns."""
        return list(OUTPUTS)

    def example(self) -> tuple[tuple[Tensor, ...], dict[str, dict[int, torch.export.Dim]]]:
        """As in ``ExportedModule``."""
        n_obs, rows = self.policy.n_in - N_FEATURES, torch.export.Dim("rows", min=1)
        some = torch.zeros(2, n_obs), torch.zeros(2, n_obs), torch.zeros(2, NUM_ACTIONS)
        return (*some, torch.tensor([True, False])), {name: {0: rows} for name in INPUTS}

    def forward(
        self, obs: Tensor, last_obs: Tensor, last_action: Tensor, has_last: Tensor
    ) -> tuple[Tensor, ...]:
        """Shapes as INPUTS says."""
        obs, last_obs = (torch.where(torch.isfinite(seen), seen, self.fill) for seen in (obs, last_obs))
        features = obs.new_zeros(obs.shape[0], N_FEATURES)
        if self.world_model is not None:
            features = torch.where(
                has_last[:, None], self.world_model.features(last_obs, last_action, obs), features
            )
        x = torch.cat([obs, features], dim=1)
        mean, _ = self.policy.distribution(x)
        return mean, self.policy.value(x), features


def missing_packages() -> list[str]:
    """What has to be installed before an ONNX graph can be written; empty = nothing."""
    return [name for name in PACKAGES if importlib.util.find_spec(name) is None]


def onnx_bytes(decision: ExportedModule) -> bytes:
    """The ONNX graph with its weights inside, any number of rows at once. Needs PACKAGES."""
    without_telemetry()
    example, sizes = decision.example()
    with _quiet():
        program = torch.onnx.export(
            decision.eval(),
            example,
            input_names=list(decision.inputs),
            output_names=decision.outputs,
            dynamic_shapes=sizes,
            opset_version=OPSET,
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    return program.model_proto.SerializeToString()


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """The exporter talks about itself on every channel there is; what it cannot do it raises."""
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        before = logging.root.manager.disable
        logging.disable(logging.WARNING)
        try:
            yield
        finally:
            logging.disable(before)


# ------------------------------------------------------------------------------------------------------------
# Golden pairs: a made-up mission that the agent answers, step by step with its memory and decision by
# decision without.


TOLERANCE = 1e-5
"""largest difference between torch, NumPy and ONNX Runtime, in parts of the output's largest value where that
is beyond 1"""
_DECISIONS, _SEED = 64, 6

Arrays = dict[str, np.ndarray]
Row = dict[str, Tensor]


def golden_of(agent: PolicyAgent) -> Arrays:
    """A mission of T steps and what the agent (of one row) does in it, and its decisions as pairs for the
    graph.

    ``obs`` (T, n_obs), ``begins`` (T,): another mission begins here; outputs ``action`` (T, 4), ``value``,
    ``residual`` and ``uncertainty`` (T,). ``pair_<input>`` and ``pair_<output>`` have
    a row per decision. Some values are not finite, as a sensor that fails may give them.
    """
    obs = _mission(agent)
    begins = torch.zeros(len(obs), dtype=torch.bool)
    begins[[0, len(obs) // 2 + 1]] = True
    decisions, pairs = _flown(agent, obs, begins)
    found = (
        {"obs": obs, "begins": begins}
        | _stacked(decisions)
        | {f"pair_{name}": tensor for name, tensor in _stacked(pairs).items()}
    )
    return {name: tensor.numpy() for name, tensor in found.items()}


def _stacked(rows: list[Row]) -> Row:
    return {name: torch.stack([row[name] for row in rows]) for name in rows[0]}


def npz_bytes(arrays: Arrays) -> bytes:
    """golden.npz: stored, not compressed, as ``run_policy.read_golden`` wants it."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # pyright: ignore[reportArgumentType]
    return buffer.getvalue()


def inputs_of(golden: Arrays, names: Iterable[str] = INPUTS) -> Arrays:
    """Inputs of the graph."""
    return {name: golden[f"pair_{name}"] for name in names}


def _mission(agent: PolicyAgent) -> Tensor:
    """(T, n_obs) observations as training had them: spread like the normaliser's columns, the world model's
    targets step by step."""
    norm, n_obs, hold = (
        agent.policy.observation_norm,
        agent.policy.n_in - N_FEATURES,
        agent.policy.config.hold_steps,
    )
    rng, steps = torch.Generator().manual_seed(_SEED), _DECISIONS + hold * (_DECISIONS // 4)
    mean, std = norm.mean[:n_obs].float(), norm.std()[:n_obs].float()
    obs = mean + std * torch.randn(steps, n_obs, generator=rng)
    if agent.world_model is not None:
        change = deviation(agent.world_model.change_norm.moments) / math.sqrt(hold)
        obs[1:, :N_TARGET] = change * torch.randn(steps - 1, N_TARGET, generator=rng)
        obs[:, :N_TARGET] = obs[:, :N_TARGET].cumsum(dim=0)
    obs[3, 0], obs[5, n_obs - 1], obs[7, n_obs // 2] = math.nan, math.inf, -math.inf
    return obs


def _flown(agent: PolicyAgent, obs: Tensor, begins: Tensor) -> tuple[list[Row], list[Row]]:
    """What the agent says at every step, and inputs and outputs of every decision."""
    decisions, pairs, age = [], [], 0
    nothing = torch.zeros(obs.shape[1]), torch.zeros(NUM_ACTIONS)
    last = nothing
    for row, is_first in zip(obs, begins.tolist(), strict=True):
        if is_first:
            agent.reset(torch.ones(1))
            age, last = 0, nothing
        decisions.append(_outputs_of(agent, row))
        if age % agent.policy.config.hold_steps == 0:
            inputs = dict(zip(INPUTS, (row, *last, torch.tensor(age > 0)), strict=True))
            pairs.append(inputs | _pair_outputs(agent, decisions[-1]))
            last = row, agent.mean_action[0].clone()
        age += 1
    return decisions, pairs


def _outputs_of(agent: PolicyAgent, obs: Tensor) -> Row:
    """One control step: outputs under their golden names."""
    said = agent.decide(obs[None])
    agent.advance()
    return {name: getattr(said, name)[0].clone() for name in ("action", "value", "residual", "uncertainty")}


def _pair_outputs(agent: PolicyAgent, row: Row) -> Row:
    """The same decision under the names of the graph's outputs."""
    found = {"mean_action": agent.mean_action[0].clone(), "value": row["value"]}
    return found | {"features": torch.stack([row["residual"], row["uncertainty"]])}


# ------------------------------------------------------------------------------------------------------------
# A policy over a set of obstacles and a learned forecast as torch modules that become ONNX graphs, their
# arrays, and what they say to made-up inputs. Neither remembers anything; no critic is among them.


SET_INPUTS = {
    "obstacles": f"(N, n, {OBSTACLE_WIDTH}) float32: the nearest moving obstacles in any order, any n from 1 "
    "on; a row of zeros is no obstacle",
    "own": f"(N, {EGO_COLUMNS}) float32: the vehicle, its goal and the free distances around it",
}
FORECAST_INPUTS = {
    "columns": f"(N, {COLUMNS}) float32: how a track moves, moved and turned",
    "speed": "(N,) float32: its speed [m/s]",
}
SET_OUTPUTS = {
    "mean_wish": "(N, 3) float32: ahead, left, up, in parts of the fastest velocity, mirrored world; cut it "
    "off to [-2, 2]",
    "log_weight": "(N, modes) float32: logarithm of the probability of each future",
    "place": "(N, modes, times, 2) float32: [m] along and across the track's course",
    "sigma": "(N, modes, times, 2) float32: [m] standard deviations",
}
Example = tuple[tuple[Tensor, ...], dict[str, dict[int, torch.export.Dim]]]


class OneWish(ExportedModule):
    """One decision of a policy over a set of obstacles."""

    inputs = SET_INPUTS

    def __init__(self, actor: SetActor) -> None:
        super().__init__()
        self.actor = actor

    @property
    def outputs(self) -> list[str]:
        """Names of what ``forward`` returns."""
        return list(SET_OUTPUTS)[:1]

    def example(self) -> Example:
        """As in ``ExportedModule``."""
        rows, obstacles = torch.export.Dim("rows", min=1), torch.export.Dim("obstacles", min=1)
        some = torch.zeros(2, N_OBSTACLE, OBSTACLE_WIDTH), torch.zeros(2, EGO_COLUMNS)
        return some, {"obstacles": {0: rows, 1: obstacles}, "own": {0: rows}}

    def forward(self, obstacles: Tensor, own: Tensor) -> tuple[Tensor, ...]:
        """Shapes as SET_INPUTS says."""
        return (self.actor(obstacles, own),)


class OneForecast(ExportedModule):
    """Futures of tracks. The network's columns beyond COLUMNS are padding, which is 0."""

    inputs = FORECAST_INPUTS

    def __init__(self, net: MixtureNet) -> None:
        super().__init__()
        self.net = net

    @property
    def outputs(self) -> list[str]:
        """Names of what ``forward`` returns."""
        return list(SET_OUTPUTS)[1:]

    def example(self) -> Example:
        """As in ``ExportedModule``."""
        rows = torch.export.Dim("rows", min=1)
        return (torch.zeros(2, COLUMNS), torch.ones(2)), {name: {0: rows} for name in self.inputs}

    def forward(self, columns: Tensor, speed: Tensor) -> tuple[Tensor, ...]:
        """Shapes as FORECAST_INPUTS says."""
        padding = columns.new_zeros(columns.shape[0], self.net.into.in_features - COLUMNS)
        return tuple(self.net(torch.cat([columns, padding], dim=1), speed))


_ROWS, _SET_SEED = 64, 7
_THERE = 0


def golden_rows(decision: ExportedModule) -> Arrays:
    """``pair_<input>`` and ``pair_<output>`` of 64 rows; the first has no obstacle at all."""
    rng = torch.Generator().manual_seed(_SET_SEED)
    inputs = _forecast_rows(decision, rng) if isinstance(decision, OneForecast) else _set_rows(rng)
    with torch.no_grad():
        said = decision.eval()(*inputs)
    named = zip((*decision.inputs, *decision.outputs), (*inputs, *said), strict=True)
    return {f"pair_{name}": tensor.numpy() for name, tensor in named}


def _forecast_rows(decision: ExportedModule, rng: torch.Generator) -> tuple[Tensor, ...]:
    (columns, _), _ = decision.example()
    speed = 0.1 + 1.9 * torch.rand(_ROWS, generator=rng)
    told = 0.5 * torch.randn(_ROWS, columns.shape[1], generator=rng)
    told[:, 0] = speed
    return told, speed


def _set_rows(rng: torch.Generator) -> tuple[Tensor, ...]:
    """Of any number of obstacles."""
    obstacles = torch.randn(_ROWS, N_OBSTACLE, OBSTACLE_WIDTH, generator=rng)
    own = torch.randn(_ROWS, EGO_COLUMNS, generator=rng)
    count = torch.randint(1, N_OBSTACLE + 1, (_ROWS,), generator=rng)
    count[0] = 0
    obstacles *= (torch.arange(N_OBSTACLE) < count[:, None])[..., None]
    obstacles[..., _THERE] = (torch.arange(N_OBSTACLE) < count[:, None]).float()
    return obstacles, own


def kind_of(checkpoint: Checkpoint) -> str | None:
    """One of ``run_policy.KINDS``; None = a policy of one observation vector."""
    return {"forecast_training": "forecast", "surrogate": "set"}.get(checkpoint.config.learner)


def module_of(checkpoint: Checkpoint, kind: str) -> ExportedModule:
    """The networks of a checkpoint of this kind. Raises CheckpointError where they cannot drive."""
    if kind == "forecast":
        return OneForecast(mixture_net_of(checkpoint))
    return OneWish(actor_of(checkpoint))


def set_weights(decision: ExportedModule) -> dict[str, Tensor]:
    """Arrays by name, on the host, contiguous."""
    found = dict(_named(decision))
    return {name: tensor.detach().float().cpu().contiguous().clone() for name, tensor in found.items()}


def _named(decision: ExportedModule) -> Iterator[tuple[str, Tensor]]:
    if isinstance(decision, OneForecast):
        for name, tensor in decision.net.state_dict().items():
            yield name, tensor[:, : decision.example()[0][0].shape[1]] if name == "into.weight" else tensor
        return
    assert isinstance(decision, OneWish)
    for name, tensor in decision.actor.net.state_dict().items():
        yield f"actor.{name}", tensor
