"""What of a checkpoint is exported where it learnt in the twin or to forecast: the networks that drive as
float32 arrays under plain names. No critic is among them, and nothing that the truth goes into."""

from __future__ import annotations

from collections.abc import Iterator

from torch import Tensor

from uuvtai.deploy.graph import ExportedModule
from uuvtai.deploy.set_graph import OneForecast, OneWish
from uuvtai.learn.checkpoint import Checkpoint
from uuvtai.learn.set_networks import actor_of, mixture_net_of


def kind_of(checkpoint: Checkpoint) -> str | None:
    """One of ``run_policy.KINDS``; None = a policy of one observation vector."""
    config = checkpoint.config
    if config.forecaster.enabled:
        return "forecast"
    return "set" if config.twin.enabled else None


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
