"""How good is the learned forecast, beside others? ``python -m docs.writers.forecasts`` plays episodes that
no training met and compares what was forecast for every tracked body with what it then did.

Writes ``docs/data/forecasts.json`` and the plot of its reliability, ``docs/forecasts.png``; ``--draw`` draws
anew what is kept. All forecasts are of the same moments, and the tree drives without heeding any but the one
by arcs and habits. The others say places and no spread: they get the one spread for each time, along and
across the course, that makes the first half of the episodes' moments likeliest; all are judged by the second
half.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from typing import TYPE_CHECKING, Any

from docs.writers.evaluations import commit_of_package
from docs.writers.figure_sources import ROOT
from uuvtai.run_folder import write_atomic

if TYPE_CHECKING:
    import torch

    from uuvtai.learn.mixture_net import Mixture, MixtureNet
    from uuvtai.learn.track_futures import TrackMoments

KEPT, PICTURE = ROOT / "docs/data/forecasts.json", ROOT / "docs/forecasts.png"
SEED, EPISODES = 78001, 256
FAST = (8, 9, 1.5)
CELLS = (
    ("pool (8, 9, 1.5)", "pool", FAST), ("gauntlet (8, 9, 1.5)", "gauntlet", FAST),
    ("transfer (5, 4, 0.6), not trained in", "transfer", (5, 4, 0.6)),
)  # fmt: skip
TURN_BACK_S = (0.5, 1.2, 2.2)
_DRAWS, _STEPS = 200, 1500


def played(world: str, scene: tuple[int, int, float]) -> TrackMoments:
    """Moments of this world's episodes, with the analytic futures, which the tree does not heed."""
    from uuvtai.learn.track_futures import watch
    from uuvtai.loader import load_config
    from uuvtai.sim import Sim
    from uuvtai.tree import read_tree

    changes = {
        "world.n_static": scene[0], "world.n_dynamic": scene[1], "world.dynamic_speed_m_s": scene[2],
        "forecast.keep_columns": True, "forecast.turn_back_s": list(TURN_BACK_S), "teacher.least_share": 0.99,
    }  # fmt: skip
    sim = Sim(load_config(world, None, overrides=changes), EPISODES, read_tree("bt"), "cpu")
    return watch(sim, (scene,), SEED, 0, _STEPS)[0]


def others(seen: TrackMoments) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    """(log weights (n, m), places (n, m, ANCHORS, 2) [m]) by the name of each forecast without a spread."""
    import torch

    from uuvtai.learn.mixture_net import TIMES_S

    speed = seen.frame[:, 4, None]
    ahead = torch.stack([speed * TIMES_S, torch.zeros(len(speed), len(TIMES_S))], -1)
    certain = torch.zeros(len(speed), 1)
    left = (1.0 - seen.share.sum(-1, keepdim=True)).clamp(min=0.0)
    share = torch.cat([left, seen.share], -1)
    places = torch.cat([seen.forecast[:, None], seen.future], 1)
    return {
        "constant velocity": (certain, ahead[:, None]),
        "arcs and habits": (certain, seen.forecast[:, None]),
        "with turns back": ((share / share.sum(-1, keepdim=True)).clamp(min=1e-9).log(), places),
    }


def with_spread(log_weight: torch.Tensor, place: torch.Tensor, truth: torch.Tensor) -> Mixture:
    """The mixture whose one spread for each time makes the first half of the moments likeliest."""
    import torch

    from uuvtai.learn.mixture_net import Mixture, negative_log_likelihood

    half = len(truth) // 2
    log_sigma = torch.zeros(*truth.shape[1:], requires_grad=True)
    optimiser = torch.optim.Adam([log_sigma], 0.05)

    def mixture(rows: slice) -> Mixture:
        sigma = log_sigma.exp().expand_as(place[rows])
        return Mixture(log_weight[rows], place[rows], sigma)

    for _ in range(200):
        optimiser.zero_grad()
        negative_log_likelihood(mixture(slice(0, half)), truth[:half]).mean().backward()
        optimiser.step()
    with torch.no_grad():
        return mixture(slice(half, None))


