"""The networks of a pilot as float32 arrays under plain names, with everything that they scale by: what
``run_policy.py`` computes with."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor, nn

from uuvtai.learn.normalise import RunningNorm
from uuvtai.learn.pilot import Pilot
from uuvtai.learn.policy import ActorCritic
from uuvtai.learn.world_model import WorldModel

NO_LIMIT = float(torch.finfo(torch.float32).max)
"""of a normaliser that has seen nothing and therefore cuts nothing off"""


def weights_of(pilot: Pilot) -> dict[str, Tensor]:
    """Arrays of policy and world model, on the host, contiguous."""
    found = dict(_policy(pilot.policy))
    if pilot.world_model is not None:
        found |= dict(_world_model(pilot.world_model))
    return {name: tensor.detach().cpu().contiguous().clone() for name, tensor in found.items()}


def _policy(policy: ActorCritic) -> Iterator[tuple[str, Tensor]]:
    yield from _net("actor", policy.actor)
    yield from _net("critic", policy.critic)
    yield from _norm("norm", policy.observation_norm)
    yield "value.mean", policy.value_norm.mean.float()
    yield "value.std", policy.value_norm.std().float()


def _world_model(world_model: WorldModel) -> Iterator[tuple[str, Tensor]]:
    for name in ("encoder", "dynamics", "decoder"):
        yield from _net(name, getattr(world_model, name))
    yield from _norm("world_norm", world_model.observation_norm)
    yield "target.scale", world_model.scale()
    yield (
        "target.base",
        world_model.base(torch.zeros(world_model.n_obs, device=world_model.change_norm.mean.device)),
    )
    yield "change.unit", world_model.error_unit()


def _net(name: str, net: nn.Module) -> Iterator[tuple[str, Tensor]]:
    for key, tensor in net.state_dict().items():
        yield f"{name}.{key}", tensor.float()


def _norm(name: str, norm: RunningNorm) -> Iterator[tuple[str, Tensor]]:
    yield f"{name}.mean", norm.mean.float()
    yield f"{name}.scale", (1.0 / norm.std()).float()
    yield f"{name}.limit", torch.tensor([norm.clip if float(norm.count) > 0 else NO_LIMIT])
