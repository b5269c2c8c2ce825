"""What drives as torch modules without memory, as an ONNX graph, as plain arrays, and its golden pairs."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import logging
import math
import warnings
from abc import ABC, abstractmethod

import numpy as np
import torch
from torch import Tensor, nn

from uuvtai.common.enums import EGO_COLUMNS, N_OBSTACLE, OBSTACLE_WIDTH
from uuvtai.learning.checkpoint import Checkpoint
from uuvtai.learning.export.graph import without_telemetry
from uuvtai.learning.networks import NUM_ACTIONS
from uuvtai.learning.policy_agent import OneDecision, load_agent
from uuvtai.learning.set_networks import SetActor, actor_of
from uuvtai.learning.world_model import N_FEATURES, N_TARGET

PACKAGES = ("onnx", "onnxscript")
"""what torch's exporter needs"""
OPSET = 20
NO_LIMIT = float(torch.finfo(torch.float32).max)
"""of a normaliser that has seen nothing and therefore cuts nothing off"""
_ROWS, _SEED = 64, 6

Arrays = dict[str, np.ndarray]


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
    def weights(self) -> dict[str, Tensor]:
        """Arrays of ``policy.safetensors`` by the names that ``run_policy.py`` knows."""

    @torch.inference_mode()
    def said(self, rows: Arrays) -> Arrays:
        """Outputs by name for rows of the inputs, in their order."""
        found = self(*(torch.from_numpy(part) for part in rows.values()))
        return {name: part.numpy() for name, part in zip(self.outputs, found, strict=True)}


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
            step = 0.1 * std[:N_TARGET] * torch.randn(count, N_TARGET, generator=rng)
            obs[:, :N_TARGET] = last[:, :N_TARGET] + step
        for row, column, bad in ((0, 0, math.nan), (1, -1, math.inf), (1, n_obs // 2, -math.inf)):
            obs[row, column], last[-1 - row, column] = bad, bad
        action = torch.randn(count, NUM_ACTIONS, generator=rng)
        return obs, last, action, torch.arange(count) > 0

    def weights(self) -> dict[str, Tensor]:
        """Networks, and what they scale by."""
        policy, world = self.policy, self.world_model
        norms = {"norm": policy.observation_norm}
        nets = {"actor": policy.actor, "critic": policy.critic}
        if world is not None:
            norms["world_norm"] = world.observation_norm
            nets |= {"encoder": world.encoder, "dynamics": world.dynamics, "decoder": world.decoder}
        found = {"value.mean": policy.value_norm.mean, "value.std": policy.value_norm.std()}
        for name, norm in norms.items():
            limit = torch.tensor([norm.clip if float(norm.count) > 0 else NO_LIMIT])
            found |= {f"{name}.mean": norm.mean, f"{name}.scale": 1.0 / norm.std(), f"{name}.limit": limit}
        for name, net in nets.items():
            found |= {f"{name}.{key}": tensor for key, tensor in net.state_dict().items()}
        return found


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

    def weights(self) -> dict[str, Tensor]:
        """The actor's layers."""
        return {f"actor.{name}": tensor for name, tensor in self.actor.net.state_dict().items()}


def module_of(checkpoint: Checkpoint) -> ExportedModule:
    """What of a checkpoint drives. Raises CheckpointError where nothing does."""
    if checkpoint.config.learner == "ppo" and checkpoint.config.encoder == "set":
        return OneWish(actor_of(checkpoint)).eval()
    agent = load_agent(checkpoint, 1)
    return OneAction(agent.policy, agent.world_model).eval()


def weights_of(module: ExportedModule) -> dict[str, Tensor]:
    """Arrays by name, float32, on the host, contiguous."""
    found = module.weights().items()
    return {name: tensor.detach().float().cpu().contiguous().clone() for name, tensor in found}


def golden_of(module: ExportedModule) -> Arrays:
    """``pair_<input>`` and ``pair_<output>``, 64 rows of made-up inputs and what the module says to them."""
    made_up = module.rows(_ROWS, torch.Generator().manual_seed(_SEED))
    inputs = {name: tensor.numpy() for name, tensor in zip(module.inputs, made_up, strict=True)}
    return {f"pair_{name}": array for name, array in (inputs | module.said(inputs)).items()}


# ------------------------------------------------------------------------------------------------------- ONNX


def missing_packages() -> list[str]:
    """What has to be installed before an ONNX graph can be written; empty = nothing."""
    return [name for name in PACKAGES if importlib.util.find_spec(name) is None]


def onnx_bytes(module: ExportedModule) -> bytes:
    """The ONNX graph with its weights inside, any number of rows at once. Needs PACKAGES."""
    without_telemetry()
    rows, obstacles = torch.export.Dim("rows", min=1), torch.export.Dim("obstacles", min=1)
    sizes = {name: {0: rows, 1: obstacles} if name == "obstacles" else {0: rows} for name in module.inputs}
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)  # the exporter talks on every channel; what it cannot do it raises
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            program = torch.onnx.export(
                module,
                module.rows(2, torch.Generator().manual_seed(_SEED)),
                input_names=list(module.inputs),
                output_names=list(module.outputs),
                dynamic_shapes=sizes,
                opset_version=OPSET,
                dynamo=True,
                verbose=False,
            )
    finally:
        logging.disable(before)
    assert program is not None
    return program.model_proto.SerializeToString()
