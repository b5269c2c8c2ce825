"""How far predicted spreads and probabilities can be believed: residuals, coverage, reliability, Brier, ECE
and rank statistics.

Pure functions of tensors, computed in float64. Bad shapes and samples that a figure is not defined for raise
ValueError.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor


def standardised_residual(mean: Tensor, log_var: Tensor, target: Tensor) -> Tensor:
    """(target - mean) in predicted standard deviations, float64, same shape."""
    return (target.double() - mean.double()) * torch.exp(-0.5 * log_var.double())


def mean_squared_standardised_residual(mean: Tensor, log_var: Tensor, target: Tensor) -> float:
    """1 where predicted variances are right on average; above 1: too sure of itself."""
    return float(standardised_residual(mean, log_var, target).square().mean())


def coverage(mean: Tensor, log_var: Tensor, target: Tensor, levels: Tensor) -> Tensor:
    """Share of targets inside the central Gaussian interval of each nominal level, (n_level,): equals
    ``levels`` if calibrated."""
    if bool(((levels <= 0) | (levels >= 1)).any()):
        raise ValueError(f"coverage levels must lie between 0 and 1, got {levels.tolist()}")
    size = standardised_residual(mean, log_var, target).abs().flatten()
    half_width = math.sqrt(2.0) * torch.erfinv(levels.double())
    return torch.stack([(size <= width).double().mean() for width in half_width])


# ---------------------------------------------------------------------------------- probabilities of an event


class Reliability(NamedTuple):
    """Reliability diagram: one entry per bin that holds a sample, each (n_filled,) float64."""

    samples: Tensor
    predicted: Tensor
    """mean probability in the bin"""
    observed: Tensor
    """share of events in the bin"""


def reliability(probability: Tensor, event: Tensor, bins: int) -> Reliability:
    """Reliability diagram over ``bins`` bins of equal width in [0, 1]; empty bins are left out."""
    p, y = _forecast(probability, event)
    index = (p * bins).long().clamp_(max=bins - 1)
    count = torch.bincount(index, minlength=bins).double()
    filled = count > 0
    total_p, total_y = (torch.bincount(index, weights=value, minlength=bins)[filled] for value in (p, y))
    return Reliability(count[filled], total_p / count[filled], total_y / count[filled])


def expected_calibration_error(probability: Tensor, event: Tensor, bins: int) -> float:
    """Mean gap between predicted and observed frequency over the bins, weighted by their samples (Naeini
    2015)."""
    diagram = reliability(probability, event, bins)
    return float(
        (diagram.samples * (diagram.predicted - diagram.observed).abs()).sum() / diagram.samples.sum()
    )


def brier(probability: Tensor, event: Tensor) -> float:
    """Mean squared error of the probability (Brier 1950); predicting the base rate r always gives r (1 -
    r)."""
    p, y = _forecast(probability, event)
    return float((p - y).square().mean())


# -------------------------------------------------------------------------------------------- rank statistics


def average_rank(value: Tensor) -> Tensor:
    """Ranks from 1 of a 1-D tensor, float64; ties share the mean of their ranks."""
    _unique, inverse, count = torch.unique(value.double(), return_inverse=True, return_counts=True)
    last = torch.cumsum(count, 0).double()
    return (last - 0.5 * (count.double() - 1.0))[inverse]


def auroc(score: Tensor, event: Tensor) -> float:
    """Probability that an event's score exceeds a non-event's, ties counting half (area under the ROC
    curve)."""
    y = _column(event) > 0
    _same_length(score, event)
    n_event, n_other = int(y.sum()), int((~y).sum())
    if n_event == 0 or n_other == 0:
        raise ValueError(f"AUROC needs both outcomes: {n_event} events and {n_other} non-events were given")
    rank_sum = float(average_rank(_column(score))[y].sum())
    return (rank_sum - 0.5 * n_event * (n_event + 1)) / (n_event * n_other)


def spearman(a: Tensor, b: Tensor) -> float:
    """Spearman's rank correlation, ties by average ranks; in [-1, 1]."""
    _same_length(a, b)
    x, y = (average_rank(_column(value)) for value in (a, b))
    x, y = x - x.mean(), y - y.mean()
    spread = x.square().sum() * y.square().sum()
    if float(spread) <= 0.0:
        raise ValueError("rank correlation needs two samples that vary; one of them is constant")
    return float((x * y).sum() / spread.sqrt())


def _forecast(probability: Tensor, event: Tensor) -> tuple[Tensor, Tensor]:
    """(probability, event) as float64 columns after checks."""
    _same_length(probability, event)
    p, y = _column(probability).double(), _column(event).double()
    if p.numel() == 0:
        raise ValueError("no samples to judge probabilities by")
    if not bool(((p >= 0) & (p <= 1)).all()):
        raise ValueError("probabilities must lie in [0, 1] and be finite")
    if not bool(((y == 0) | (y == 1)).all()):
        raise ValueError("events must be 0 or 1")
    return p, y


def _column(value: Tensor) -> Tensor:
    return value.detach().flatten()


def _same_length(a: Tensor, b: Tensor) -> None:
    if a.numel() != b.numel():
        raise ValueError(f"samples must pair up: shapes {tuple(a.shape)} and {tuple(b.shape)}")
