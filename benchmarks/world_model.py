"""The world model on held-out scenarios: errors against "as before", calibration, and what it costs.

Noisy pilots (the behaviour tree's command plus drifting noise, stronger from env to env) drive in ``pool``.
The model learns from one seed; figures are of another one.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import torch

import uuvtai
from benchmarks.common import Job, Row, seconds_per_call
from uuvtai.config.learning import WorldModelConfig
from uuvtai.learn import calibration
from uuvtai.learn.world_model import N_TARGET, WorldModel, WorldModelLearner

TRAIN_SEED, HELD_OUT_SEED = 1, 200_003
MAX_NOISE = 1.2
"""deviation of the noise on the last env's commands, in parts of the vehicle's limits; the first env's is
0"""
NOISE_KEPT = 0.96
"""part of the noise that is still there a step later: a time constant of half a second"""
CHUNK = 64
"""steps of a rollout in training"""
LEVELS = (0.5, 0.8, 0.9, 0.95, 0.99)
GROUPS = {
    "goal": slice(0, 3),
    "heading error": slice(3, 5),
    "velocity": slice(5, 8),
    "yaw rate": slice(8, 9),
    "depth": slice(9, 10),
    "tilt": slice(10, 12),
    "sector range": slice(12, 24),
}
UNITS = {
    "goal": "m",
    "heading error": "1",
    "velocity": "m/s",
    "yaw rate": "rad/s",
    "depth": "m",
    "tilt": "rad",
    "sector range": "m",
}


@dataclass(frozen=True)
class Record:
    """What a batch of noisy pilots did: tensors (T, N, ...)."""

    obs: torch.Tensor
    action: torch.Tensor
    next_obs: torch.Tensor


def measure(job: Job) -> list[Row]:
    """Errors, calibration and cost."""
    num_envs, steps, updates = (64, 450, 4) if job.quick else (320, 700, 300)
    env = uuvtai.make("pool", num_envs=num_envs, seed=TRAIN_SEED)
    train, held_out = (driven(env, seed, steps, job) for seed in (TRAIN_SEED, HELD_OUT_SEED))
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # layers this narrow gain little from a second one
    rows = prediction_rows(trained(train, updates), held_out)
    torch.set_num_threads(threads)
    return rows + cost_rows(job)


def driven(env: uuvtai.env.VectorEnv, seed: int, steps: int, job: Job) -> Record:
    """Let the noisy pilots drive the episodes of a seed."""
    began, draws = time.perf_counter(), torch.Generator().manual_seed(seed)
    obs, info = env.reset(seed=seed)
    strength = torch.linspace(0.0, MAX_NOISE, env.num_envs)[:, None]
    noise, kept = torch.zeros(env.num_envs, env.num_actions), []
    for _ in range(steps):
        noise = NOISE_KEPT * noise + (1.0 - NOISE_KEPT**2) ** 0.5 * torch.randn(noise.shape, generator=draws)
        action, before = (info["teacher_action"] + strength * noise).clamp(-1.0, 1.0), obs.clone()
        obs, _reward, _terminated, _truncated, info = env.step(action)
        kept.append((before, action, info["final_obs"].clone()))
    record = Record(*(torch.stack(column) for column in zip(*kept, strict=True)))
    job.say(f"seed {seed}: {steps * env.num_envs} steps, {time.perf_counter() - began:.0f} s")
    return record


def trained(record: Record, updates: int) -> WorldModel:
    """A model after ``updates`` times the two gradient steps of a training iteration, on batches from the
    whole record."""
    draws, config = torch.Generator().manual_seed(0), WorldModelConfig()
    model = WorldModel(record.obs.shape[-1], config, draws)
    learner = WorldModelLearner(model, config)
    for _ in range(updates):
        learner.update(record.obs, record.action, record.next_obs, draws)
    return model


# ------------------------------------------------------------------------------------------------- prediction


@torch.no_grad()
def predicted(model: WorldModel, record: Record) -> tuple[torch.Tensor, torch.Tensor]:
    """(mean, log-variance) of every step, each (T, N, 24), SI units; mean squared errors stand in for
    variances a model does not learn."""
    pairs = [model.predict(obs, action) for obs, action in zip(record.obs, record.action, strict=True)]
    return torch.stack([p.mean for p in pairs]), torch.stack([p.log_var for p in pairs])


def prediction_rows(model: WorldModel, record: Record) -> list[Row]:
    """Root mean square errors per group beside those of "as before", calibration of the variances."""
    mean, log_var = predicted(model, record)
    target = record.next_obs[..., :N_TARGET]
    error, before = ((target - other).double().square() for other in (mean, record.obs[..., :N_TARGET]))
    residual = calibration.standardised_residual(mean, log_var, target).square()
    rows = []
    for name, columns in GROUPS.items():
        low, high = ratio_interval(error[..., columns].sum(dim=(0, 2)), before[..., columns].sum(dim=(0, 2)))
        ours, peer = (float(e[..., columns].mean().sqrt()) for e in (error, before))
        squared = float(residual[..., columns].mean())
        note = (
            f"{ours / peer:.4f} of its error, 95 % in {low:.4f} .. {high:.4f}; squared standardised "
            f"residual {squared:.2f}"
        )
        rows.append(
            Row(
                f"RMSE {name}",
                ours,
                UNITS[name],
                peer,
                "as before",
                less_is_better=True,
                floor=1.0,
                floor_on="ratio",
                note=note,
            )
        )
    low, high = mean_interval(residual.mean(dim=(0, 2)))
    note = f"1 is calibrated, 0.8 .. 1.2 asked for; 95 % in {low:.2f} .. {high:.2f}"
    rows.append(
        Row(
            "mean squared standardised residual",
            float(residual.mean()),
            "1",
            less_is_better=True,
            floor=1.2,
            note=note,
        )
    )
    inside = calibration.coverage(mean, log_var, target, torch.tensor(LEVELS))
    table = {
        "nominal": dict(zip(map(str, LEVELS), LEVELS, strict=True)),
        "inside": dict(zip(map(str, LEVELS), inside.tolist(), strict=True)),
    }
    return [
        *rows,
        Row("coverage at 0.9", float(inside[LEVELS.index(0.9)]), "share", details={"table": table}),
    ]


def ratio_interval(ours: torch.Tensor, theirs: torch.Tensor) -> tuple[float, float]:
    """95 % interval of the ratio of root mean squares from sums of squares per env, by resampling envs."""
    ratios = (ours[_resampled(len(ours))].sum(dim=1) / theirs[_resampled(len(ours))].sum(dim=1)).sqrt()
    return _middle(ratios)


def mean_interval(values: torch.Tensor) -> tuple[float, float]:
    """95 % interval of a mean over envs, by resampling them."""
    return _middle(values[_resampled(len(values))].mean(dim=1))


def _resampled(count: int) -> torch.Tensor:
    return torch.randint(count, (2000, count), generator=torch.Generator().manual_seed(0))


def _middle(values: torch.Tensor) -> tuple[float, float]:
    low, high = values.double().quantile(torch.tensor([0.025, 0.975], dtype=torch.float64)).tolist()
    return low, high


# ------------------------------------------------------------------------------------------------------- cost


def cost_rows(job: Job) -> list[Row]:
    """Update of a rollout of 64 steps of 1,024 envs, and features of one step, at the sizes of training."""
    num_envs = 64 if job.quick else 1024
    draws, config = torch.Generator().manual_seed(0), WorldModelConfig()
    obs, action = (
        torch.randn(CHUNK, num_envs, 56, generator=draws),
        torch.rand(CHUNK, num_envs, 4, generator=draws),
    )
    model = WorldModel(56, config, draws)
    learner = WorldModelLearner(model, config)
    learner.update(obs, action, obs, draws)
    took = seconds_per_call(
        {
            "update": lambda: learner.update(obs, action, obs, draws),
            "features": lambda: model.features(obs[0], action[0], obs[1]),
        },
        job.seconds,
        time.perf_counter,
    )
    note = f"{torch.get_num_threads()} threads, wall time"
    update, features = 1e6 * took["update"] / (CHUNK * num_envs), 1e6 * took["features"] / num_envs
    return [
        Row(
            f"update, {num_envs} envs x {CHUNK} steps",
            update,
            "us/env-step",
            less_is_better=True,
            floor=3.0,
            note=note,
        ),
        Row("features", features, "us/env-step", less_is_better=True, floor=6.0, note=note),
    ]
