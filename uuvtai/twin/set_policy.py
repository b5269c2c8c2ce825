"""The policy over a set of bodies, and its critic, which may know their true future in training."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import nn

from uuvtai.twin.batch import TwinView
from uuvtai.twin.tensors import BODY_COLUMNS, EGO_COLUMNS, TRUE_COLUMNS

HOMING = 0.7
"""part of the cruise speed towards the goal that the network's output is added to"""
_SUM_SCALE = 0.3


class SetNet(nn.Module):
    """Network of a set of bodies and the vehicle's own row; the order of the bodies means nothing."""

    def __init__(self, n_body: int, n_out: int, width: int, head: int, gain: float) -> None:
        super().__init__()
        self.body, self.own = _layers(n_body, width, width), _layers(EGO_COLUMNS, width)
        self.head, self.out = _layers(3 * width, head, head), nn.Linear(head, n_out)
        nn.init.zeros_(self.out.bias)
        with torch.no_grad():
            self.out.weight.mul_(gain)

    def forward(self, body: torch.Tensor, row: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        """(n, n_out) for bodies (n, MOVERS, n_body), rows (n, EGO_COLUMNS); ``mask`` (n, MOVERS, 1) is 1
        where there is a body."""
        each = self.body(body) * mask
        return self.out(self.head(torch.cat([each.amax(-2), _SUM_SCALE * each.sum(-2), self.own(row)], -1)))


class SetActor(nn.Module):
    """The policy: nothing else is exported, and observations are all it takes."""

    def __init__(self, width: int = 48, head: int = 96) -> None:
        super().__init__()
        self.net = SetNet(BODY_COLUMNS, 3, width, head, 0.01)
        self.log_std = nn.Parameter(torch.full((3,), math.log(0.5)))

    def forward(self, body: torch.Tensor, row: torch.Tensor) -> torch.Tensor:
        """(n, 3) mean wish in parts of the limits, in the mirrored frame."""
        homing = HOMING * row[..., 3:5]
        return self.net(body, row, body[..., :1]) + nn.functional.pad(homing, (0, 1))


class SetCritic(nn.Module):
    """Expected return; sees the truth, so it never leaves training."""

    def __init__(self, width: int = 48, head: int = 96) -> None:
        super().__init__()
        self.net = SetNet(BODY_COLUMNS + TRUE_COLUMNS, 1, width, head, 1.0)

    def forward(self, view: TwinView) -> torch.Tensor:
        """(n,)"""
        mask = torch.maximum(view.true[..., 2:3], view.body[..., :1])
        return self.net(torch.cat([view.body, view.true], -1), view.row, mask).squeeze(-1)


def _layers(*widths: int) -> nn.Sequential:
    parts: list[nn.Module] = []
    for first, last in pairwise(widths):
        parts += [nn.Linear(first, last), nn.ReLU()]
    return nn.Sequential(*parts)
