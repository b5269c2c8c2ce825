"""How good a forecast of several futures is: likelihood and distances."""

from __future__ import annotations

import torch

from uuvtai.learn.mixture_net import Mixture, negative_log_likelihood


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
