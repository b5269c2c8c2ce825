"""How good a forecast of several futures is: likelihood, distances, coverage and reliability."""

from __future__ import annotations

import math

import torch

from uuvtai.learn.mixture_net import Mixture, negative_log_likelihood

LEVELS = (0.5, 0.8, 0.9, 0.95)
"""probabilities of the regions whose coverage is asked"""
BINS = 10


def scores_of(mixture: Mixture, truth: torch.Tensor) -> dict[str, float]:
    """Means over n tracks of ``truth`` (n, ANCHORS, 2) [m]: nats of the likelihood; median and 90 % quantile
    [m] of the distance at the last time, of the likeliest future and of the nearest; how probable the
    likeliest future is said to be, and how often it is the nearest."""
    last = (mixture.place[:, :, -1] - truth[:, None, -1]).norm(dim=-1)
    likeliest = mixture.log_weight.argmax(-1)
    one = last.gather(1, likeliest[:, None])[:, 0]
    return {
        "nll": float(negative_log_likelihood(mixture, truth).mean()),
        "likeliest_median_m": float(one.median()),
        "likeliest_p90_m": float(one.quantile(0.9)),
        "nearest_median_m": float(last.amin(-1).median()),
        "nearest_p90_m": float(last.amin(-1).quantile(0.9)),
        "likeliest_said": float(mixture.log_weight.amax(-1).exp().mean()),
        "likeliest_right": float((nearest_way(mixture, truth) == likeliest).float().mean()),
    }


def nearest_way(mixture: Mixture, truth: torch.Tensor) -> torch.Tensor:
    """(n,) which future's whole way is nearest to what came, by its mean distance."""
    return (mixture.place - truth[:, None]).norm(dim=-1).mean(-1).argmin(-1)


def coverage_of(mixture: Mixture, truth: torch.Tensor, draws: int, generator: torch.Generator) -> list[float]:
    """For each of ``LEVELS``: share of the tracks that are, at the last time, within the region of highest
    density that holds so much probability, which ``draws`` from each mixture find."""
    place, sigma = mixture.place[:, :, -1], mixture.sigma[:, :, -1]
    which = torch.multinomial(mixture.log_weight.exp(), draws, replacement=True, generator=generator)
    pick = which[..., None].expand(-1, -1, 2)
    drawn = place.gather(1, pick) + sigma.gather(1, pick) * torch.randn(*which.shape, 2, generator=generator)
    there = _log_density(mixture.log_weight, place, sigma, truth[:, None, -1])
    denser = (_log_density(mixture.log_weight, place, sigma, drawn) > there).float().mean(-1)
    return [float((denser <= level).float().mean()) for level in LEVELS]


def _log_density(
    log_weight: torch.Tensor, place: torch.Tensor, sigma: torch.Tensor, at: torch.Tensor
) -> torch.Tensor:
    """(n, m) at places (n, m, 2) of mixtures over one time."""
    off = (at[:, :, None] - place[:, None]) / sigma[:, None]
    each = -(0.5 * off * off + sigma[:, None].log() + 0.5 * math.log(2.0 * math.pi)).sum(-1)
    return torch.logsumexp(log_weight[:, None] + each, -1)


def reliability_of(probability: torch.Tensor, came: torch.Tensor) -> list[tuple[float, float, int]]:
    """(mean probability, share that came, count) in ``BINS`` bins of the probability; empty ones are left
    out."""
    of_bin = (probability * BINS).long().clamp(max=BINS - 1)
    rows = []
    for nth in range(BINS):
        inside = of_bin == nth
        if bool(inside.any()):
            rows.append(
                (float(probability[inside].mean()), float(came[inside].float().mean()), int(inside.sum()))
            )
    return rows
