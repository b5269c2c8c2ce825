"""Running mean and deviation in float64, merged batch by batch exactly (Chan, Golub, LeVeque 1979), and the scaling they give."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import nn

MIN_STD = 1e-2
"""a column's deviation counts as at least this much (in its own unit): a constant column must not become noise"""


class Moments(NamedTuple):
    """Moments of samples of ``width`` columns, float64."""

    mean: torch.Tensor
    """(width,)"""
    m2: torch.Tensor
    """(width,), sum of squared differences from the mean"""
    samples: torch.Tensor
    """(), how many"""


def moments_of(x: torch.Tensor) -> Moments:
    """Moments of the rows of x (..., width); a row that is not finite in every column is left out."""
    rows = x.detach().reshape(-1, x.shape[-1])
    kept = torch.isfinite(rows.sum(dim=1))
    if not bool(kept.all()):
        rows = rows[kept]
    count = torch.tensor(float(len(rows)), dtype=torch.float64, device=x.device)
    mean, m2 = (torch.zeros(x.shape[-1], dtype=torch.float64, device=x.device) for _ in range(2))
    for part in rows.split(_ROWS_AT_ONCE):  # a float64 copy of a whole rollout would not fit the caches
        merged = combined(Moments(mean, m2, count.new_tensor(0.0)), _moments_of_part(part.double()))
        mean, m2 = merged.mean, merged.m2
    return Moments(mean, m2, count)


def _moments_of_part(rows: torch.Tensor) -> Moments:
    mean = rows.mean(dim=0)
    return Moments(mean, (rows - mean).square().sum(dim=0), rows.new_tensor(float(len(rows))))


_ROWS_AT_ONCE = 2048


def combined(a: Moments, b: Moments) -> Moments:
    """Moments of the samples of both, as if they had been taken together (Chan et al., equation 1.5)."""
    samples = a.samples + b.samples
    share = b.samples / samples.clamp(min=1.0)
    difference = b.mean - a.mean
    return Moments(a.mean + share * difference, a.m2 + b.m2 + difference.square() * (a.samples * share), samples)


class RunningNorm(nn.Module):
    """Scales columns to mean 0 and deviation 1 by the moments of all samples seen so far; before the first one it changes nothing."""

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

    def merge(self, other: Moments) -> None:
        """Add samples whose moments are known, for example those of all processes together."""
        for buffer, value in zip(self.moments, combined(self.moments, other), strict=True):
            buffer.copy_(value)

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
