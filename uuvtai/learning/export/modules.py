"""What drives as torch modules without memory, as an ONNX graph, as plain arrays, and its golden pairs."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import logging
import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor, nn

from uuvtai.common.enums import EGO_COLUMNS, N_OBSTACLE, OBSTACLE_WIDTH
from uuvtai.learning.checkpoint import Checkpoint
from uuvtai.learning.export.graph import without_telemetry
from uuvtai.learning.networks import NUM_ACTIONS, RunningNorm
from uuvtai.learning.policy_agent import OneDecision, load_agent
from uuvtai.learning.set_networks import SetActor, actor_of
from uuvtai.learning.world_model import N_FEATURES, N_TARGET

PACKAGES = ("onnx", "onnxscript")
"""what torch's exporter needs"""
OPSET = 20
TOLERANCE = 1e-5
"""largest difference between torch, NumPy and ONNX Runtime, in parts of the output's largest value where that
is beyond 1"""
NO_LIMIT = float(torch.finfo(torch.float32).max)
"""of a normaliser that has seen nothing and therefore cuts nothing off"""
_ROWS, _SEED = 64, 6

Arrays = dict[str, np.ndarray]
Named = Iterator[tuple[str, Tensor]]


class ExportedModule(nn.Module, ABC):
    """What is exported: rows of inputs to rows of outputs, by name."""

    kind: str
    """one of ``run_policy.KINDS``"""
    inputs: dict[str, str]
    """what each one is, in the order of ``forward``"""
    outputs: dict[str, str]

    @abstractmethod
    def rows(self, count: int, rng: torch.Generator) -> tuple[Tensor, ...]:
        """Made-up inputs, spread as training had them."""

    @abstractmethod
    def named(self) -> Named:
        """Arrays of ``policy.safetensors`` by the names that ``run_policy.py`` knows."""

    def sizes(self) -> dict[str, dict[int, torch.export.Dim]]:
        """Axes of the inputs that may have any size."""
        rows = torch.export.Dim("rows", min=1)
        return {name: {0: rows} for name in self.inputs}


