"""Running mean and deviation in float64, merged batch by batch exactly (Chan, Golub, LeVeque 1979), and the
scaling they give."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import nn

_ROWS_AT_ONCE = 2048
"""a float64 copy of a whole rollout would not fit the caches"""
MIN_STD = 1e-2
"""a column's deviation counts as at least this much (in its own unit): a constant column must not become
noise"""


@dataclass(frozen=True)
class Moments:
    """Moments of samples of ``width`` columns, float64."""

    mean: torch.Tensor
    """(width,)"""
    m2: torch.Tensor
    """(width,), sum of squared differences from the mean"""
    count: torch.Tensor
    """(), number of samples"""


def moments_of(x: torch.Tensor) -> Moments:
    """Moments of the rows of x (..., width); a row that is not finite in every column is left out."""
    rows = x.detach().reshape(-1, x.shape[-1])
    kept = torch.isfinite(rows.sum(dim=1))
    if not bool(kept.all()):
        rows = rows[kept]
    width = rows.shape[1]
    zeros = torch.zeros(2 * width + 1, dtype=torch.float64, device=x.device)
    total = Moments(zeros[:width], zeros[width:-1], zeros[-1])
    for first in range(0, len(rows), _ROWS_AT_ONCE):
        total = combined(total, _moments_of_part(rows[first : first + _ROWS_AT_ONCE].double()))
    return total


def _moments_of_part(rows: torch.Tensor) -> Moments:
    mean = rows.mean(dim=0)
    return Moments(mean, (rows - mean).square().sum(dim=0), rows.new_tensor(float(len(rows))))


def combined(a: Moments, b: Moments) -> Moments:
    """Moments of the samples of both, as if they had been taken together (Chan et al., equation 1.5)."""
    count = a.count + b.count
    share = b.count / count.clamp(min=1.0)
    difference = b.mean - a.mean
    return Moments(a.mean + share * difference, a.m2 + b.m2 + difference.square() * (a.count * share), count)


class RunningNorm(nn.Module):
    """Scales columns to mean 0 and deviation 1 by the moments of all samples seen so far; before the first
    one it changes nothing."""

    mean: torch.Tensor
    m2: torch.Tensor
    count: torch.Tensor

    def __init__(self, width: int, clip: float = 10.0) -> None:
        """``clip``: normalised values are cut off beyond +-clip."""
        super().__init__()
        self.clip = clip
        self.register_buffer("mean", torch.zeros(width, dtype=torch.float64))
        self.register_buffer("m2", torch.zeros(width, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    @property
    def moments(self) -> Moments:
        """Of all samples so far."""
        return Moments(self.mean, self.m2, self.count)

    def update(self, x: torch.Tensor) -> None:
        """Add the rows of x (..., width); rows that are not finite are left out."""
        self.merge(moments_of(x))

    def merge(self, moments: Moments) -> None:
        """Add samples whose moments are known."""
        united = combined(self.moments, moments)
        self.mean.copy_(united.mean)
        self.m2.copy_(united.m2)
        self.count.copy_(united.count)

    def std(self) -> torch.Tensor:
        """(width,) deviation, float64, at least ``MIN_STD``; 1 before the first sample."""
        variance = torch.where(self.count > 0, self.m2 / self.count.clamp(min=1.0), 1.0)
        return variance.sqrt().clamp(min=MIN_STD)

    def forward(self, x: torch.Tensor, out: torch.Tensor | None = None) -> torch.Tensor:
        """Normalised x (..., width), float32, within +-clip; what is not a number becomes 0, the mean.

        ``out``: written to instead of a new tensor.
        """
        y = torch.sub(x, self.mean.float(), out=out)
        limit = torch.where(self.count > 0, self.clip, math.inf).float()
        y.mul_((1.0 / self.std()).float()).clamp_(-limit, limit)
        return y.nan_to_num_(nan=0.0, posinf=self.clip, neginf=-self.clip)

    def inverse(self, y: torch.Tensor) -> torch.Tensor:
        """The x whose normalised value is y (..., width), float32."""
        return torch.addcmul(self.mean.float(), y, self.std().float())
