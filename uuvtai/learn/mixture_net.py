"""The network of a learned forecast, its likelihood, and what it says in metres.

A mixture of ``N_MODE`` Gaussians over the places at ``ANCHORS`` times, along and across the track's course
(Bishop 1994). Each future is a whole way: its places share one weight.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import nn

from uuvtai.forecast_codes import (
    ANCHOR_S,
    ANCHORS,
    FAR_COLUMNS,
    N_COLUMN,
    N_HIDDEN,
    N_MODE,
    N_SAID,
    N_SPREAD,
    N_TOLD,
    SIDE_COLUMNS,
)
from uuvtai.learn.mlp import linear

TIMES_S = torch.arange(1, ANCHORS + 1) * ANCHOR_S
"""[s] ahead, of the places that it tells"""
_LEAST_M, _MOST = 0.03, 4.0
"""[m] smallest deviation; largest, as a part of the way that a body can go"""
_HALF_LOG_TAU = 0.5 * math.log(2.0 * math.pi)


class Mixture(NamedTuple):
    """What may come of n tracks, in their frames."""

    log_weight: torch.Tensor
    """(n, N_MODE) logarithm of the probability of each future"""
    place: torch.Tensor
    """(n, N_MODE, ANCHORS, 2) [m] along and across the course"""
    sigma: torch.Tensor
    """(n, N_MODE, ANCHORS, 2) [m] standard deviations"""


class MixtureNet(nn.Module):
    """Columns of a track to its futures: two hidden layers of rectified units."""

    def __init__(self, generator: torch.Generator) -> None:
        super().__init__()
        gain = math.sqrt(2.0)
        self.into = linear(N_COLUMN, N_HIDDEN, gain, generator)
        self.middle = linear(N_HIDDEN, N_HIDDEN, gain, generator)
        self.said = linear(N_HIDDEN, N_TOLD, 0.1, generator)
        self.spread = linear(N_HIDDEN, N_SPREAD, 0.1, generator)
        with torch.no_grad():  # the futures begin apart: straight on, slower, back, left and right
            ways = torch.tensor([[1.0, 0.0], [0.3, 0.0], [-0.3, 0.0], [-0.8, 0.0], [0.5, 0.5], [0.5, -0.5]])
            self.said.bias[N_MODE:] = ways[:N_MODE, None].expand(-1, ANCHORS, -1).reshape(-1)
            self.spread.bias.fill_(math.log(0.3))

    def forward(self, columns: torch.Tensor, speed: torch.Tensor) -> Mixture:
        """``columns`` (n, N_COLUMN), ``speed`` (n,) [m/s]."""
        hidden = torch.relu(self.middle(torch.relu(self.into(columns))))
        said = self.said(hidden)
        reach = (speed[:, None] * TIMES_S)[:, None, :, None]
        place = said[:, N_MODE:].view(-1, N_MODE, ANCHORS, 2) * reach
        part = self.spread(hidden).view(-1, N_MODE, ANCHORS, 2).clamp(-6.0, math.log(_MOST)).exp()
        return Mixture(torch.log_softmax(said[:, :N_MODE], -1), place, _LEAST_M + part * reach)

    def weights(self) -> dict[str, np.ndarray]:
        """Arrays of a forecast's file (``mixture_weights``)."""
        out, bias = torch.zeros(N_HIDDEN, N_SAID), torch.zeros(N_SAID)
        out[:, :N_TOLD], bias[:N_TOLD] = self.said.weight.detach().T, self.said.bias.detach()
        found = {"weight_out": out, "bias_out": bias}
        for name, layer in self._layers().items():
            found |= {f"weight_{name}": layer.weight.T, f"bias_{name}": layer.bias}
        return {name: value.detach().contiguous().numpy().copy() for name, value in found.items()}

    def _layers(self) -> dict[str, nn.Linear]:
        """Those that are in the file as they are; the last one is padded there."""
        return {"in": self.into, "mid": self.middle, "spread": self.spread}


def negative_log_likelihood(mixture: Mixture, truth: torch.Tensor) -> torch.Tensor:
    """(n,) of the true places (n, ANCHORS, 2) [m] in the tracks' frames, in nats of all of them together."""
    off = (truth[:, None] - mixture.place) / mixture.sigma
    log_density = -(0.5 * off * off + mixture.sigma.log() + _HALF_LOG_TAU).sum((-1, -2))
    return -torch.logsumexp(mixture.log_weight + log_density, -1)


def mirrored(columns: torch.Tensor, truth: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The same tracks seen in a mirror along their course: left is right."""
    flip = torch.ones(N_COLUMN)
    flip[list(SIDE_COLUMNS)] = -1.0
    order = torch.arange(N_COLUMN)
    for one, other in FAR_COLUMNS:
        order[one], order[other] = other, one
    return (columns * flip)[:, order], truth * torch.tensor([1.0, -1.0])
