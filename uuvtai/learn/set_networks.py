"""The networks of a checkpoint that learnt in the twin or to forecast: made, filled, checked."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import TypeVar

import torch
from torch import nn

from uuvtai.learn.checkpoint import Checkpoint
from uuvtai.learn.manifest import MODEL, CheckpointError
from uuvtai.learn.mixture_net import MixtureNet
from uuvtai.learn.set_policy import SetActor
from uuvtai.twin.set_codes import BODY_WIDTH, EGO_COLUMNS

Net = TypeVar("Net", bound=nn.Module)


def actor_of(checkpoint: Checkpoint) -> SetActor:
    """The policy over a set of bodies. Raises CheckpointError where its networks are not those of its
    config."""
    config = checkpoint.config
    wide, head = config.twin.body_hidden, config.twin.head_hidden
    with _refused(checkpoint):
        part = checkpoint.model()["policy"]
        for name, shape in (
            ("net.body.0.weight", (wide, BODY_WIDTH)),
            ("net.head.0.weight", (head, 3 * wide)),
        ):
            if tuple(part[name].shape) != shape:
                raise ValueError(f"{name} is {tuple(part[name].shape)} instead of {shape}")
        actor = SetActor(BODY_WIDTH, EGO_COLUMNS, config, torch.Generator())
        actor.load_state_dict(part)
    return _finite(actor, checkpoint)


def mixture_net_of(checkpoint: Checkpoint) -> MixtureNet:
    """A learned forecast. Raises as ``actor_of``."""
    with _refused(checkpoint):
        net = MixtureNet(torch.Generator())
        net.load_state_dict(checkpoint.model()["forecast"])
    return _finite(net, checkpoint)


@contextlib.contextmanager
def _refused(checkpoint: Checkpoint) -> Iterator[None]:
    """Turn what networks of another shape raise into a CheckpointError."""
    try:
        yield
    except CheckpointError:
        raise
    except (KeyError, ValueError, RuntimeError, TypeError, AttributeError) as error:
        raise CheckpointError(
            f"{checkpoint.path / MODEL}: its networks are not those of its config ({error}); take another one"
        ) from None


def _finite(net: Net, checkpoint: Checkpoint) -> Net:
    for name, tensor in net.state_dict().items():
        if not bool(torch.isfinite(tensor).all()):
            raise CheckpointError(
                f"{checkpoint.path / MODEL}: {name} is not finite: the training failed; take an older "
                "checkpoint"
            )
    return net.eval()
