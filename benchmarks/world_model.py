"""World model and risk head on held-out scenarios: errors against "as before", calibration, every switch,
accidents.

Noisy pilots (the behaviour tree's command plus drifting noise, stronger from env to env) drive in ``pool`` so
that accidents happen. The models learn from one seed; figures are of another one, whose envs are halved where
a calibration needs data of its own.
"""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass

import torch

import uuvtai
from benchmarks.common import Job, Row, seconds_per_call
from uuvtai.config.learning import RiskConfig, WorldModelConfig
from uuvtai.learn import calibration
from uuvtai.learn.risk import (
    STRIDE,
    Labels,
    RiskHead,
    RiskLearner,
    RiskMemory,
    conformal_threshold,
    label_events,
)
from uuvtai.learn.world_model import N_TARGET, WorldModel, WorldModelLearner, deviation
from uuvtai.statistics import wilson_interval

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
SWITCHES = {
    "all on": {},
    "values": {"predict_change": False},
    "SI targets": {"normalise_targets": False},
    "values, SI": {"predict_change": False, "normalise_targets": False},
    "gradient": {"stop_target_gradient": False},
    "plain NLL": {"beta_nll": 0.0},
    "MSE": {"likelihood": False},
}
"""differences from the defaults: values decoded instead of changes, targets not normalised, gradient through
the target's encoding, ..."""


@dataclass(frozen=True)
class Record:
    """What a batch of noisy pilots did: tensors (T, N, ...)."""

    obs: torch.Tensor
    action: torch.Tensor
    next_obs: torch.Tensor
    ended: torch.Tensor
    failed: torch.Tensor
    """collision or TTC stop"""
    censored: torch.Tensor
    """timeout"""

    def rows(self, envs: slice) -> Record:
        """Only these envs."""
        return Record(*(getattr(self, field.name)[:, envs] for field in dataclasses.fields(self)))


