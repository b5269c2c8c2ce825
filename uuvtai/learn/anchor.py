"""Anchor of a warm-started policy: KL divergence from what it was, a penalty that fades (kickstarting,
Schmitt et al. 2018, arXiv 1803.03835)."""

from __future__ import annotations

import copy

import torch

from uuvtai.learn.set_policy import SetActor


class Anchor:
    """The policy as it was when learning began."""

    def __init__(self, actor: SetActor, weight: float, until: float) -> None:
        """``weight`` at first; 0 from this share of the run on."""
        self.actor = copy.deepcopy(actor).requires_grad_(False)
        self._weight, self._until = weight, until

    def weight(self, share: float) -> float:
        """Of the penalty, falling linearly over the share of the run."""
        return self._weight * max(0.0, 1.0 - share / self._until)

    def divergence(
        self, mean: torch.Tensor, log_std: torch.Tensor, bodies: torch.Tensor, own: torch.Tensor
    ) -> torch.Tensor:
        """(n,) KL(policy || anchor) [nats] of diagonal Gaussians; means (n, 3), log deviations (3,)."""
        return gaussian_kl(mean, log_std, self.actor(bodies, own), self.actor.log_std)


def gaussian_kl(
    mean: torch.Tensor, log_std: torch.Tensor, other_mean: torch.Tensor, other_log_std: torch.Tensor
) -> torch.Tensor:
    """(...,) KL(N(mean, std) || N(other)) [nats], diagonal; (..., n) each."""
    spread = (2.0 * (log_std - other_log_std)).exp()
    far = (mean - other_mean).square() * (-2.0 * other_log_std).exp()
    return (other_log_std - log_std + 0.5 * (spread + far - 1.0)).sum(dim=-1)