class OneAction(OneDecision, ExportedModule):
    """One decision of a policy on observation vectors; whoever calls it remembers the last one."""

    kind = "mlp"
    inputs = {
        "obs": "(N, n_obs) float32: the newest observation, raw SI units; what is not finite counts as the "
        "training's mean",
        "last_obs": "(N, n_obs) float32: the observation of the last decision; anything where has_last is "
        "false",
        "last_action": "(N, 4) float32: the action of the step in which the last decision was made",
        "has_last": "(N,) bool: there was a decision before in this mission",
    }
    outputs = {
        "mean_action": "(N, 4) float32: mean action, not yet cut off to [-1, 1]",
        "value": "(N,) float32: expected return",
        "features": "(N, 2) float32: residual and uncertainty of the world model's last prediction",
    }

    def rows(self, count: int, rng: torch.Generator) -> tuple[Tensor, ...]:
        """Some values are not finite, as a sensor that fails may give them; the first row has no last one."""
        norm, n_obs = self.policy.observation_norm, self.policy.n_in - N_FEATURES
        mean, std = norm.mean[:n_obs].float(), norm.std()[:n_obs].float()
        last, obs = (mean + std * torch.randn(count, n_obs, generator=rng) for _ in range(2))
        if self.world_model is not None:  # a step later little has changed
            obs[:, :N_TARGET] = last[:, :N_TARGET] + 0.1 * std[:N_TARGET] * torch.randn(
                count, N_TARGET, generator=rng
            )
        for row, column, bad in ((0, 0, math.nan), (1, -1, math.inf), (1, n_obs // 2, -math.inf)):
            obs[row, column], last[-1 - row, column] = bad, bad
        action = torch.randn(count, NUM_ACTIONS, generator=rng)
        return obs, last, action, torch.arange(count) > 0

    def named(self) -> Named:
        """Networks, and what they scale by."""
        policy, world = self.policy, self.world_model
        nets = {"actor": policy.actor, "critic": policy.critic}
        yield from _norm("norm", policy.observation_norm)
        yield "value.mean", policy.value_norm.mean
        yield "value.std", policy.value_norm.std()
        if world is not None:
            nets |= {name: getattr(world, name) for name in ("encoder", "dynamics", "decoder")}
            yield from _norm("world_norm", world.observation_norm)
        for name, net in nets.items():
            for key, tensor in net.state_dict().items():
                yield f"{name}.{key}", tensor


def _norm(name: str, norm: RunningNorm) -> Named:
    yield f"{name}.mean", norm.mean
    yield f"{name}.scale", 1.0 / norm.std()
    yield f"{name}.limit", torch.tensor([norm.clip if float(norm.count) > 0 else NO_LIMIT])


class OneWish(ExportedModule):
    """One decision of a policy over a set of obstacles; it remembers nothing, and no critic is part of it."""

    kind = "set"
    inputs = {
        "obstacles": f"(N, n, {OBSTACLE_WIDTH}) float32: the nearest moving obstacles in any order, any n "
        "from 1 on; a row of zeros is no obstacle",
        "own": f"(N, {EGO_COLUMNS}) float32: the vehicle, its goal and the free distances around it",
    }
    outputs = {
        "mean_wish": "(N, 3) float32: ahead, left, up, in parts of the fastest velocity, mirrored world; cut "
        "it off to [-2, 2]"
    }

    def __init__(self, actor: SetActor) -> None:
        super().__init__()
        self.actor = actor

    def forward(self, obstacles: Tensor, own: Tensor) -> tuple[Tensor, ...]:
        """Shapes as ``inputs`` and ``outputs`` say."""
        return (self.actor(obstacles, own),)

    def rows(self, count: int, rng: torch.Generator) -> tuple[Tensor, ...]:
        """Of any number of obstacles, the first of none."""
        obstacles = torch.randn(count, N_OBSTACLE, OBSTACLE_WIDTH, generator=rng)
        own = torch.randn(count, EGO_COLUMNS, generator=rng)
        number = torch.randint(1, N_OBSTACLE + 1, (count,), generator=rng)
        number[0] = 0
        there = torch.arange(N_OBSTACLE) < number[:, None]
        obstacles *= there[..., None]
        obstacles[..., 0] = there.float()
        return obstacles, own

    def named(self) -> Named:
        """The actor's layers."""
        return ((f"actor.{name}", tensor) for name, tensor in self.actor.net.state_dict().items())

    def sizes(self) -> dict[str, dict[int, torch.export.Dim]]:
        """As in ``ExportedModule``, and of obstacles."""
        sizes = super().sizes()
        sizes["obstacles"][1] = torch.export.Dim("obstacles", min=1)
        return sizes


def module_of(checkpoint: Checkpoint) -> ExportedModule:
    """What of a checkpoint drives. Raises CheckpointError where nothing does."""
    if checkpoint.config.learner == "ppo" and checkpoint.config.encoder == "set":
        return OneWish(actor_of(checkpoint)).eval()
    agent = load_agent(checkpoint, 1)
    return OneAction(agent.policy, agent.world_model).eval()


def weights_of(module: ExportedModule) -> dict[str, Tensor]:
    """Arrays by name, float32, on the host, contiguous."""
    return {name: tensor.detach().float().cpu().contiguous().clone() for name, tensor in module.named()}


def golden_of(module: ExportedModule) -> Arrays:
    """``pair_<input>`` and ``pair_<output>``, 64 rows of made-up inputs and what the module says to them."""
    inputs = module.rows(_ROWS, torch.Generator().manual_seed(_SEED))
    with torch.no_grad():
        said = module(*inputs)
    named = zip((*module.inputs, *module.outputs), (*inputs, *said), strict=True)
    return {f"pair_{name}": tensor.numpy() for name, tensor in named}


# ------------------------------------------------------------------------------------------------------- ONNX


def missing_packages() -> list[str]:
    """What has to be installed before an ONNX graph can be written; empty = nothing."""
    return [name for name in PACKAGES if importlib.util.find_spec(name) is None]


def onnx_bytes(module: ExportedModule) -> bytes:
    """The ONNX graph with its weights inside, any number of rows at once. Needs PACKAGES."""
    without_telemetry()
    with _quiet():
        program = torch.onnx.export(
            module,
            module.rows(2, torch.Generator().manual_seed(_SEED)),
            input_names=list(module.inputs),
            output_names=list(module.outputs),
            dynamic_shapes=module.sizes(),
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
