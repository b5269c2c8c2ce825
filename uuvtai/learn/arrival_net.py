"""How likely the vehicle is to arrive if the behaviour tree drives on, and if a policy does: the network of a
chooser."""

from __future__ import annotations

import math

import torch
from torch import nn

from uuvtai.config.learning import LearningConfig
from uuvtai.learn.chooser_columns import APPROACH_WIDTH, wished, with_approach
from uuvtai.learn.set_policy import SetEncoder
from uuvtai.twin.set_codes import AT_WISH

TREE, POLICY = 0, 1
"""columns of what the network says"""
AT_TREE_VELOCITY = slice(6, 8)
"""of the tree's columns (``tree_columns``): velocity that it asks for"""
SLACK = 0.1
"""columns may leave what was seen in training by this part of its width"""


class ArrivalNet(nn.Module):
    """How likely the vehicle is to arrive, (n, 2): if the tree drives on, if the policy does.

    ``chooser.networks`` of one shape, whose probabilities are averaged: one alone may be wrong by luck.
    """

    least: torch.Tensor
    """(n_own + n_body,) smallest columns that it learnt from"""
    most: torch.Tensor
    """(n_own + n_body,) largest ones"""

    def __init__(
        self, n_body: int, n_own: int, n_tree: int, config: LearningConfig, generator: torch.Generator
    ) -> None:
        """Columns of a body, of the vehicle's own and of ``tree_columns``."""
        super().__init__()
        self._n_own, vehicle = n_own, config.vehicle
        n_own += n_tree
        self._fastest = math.hypot(vehicle.max_surge_m_s, vehicle.max_sway_m_s)
        self.nets = nn.ModuleList(
            SetEncoder(n_body + APPROACH_WIDTH, n_own, 2, config, 0.01, generator)
            for _ in range(config.chooser.networks)
        )
        self.register_buffer("least", torch.full((n_own + n_body,), math.inf))
        self.register_buffer("most", torch.full((n_own + n_body,), -math.inf))

    def forward(self, bodies: torch.Tensor, own: torch.Tensor) -> torch.Tensor:
        """(n, 2) probabilities for bodies (n, lanes, n_body) and own columns (n, n_own + n_tree)."""
        return self.logits(bodies, own).sigmoid().mean(0)

    def logits(self, bodies: torch.Tensor, own: torch.Tensor) -> torch.Tensor:
        """(networks, n, 2)."""
        tree = own[:, self._n_own :]
        policy = wished(tree[:, AT_WISH : AT_WISH + 2], self._fastest)
        seen = with_approach(bodies, tree[:, AT_TREE_VELOCITY], policy)
        return torch.stack([net(seen, own, seen[..., :1]) for net in self.nets])

    def knows(self, bodies: torch.Tensor, own: torch.Tensor) -> torch.Tensor:
        """(n,) whether every column lies within what it learnt from, and a little beyond."""
        slack = SLACK * (self.most - self.least)
        low, high = extremes(bodies, own)
        return torch.all((low >= self.least - slack) & (high <= self.most + slack), dim=-1)

    def widen(self, bodies: torch.Tensor, own: torch.Tensor) -> None:
        """Note columns that it learns from."""
        low, high = extremes(bodies, own)
        self.least.copy_(torch.minimum(self.least, low.amin(0)))
        self.most.copy_(torch.maximum(self.most, high.amax(0)))


def extremes(bodies: torch.Tensor, own: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """(n, n_own + n_body) each: own columns, and the bodies' smallest and largest ones."""
    return torch.cat([own, bodies.amin(-2)], -1), torch.cat([own, bodies.amax(-2)], -1)
