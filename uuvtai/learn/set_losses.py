"""Gradients of PPO's losses for a policy over a set of bodies, by pieces that several cores can take."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable
from typing import NamedTuple

import torch

from uuvtai.config.learning import LearningConfig
from uuvtai.learn.bfloat16 import in_bfloat16
from uuvtai.learn.policy import log_prob
from uuvtai.learn.ppo import approximate_kl, surrogate_loss
from uuvtai.learn.set_policy import SetActor, SetCritic
from uuvtai.learn.side_by_side import side_by_side

CACHE_ROWS = 2048
"""rows in one pass through the networks: nine bodies each"""


class Piece(NamedTuple):
    """What some rows of a minibatch of ``count`` rows add to it."""

    gradients: tuple[torch.Tensor, ...]
    sums: torch.Tensor
    """(4,) policy loss, value loss, KL, share clipped"""


class SetLosses:
    """Of one minibatch: clipped surrogate for the actor, value error for the critic."""

    def __init__(self, config: LearningConfig, actor: SetActor, critic: SetCritic) -> None:
        self._config, self._actor, self._critic = config, actor, critic

    def backward(self, rows: list[torch.Tensor], index: torch.Tensor) -> torch.Tensor:
        """Fill the parameters' gradients; (4,) sums as in ``Piece``.

        ``rows``: bodies, own, truth, action, log probability, advantage, target; ``index`` (M,) chooses the
        minibatch. Pieces are added up in their order, so that the number of threads changes no bit.
        """
        count = len(index)
        some = side_by_side(*(functools.partial(_chosen, rows, part) for part in index.split(CACHE_ROWS)))
        pieces: list[Callable[[], Piece]] = [
            functools.partial(of, samples, count)
            for samples in some
            for of in (self._of_actor, self._of_critic)
        ]
        found = side_by_side(*pieces)
        _add_up(self._critic, [piece.gradients for piece in found[1::2]])
        _add_up(self._actor, [piece.gradients for piece in found[::2]])
        sums = torch.zeros(4)
        for of_actor, of_critic in zip(found[::2], found[1::2], strict=True):
            sums += of_actor.sums + of_critic.sums
        return sums

    def _of_actor(self, samples: list[torch.Tensor], count: int) -> Piece:
        bodies, own, _, action, before, advantage, _ = samples
        clip = self._config.ppo.clip
        with coarse(self._config):
            mean = self._actor(bodies, own)
        log_ratio = log_prob(action, mean.float(), self._actor.log_std) - before
        policy_loss = surrogate_loss(log_ratio, advantage, clip).sum() / count
        gradients = torch.autograd.grad(policy_loss, list(self._actor.parameters()))
        with torch.no_grad():
            kl = approximate_kl(log_ratio).sum() / count
            clipped = ((log_ratio.exp() - 1.0).abs() > clip).sum() / count
            return Piece(gradients, torch.stack([policy_loss, torch.zeros(()), kl, clipped]))

    def _of_critic(self, samples: list[torch.Tensor], count: int) -> Piece:
        bodies, own, truth, *_, target = samples
        with coarse(self._config):
            value = self._critic(bodies, own, truth)
        value_loss = (value.float() - target).square().sum() / count
        loss = self._config.ppo.value_weight * value_loss
        gradients = torch.autograd.grad(loss, list(self._critic.parameters()))
        sums = torch.zeros(4)
        sums[1] = value_loss.detach()
        return Piece(gradients, sums)


def _chosen(rows: list[torch.Tensor], index: torch.Tensor) -> list[torch.Tensor]:
    """These samples, next to each other: both networks read them."""
    return [part[index] for part in rows]


def coarse(config: LearningConfig) -> torch.autocast:
    """Products in bfloat16 where ``ppo.bfloat16`` says so and the CPU can."""
    return torch.autocast("cpu", torch.bfloat16, enabled=in_bfloat16(config.ppo, "cpu"))


def _add_up(net: torch.nn.Module, pieces: list[tuple[torch.Tensor, ...]]) -> None:
    for parameter, *gradients in zip(net.parameters(), *pieces, strict=True):
        parameter.grad = functools.reduce(torch.add, gradients)


def by_part(net: torch.nn.Module, *parts: torch.Tensor, config: LearningConfig | None = None) -> torch.Tensor:
    """What a network says of many rows, ``CACHE_ROWS`` at a time; nothing of it can be learnt from. As
    coarsely as it learns where a config is given."""
    with torch.no_grad(), coarse(config) if config else contextlib.nullcontext():
        rows = zip(*(part.split(CACHE_ROWS) for part in parts), strict=True)
        return torch.cat([net(*some).float() for some in rows])