def measure(job: Job) -> list[Row]:
    """Figures and floors of the issue; the switches at half of the gradient steps."""
    num_envs, steps, updates, passes = (64, 450, 4, 1) if job.quick else (320, 700, 300, 10)
    env = uuvtai.make("pool", num_envs=num_envs, seed=TRAIN_SEED)
    train, held_out = (driven(env, seed, steps, job) for seed in (TRAIN_SEED, HELD_OUT_SEED))
    threads = torch.get_num_threads()
    torch.set_num_threads(
        1
    )  # layers this narrow gain little from a second one, and lose much where other programs run
    models = {}
    for name, switches in SWITCHES.items():
        models[name] = trained(train, WorldModelConfig(**switches), updates // 2)
        job.say(f"switch {name!r} learned")
    full = trained(train, WorldModelConfig(), updates)
    rows = [*prediction_rows(full, held_out), switch_row(models, held_out)]
    rows += event_rows(full, held_out, env.config.episode.control_dt_s)
    rows += risk_rows(full, train, held_out, env, passes)
    torch.set_num_threads(threads)
    return rows + cost_rows(job)


def driven(env: uuvtai.env.VectorEnv, seed: int, steps: int, job: Job) -> Record:
    """Let the noisy pilots drive the episodes of a seed."""
    began, draws = time.perf_counter(), torch.Generator().manual_seed(seed)
    obs, info = env.reset(seed=seed)
    strength = torch.linspace(0.0, MAX_NOISE, env.num_envs)[:, None]
    noise, kept = torch.zeros(env.num_envs, env.num_actions), []
    failures = torch.tensor([env.outcomes.index(name) for name in ("collision", "ttc")])
    for _ in range(steps):
        noise = NOISE_KEPT * noise + (1.0 - NOISE_KEPT**2) ** 0.5 * torch.randn(noise.shape, generator=draws)
        action, before = (info["teacher_action"] + strength * noise).clamp(-1.0, 1.0), obs.clone()
        obs, _reward, terminated, truncated, info = env.step(action)
        ended = terminated | truncated
        kept.append(
            (
                before,
                action,
                info["final_obs"].clone(),
                ended,
                torch.isin(info["outcome"], failures) & ended,
                truncated.clone(),
            )
        )
    record = Record(*(torch.stack(column) for column in zip(*kept, strict=True)))
    accidents, episodes, seconds = (
        int(record.failed.sum()),
        int(record.ended.sum()),
        time.perf_counter() - began,
    )
    job.say(
        f"seed {seed}: {record.ended.numel()} steps, {episodes} episodes ended, {accidents} by accident, "
        f"{seconds:.0f} s"
    )
    return record


def trained(record: Record, config: WorldModelConfig, updates: int) -> WorldModel:
    """A model after ``updates`` times the two gradient steps of a training iteration, on batches from the
    whole record."""
    draws = torch.Generator().manual_seed(0)
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


def switch_row(models: dict[str, WorldModel], record: Record) -> Row:
    """Every switch turned alone: error in parts of that of "as before", calibration, spread of the latent."""
    table = {name: _traits(model, record) for name, model in models.items()}
    return Row(
        "switches",
        None,
        "",
        note="error in parts of that of 'as before'; equal gradient steps",
        details={"table": table},
    )


def _traits(model: WorldModel, record: Record) -> dict[str, float]:
    mean, log_var = predicted(model, record)
    target = record.next_obs[..., :N_TARGET]
    error, before = ((target - other).double().square() for other in (mean, record.obs[..., :N_TARGET]))
    traits = {
        f"RMSE {name}": float((error[..., c].mean() / before[..., c].mean()).sqrt())
        for name, c in GROUPS.items()
    }
    with torch.no_grad():
        latent = model.encode(record.obs[::STRIDE].flatten(0, 1))
    if model.config.likelihood:
        traits["squared residual"] = calibration.mean_squared_standardised_residual(mean, log_var, target)
        traits["coverage at 0.9"] = float(calibration.coverage(mean, log_var, target, torch.tensor([0.9])))
        traits["uncertainty"] = float(
            torch.exp(log_var - 2.0 * deviation(model.change_norm.moments).log()).mean()
        )
    else:
        traits |= dict.fromkeys(("squared residual", "coverage at 0.9", "uncertainty"), float("nan"))
    return traits | {"latent spread": float(latent.std(dim=0).mean()), "latent rank": _rank(latent)}


def _rank(latent: torch.Tensor) -> float:
    """Dimensions that carry the spread: (sum of variances)^2 / sum of squared variances of the principal
    components; 1 = collapsed."""
    variance = torch.linalg.svdvals(latent - latent.mean(dim=0)).square()
    return float(variance.sum().square() / variance.square().sum())


# ----------------------------------------------------------------------------------------------------- events


def inputs(model: WorldModel, record: Record) -> torch.Tensor:
    """(T, N, n_obs + 2) input of the policy: observation, residual, uncertainty; both 0 at the first step of
    an episode."""
    features = torch.zeros(*record.ended.shape, 2)
    for t in range(1, len(features)):
        found = model.features(record.obs[t - 1], record.action[t - 1], record.obs[t])
        features[t] = torch.where(record.ended[t - 1, :, None], 0.0, found)
    return torch.cat([record.obs, features], dim=-1)


def moments(record: Record, control_dt_s: float, horizon_s: float) -> tuple[Labels, torch.Tensor]:
    """Labels of every step, and which steps count: label known, a tenth of a second apart, not the first of
    an episode."""
    labels = label_events(record.failed, record.ended, record.censored, round(horizon_s / control_dt_s))
    counts = labels.known.clone()
    counts[1:] &= ~record.ended[:-1]
    counts[torch.arange(len(counts)) % STRIDE != 0] = False
    counts[0] = False
    return labels, counts


def event_rows(model: WorldModel, record: Record, control_dt_s: float) -> list[Row]:
    """Does the uncertainty know of coming accidents? Noise of the pilot moves both, so also among pilots of
    like noise."""
    x, (labels, counts) = inputs(model, record), moments(record, control_dt_s, RiskConfig().horizon_s)
    rows = []
    for name, column in (("uncertainty", -1), ("residual", -2)):
        score, event = x[..., column], labels.event
        alike = [calibration.auroc(score[part], event[part]) for part in _alike(counts, event)]
        rank = calibration.spearman(score[counts], event[counts])
        area = calibration.auroc(score[counts], event[counts])
        note = (
            f"AUROC {area:.3f}; among pilots of like noise {sum(alike) / len(alike):.3f} (mean of "
            f"{len(alike)} groups)"
        )
        rows.append(Row(f"Spearman of {name} with an accident within 2 s", rank, "1", note=note))
    return rows


def _alike(counts: torch.Tensor, event: torch.Tensor) -> list[torch.Tensor]:
    """Masks (T, N) of the moments of eight groups of neighbouring envs, those in which both outcomes
    occur."""
    parts = []
    for envs in torch.arange(counts.shape[1]).chunk(8):
        part = torch.zeros_like(counts)
        part[:, envs] = counts[:, envs]
        if 0 < int(event[part].sum()) < int(part.sum()):
            parts.append(part)
    return parts


def risk_rows(
    model: WorldModel, train: Record, held_out: Record, env: uuvtai.env.VectorEnv, passes: int
) -> list[Row]:
    """The head learns from the training record, is calibrated on every second held-out env and judged on the
    others."""
    dt, config = env.config.episode.control_dt_s, RiskConfig()
    head = risk_head(inputs(model, train), train, config, dt, passes)
    parts = [held_out.rows(slice(first, None, 2)) for first in (0, 1)]
    (x_fit, event_fit, first_fit), (x, event, first) = (
        dangerous(inputs(model, part), part, dt, config) for part in parts
    )
    raw = torch.sigmoid(head.logit(x).detach())
    head.calibrate(head.logit(x_fit).detach(), event_fit)
    p, base = head(x), torch.full_like(raw, float(event.double().mean()))
    diagram = calibration.reliability(p, event, config.bins)
    names = [f"bin {i}" for i in range(len(diagram.samples))]
    table = {
        head_: dict(zip(names, column.tolist(), strict=True))
        for head_, column in (
            ("moments", diagram.samples),
            ("predicted", diagram.predicted),
            ("observed", diagram.observed),
        )
    }
    ttc = next(c.slice for c in env.observation_table if c.name == "sector_ttc")
    areas = [calibration.auroc(score, event) for score in (p, -x[:, ttc].min(dim=1).values)]
    ece = [calibration.expected_calibration_error(q, event, config.bins) for q in (raw, p)]
    rows = [
        Row("risk: Brier score", calibration.brier(p, event), "1", calibration.brier(base, event),
        "base rate", less_is_better=True,
            note=f"{len(event)} moments, {100 * float(base[0]):.1f} % before an accident"),
        Row("risk: ECE", ece[1], "1", ece[0], "uncalibrated", less_is_better=True, details={"table": table}),
        Row("risk: AUROC", areas[0], "1", areas[1], "smallest sector TTC"),
    ]  # fmt: skip
    threshold = (
        conformal_threshold(head(x_fit[first_fit]), config.miss_rate)
        if int(first_fit.sum()) >= 1 / config.miss_rate
        else 0.0
    )
    missed, n = int((p[first] < threshold).sum()), int(first.sum())
    low, high = wilson_interval(missed, n) or (0.0, 1.0)
    note = (
        f"{missed} of {n} accidents, 95 % in {low:.3f} .. {high:.3f}; promised {config.miss_rate:g} from "
        f"{int(first_fit.sum())} accidents; threshold {threshold:.4f}, alarm in "
        f"{100 * float((p[~event] >= threshold).double().mean()):.0f} % of the safe moments"
    )
    return [
        *rows,
        Row("risk: conformal miss rate", missed / max(n, 1), "share", less_is_better=True, note=note),
    ]


def risk_head(
    x: torch.Tensor, record: Record, config: RiskConfig, control_dt_s: float, passes: int
) -> RiskHead:
    """A head that went through the record's rollouts of ``CHUNK`` steps a few times, in their order; after
    ten it begins to overfit."""
    draws = torch.Generator().manual_seed(0)
    head = RiskHead(x.shape[-1], config, draws)
    learner = RiskLearner(head, config, control_dt_s)
    for _ in range(passes):
        learner.memory = RiskMemory(
            learner.memory.horizon_steps
        )  # the last step of a pass is not followed by the first
        for first in range(0, len(x) - CHUNK + 1, CHUNK):
            rows = slice(first, first + CHUNK)
            learner.update(x[rows], record.failed[rows], record.ended[rows], record.censored[rows], draws)
    return head


def dangerous(
    x: torch.Tensor, record: Record, control_dt_s: float, config: RiskConfig
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """(inputs (M, n_in), events (M,), which of them is the one moment drawn for its accident (M,)) of the
    moments that count."""
    labels, counts = moments(record, control_dt_s, config.horizon_s)
    # accidents are numbered by env and by how many of its episodes have ended before: moments of one episode
    # share the number
    number = torch.cumsum(record.ended.long(), dim=0) - record.ended.long()
    number = number * record.ended.shape[1] + torch.arange(record.ended.shape[1])
    event, number = labels.event[counts], number[counts]
    drawn = torch.zeros_like(event)
    order = torch.randperm(len(event), generator=torch.Generator().manual_seed(0))
    seen: set[int] = set()
    for row in order[event[order]].tolist():
        if int(number[row]) not in seen:
            seen.add(int(number[row]))
            drawn[row] = True
    return x[counts], event, drawn


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