def judged(seen: TrackMoments, net: MixtureNet) -> dict[str, Any]:
    """Scores of every forecast, and the reliability of the learned one."""
    import torch

    from uuvtai.learn.forecast_scores import coverage_of, nearest_way, reliability_of, scores_of

    half = len(seen.truth) // 2
    truth, generator = seen.truth[half:], torch.Generator().manual_seed(0)
    found = {name: with_spread(*parts, seen.truth) for name, parts in others(seen).items()}
    with torch.no_grad():
        learned = net(seen.columns[half:], seen.frame[half:, 4])
    methods = {}
    for name, mixture in {**found, "learned": learned}.items():
        scores = {key: round(value, 4) for key, value in scores_of(mixture, truth).items()}
        cover = [round(value, 4) for value in coverage_of(mixture, truth, _DRAWS, generator)]
        methods[name] = {**scores, "coverage": cover}
    came = torch.nn.functional.one_hot(nearest_way(learned, truth), learned.log_weight.shape[1])
    rows = reliability_of(learned.log_weight.exp().flatten(), came.flatten())
    bins = [[round(mean, 4), round(share, 4), count] for mean, share, count in rows]
    return {"moments": len(truth), "methods": methods, "reliability": bins}


def drawn(kept: dict[str, Any]) -> bytes:
    """PNG: for every bin of a future's probability the share of such futures that came, a line a cell."""
    import io

    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panel = pyplot.subplots(figsize=(5.2, 4.8), layout="constrained")
    panel.plot([0, 1], [0, 1], color="#7a7d80", linewidth=1, linestyle="--", label="as forecast")
    for cell, mark in zip(kept["cells"], "osv^Dx", strict=False):
        bins = [row for row in cell["reliability"] if row[2] >= 30]
        label = f"{cell['cell']}"
        panel.plot([row[0] for row in bins], [row[1] for row in bins], marker=mark, ms=4.5, lw=1, label=label)
    panel.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
    panel.set_xlabel("forecast probability of a future")
    panel.set_ylabel("share of such futures that were the nearest to what came")
    panel.grid(alpha=0.2)
    panel.legend(frameon=False, loc="upper left", fontsize=8)
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=100, facecolor="white", metadata={"Software": None})
    return out.getvalue()


def network(learned: str) -> MixtureNet:
    """The network that ``forecast.learned`` names."""
    import torch

    from uuvtai.learn.mixture_net import MixtureNet
    from uuvtai.mixture_weights import read_weights

    net = MixtureNet(torch.Generator())
    net.take_weights(read_weights(learned))
    return net


def main(arguments: list[str] | None = None) -> int:
    """Play, keep and draw."""
    parser = argparse.ArgumentParser(prog="python -m docs.writers.forecasts", description="see the module")
    parser.add_argument("learned", nargs="?", default="shipped", help="as the key forecast.learned")
    parser.add_argument("--draw", action="store_true", help="draw what is kept")
    chosen = parser.parse_args(arguments)
    if not chosen.draw:
        net = network(chosen.learned)
        document: dict[str, Any] = {
            "schema": 1,
            "seed": SEED,
            "episodes": EPISODES,
            "levels": [],
            "cells": [],
        }
        from uuvtai.learn.forecast_scores import LEVELS

        document |= {"levels": list(LEVELS), "turn_back_s": list(TURN_BACK_S), "commit": commit_of_package()}
        for title, world, scene in CELLS:
            document["cells"].append({"cell": title, **judged(played(world, scene), net)})
            write_atomic(KEPT, (json.dumps(document, indent=1) + "\n").encode())
            print(title, flush=True)
    PICTURE.write_bytes(drawn(json.loads(KEPT.read_text(encoding="utf-8"))))
    return 0


if __name__ == "__main__":
    os.environ.setdefault("UUV_NUM_THREADS", "1")
    sys.exit(main())
