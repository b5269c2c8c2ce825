"""The paper's timing table for one vehicle: every row, mean and max, and whether the loop keeps 50 Hz."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from uuvtai.config.learning import LearningConfig

if TYPE_CHECKING:
    from uuvtai.measure.profiling import Batch

PAPER_MS: dict[str, tuple[float, float | None]] = {
    "WM encoder": (0.015, None),
    "WM dynamics": (0.015, None),
    "WM decoder": (0.027, None),
    "PPO policy": (0.110, 0.127),
    "Mapping update": (3.33, 6.17),
    "Global planner": (5.22, 9.89),
    "Full loop": (28.63, 39.88),
}
"""(mean, max [ms]) of the paper's table "Workstation deployability timing", as printed (RTX 5090 workstation); None = not given"""
PAPER_REPLANS = {"paper_hz": 6.21, "paper_replans_per_episode": 52.1}
_CALLS, _WARM_CALLS = 2000, 200
_STAGES = {"Mapping update": ("mapping", "clearance"), "Global planner": ("planning",)}


def latency_rows(batch: Batch, config: LearningConfig, seconds: float) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Rows of the paper's table for a batch of one env, and the loop against its real-time budget.

    The loop is one control step driven by the tree, all stages; its stages are timed in every second step, the whole in the others, since
    waiting after every stage costs time itself.
    """
    loop, stages = _loop_samples(batch, seconds)
    rows = [_row(name, samples) for name, samples in (_networks_ms(config) | stages | {"Full loop": loop}).items()]
    if batch.episodes:
        rate = batch.replans / (batch.env_steps * config.episode.control_dt_s)
        rows.append(
            {
                "component": "Replanning rate",
                **dict.fromkeys(("mean_ms", "max_ms", "paper_mean_ms", "paper_max_ms")),
                "replans_per_episode": batch.replans / batch.episodes,
                "hz": rate,
                **PAPER_REPLANS,
            }
        )
    return rows, _real_time(loop, 1e3 * config.episode.control_dt_s)


def _row(name: str, samples_ms: list[float]) -> dict[str, Any]:
    paper_mean, paper_max = PAPER_MS[name]
    return {
        "component": name,
        "mean_ms": float(np.mean(samples_ms)),
        "max_ms": float(np.max(samples_ms)),
        "paper_mean_ms": paper_mean,
        "paper_max_ms": paper_max,
    }


def _real_time(loop_ms: list[float], budget_ms: float) -> dict[str, Any]:
    p50, p99 = (float(value) for value in np.quantile(loop_ms, (0.5, 0.99)))
    late = sum(value > budget_ms for value in loop_ms)
    return {
        "budget_ms": budget_ms, "p50_ms": p50, "p99_ms": p99, "max_ms": max(loop_ms), "steps": len(loop_ms), "late": late,
        "within": p99 < budget_ms,
    }  # fmt: skip


def _loop_samples(batch: Batch, seconds: float) -> tuple[list[float], dict[str, list[float]]]:
    """[ms] of whole steps, and of the stages that the table names."""
    sim = batch.sim
    loop: list[float] = []
    stages: dict[str, list[float]] = {name: [] for name in _STAGES}
    batch.replans = batch.episodes = batch.env_steps = 0
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or len(loop) < 2:
        sim.stage_s = {}
        batch.step()
        for name, parts in _STAGES.items():
            stages[name].append(1e3 * sum(sim.stage_s.get(part, 0.0) for part in parts))
        sim.stage_s = None
        begun = time.perf_counter()
        batch.step()
        loop.append(1e3 * (time.perf_counter() - begun))
    return loop, stages


def _networks_ms(config: LearningConfig) -> dict[str, list[float]]:
    """[ms] of one call of each network for one vehicle on the CPU, of the sizes that ``config`` gives; their weights do not matter."""
    from uuvtai.kernels.features import observation_width
    from uuvtai.learn.policy import Policy
    from uuvtai.learn.world_model import N_FEATURES, WorldModel

    generator, n_obs = torch.Generator().manual_seed(0), observation_width(config.features)
    model = WorldModel(n_obs, config.world_model, generator)
    policy = Policy(n_obs + N_FEATURES, config.policy.model_copy(update={"residual": False}), None, generator)
    obs, action, x = torch.randn(1, n_obs), torch.rand(1, 4), torch.randn(1, n_obs + N_FEATURES)
    latent = torch.randn(1, config.world_model.latent)
    calls: dict[str, Callable[[], Any]] = {
        "WM encoder": lambda: model.encode(obs),
        "WM dynamics": lambda: model.advance(latent, action),
        "WM decoder": lambda: model.decode(latent),
        "PPO policy": lambda: policy.distribution(x),
    }
    with torch.no_grad():
        return {name: _times_ms(call) for name, call in calls.items()}


def _times_ms(call: Callable[[], Any]) -> list[float]:
    samples = []
    for _ in range(_WARM_CALLS + _CALLS):
        begun = time.perf_counter()
        call()
        samples.append(1e3 * (time.perf_counter() - begun))
    return samples[_WARM_CALLS:]
