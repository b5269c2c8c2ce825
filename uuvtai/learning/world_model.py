"""Latent world model: predicts the next observation's first 24 columns and how sure it is (paper, Sec.
"Latent World Model"): z = f(o), z' = g(z, a), o' = h(z') with a mean and a log-variance per target."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as fn
from torch import Tensor, nn

from uuvtai.common.errors import SettingError
from uuvtai.config.learning import WorldModelConfig
from uuvtai.learning.networks import NUM_ACTIONS, AdamLearner, RunningNorm, mlp

N_TARGET = 24
"""first columns of the observation: goal, heading error, velocity, yaw rate, depth, tilt, 12 sector ranges"""
N_FEATURES = 2  # residual, uncertainty

LOG_VAR_BOUNDS = (-12.0, 6.0)  # of a target in SI units; approached smoothly, so that no gradient dies
SKILL = "world_model/skill/"  # before the name of a target in metrics.jsonl
LARGEST_ERROR = 100.0  # of a target, in SI units: one that is further off counts as so far
_OUT_GAIN = 0.01  # of the decoder: at birth it says 0 with variance one


class WorldModel(nn.Module):
    """Encoder, latent dynamics and decoder; raw observations in, targets out, both in SI units. Actions are
    clamped to [-1, 1], as the environment does."""

    def __init__(self, n_obs: int, config: WorldModelConfig, generator: torch.Generator) -> None:
        """SettingError for an observation of fewer columns than targets."""
        super().__init__()
        if n_obs < N_TARGET:
            told = f"the first {N_TARGET} columns of the observation, but it has only {n_obs}"
            raise SettingError(f"the world model predicts {told}")
        self.n_obs, self.config = n_obs, config
        self.encoder = mlp((n_obs, *config.hidden, config.latent), "elu", generator)
        self.dynamics = mlp((config.latent + NUM_ACTIONS, *config.hidden, config.latent), "elu", generator)
        self.decoder = mlp((config.latent, *config.hidden, 2 * N_TARGET), "elu", generator, _OUT_GAIN)
        self.observation_norm = RunningNorm(n_obs)

    def encode(self, obs: Tensor) -> Tensor:
        """z (..., latent) of raw observations (..., n_obs)."""
        return self.encoder(self.observation_norm(obs))

    def advance(self, latent: Tensor, action: Tensor) -> Tensor:
        """z' (..., latent) after an action (..., 4)."""
        return self.dynamics(torch.cat([latent, action.clamp(-1.0, 1.0)], dim=-1))

    def decode(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        """(mean, log-variance), each (..., 24), in SI units."""
        mean, raw = self.decoder(latent).split(N_TARGET, dim=-1)
        low, high = LOG_VAR_BOUNDS
        return mean, high - fn.softplus(high - low - fn.softplus(raw - low))

    def predict(self, obs: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(z' (..., latent), mean, log-variance (..., 24)) after observations (..., n_obs) and actions."""
        latent = self.advance(self.encode(obs), action)
        return latent, *self.decode(latent)

    @torch.no_grad()
    def features(self, obs: Tensor, action: Tensor, next_obs: Tensor) -> Tensor:
        """(N, 2) columns of the policy's input at ``next_obs``: root mean square error of the prediction made
        before it, and its uncertainty sigma_t = mean(exp(log_var)). What is not finite becomes 0."""
        _, mean, log_var = self.predict(obs, action)
        error = (next_obs[..., :N_TARGET] - mean).clamp(-LARGEST_ERROR, LARGEST_ERROR)
        found = error.square().mean(dim=-1).sqrt(), log_var.exp().mean(dim=-1)
        return torch.stack(found, dim=-1).nan_to_num_(0.0, 0.0, 0.0)

    def fill_in(self, x: Tensor, action: Tensor, ended: Tensor) -> None:
        """Write ``features`` into the last columns of inputs x (T, N, n_obs + 2); 0 where episodes begin."""
        for t in range(1, len(x)):
            found = self.features(x[t - 1, :, : self.n_obs], action[t - 1], x[t, :, : self.n_obs])
            x[t, :, self.n_obs :] = torch.where(ended[t - 1, :, None], 0.0, found)

    def loss(
        self, obs: Tensor, action: Tensor, next_obs: Tensor, valid: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """(total, reconstruction [nat] summed over the targets, dynamics: |f(o') - z'|^2), means over the
        ``valid`` samples (B,). ``next_obs`` is the true one, also at an end."""
        config, weight = self.config, valid / valid.sum().clamp(min=1)
        ahead, mean, log_var = self.predict(obs, action)
        nll = 0.5 * ((next_obs[:, :N_TARGET] - mean).square() * torch.exp(-log_var) + log_var)
        reconstruction = nll.sum(dim=-1) @ weight
        dynamics = (self.encode(next_obs) - ahead).square().sum(dim=-1) @ weight
        total = config.reconstruction_weight * reconstruction + config.dynamics_weight * dynamics
        return total, reconstruction, dynamics


class WorldModelLearner(AdamLearner):
    """Adam on batches drawn from rollouts, with a guard against NaN."""

    def __init__(self, world_model: WorldModel, config: WorldModelConfig, names: Sequence[str] = ()) -> None:
        """``names``: of the targets in metrics; their numbers where none are given."""
        super().__init__(world_model.parameters(), lr=config.learning_rate, fused=True)
        self.model, self.config = world_model, config
        self._names = names or [str(i) for i in range(N_TARGET)]

    def update(
        self, obs: Tensor, action: Tensor, next_obs: Tensor, valid: Tensor, generator: torch.Generator
    ) -> dict[str, float]:
        """``config.steps`` gradient steps on the ``valid`` (T, N) and finite samples of a rollout: obs,
        next_obs (T, N, n_obs), action (T, N, 4). Metrics; calibration and skill (1 - mean squared error /
        that of "as before") are those of the first batch, before the model learns from this rollout."""
        skipped, losses = self.skipped, []
        batches = [self._drawn(obs, action, next_obs, valid, generator) for _ in range(self.config.steps)]
        # a rollout's neighbouring steps are alike: all of it would say little more than what was drawn
        self.model.observation_norm.update(torch.cat([seen[good] for seen, _, _, good in batches]))
        metrics = self._calibration(*batches[0])
        for batch in batches:
            total, *parts = self.model.loss(*batch)
            self.step(total)
            losses.append(torch.stack(parts).detach())
        reconstruction, dynamics = torch.stack(losses).mean(dim=0).tolist()
        return metrics | {
            "world_model/reconstruction_loss": reconstruction,
            "world_model/dynamics_loss": dynamics,
            "world_model/skipped_updates": float(self.skipped - skipped),
        }

    def _drawn(
        self, obs: Tensor, action: Tensor, next_obs: Tensor, valid: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Random samples and whether they are valid; rows that are not finite are zero and not valid."""
        steps, num_envs = action.shape[:2]
        drawn = torch.randint(steps * num_envs, (self.config.batch,), generator=generator).to(obs.device)
        t, env = drawn // num_envs, drawn % num_envs
        rows = obs[t, env], action[t, env], next_obs[t, env]
        good = torch.isfinite(torch.cat(rows, dim=1)).all(dim=1) & valid[t, env]
        kept = [torch.where(good[:, None], row, 0.0) for row in rows]
        return kept[0], kept[1], kept[2], good

    @torch.no_grad()
    def _calibration(self, obs: Tensor, action: Tensor, next_obs: Tensor, valid: Tensor) -> dict[str, float]:
        if not bool(valid.any()):
            return {}
        obs, target = obs[valid], next_obs[valid, :N_TARGET]
        _, mean, log_var = self.model.predict(obs, action[valid])
        square, inside = calibration(mean, log_var, target)
        error, before = ((target - said).square().mean(dim=0).tolist() for said in (mean, obs[:, :N_TARGET]))
        found = zip(self._names, error, before, strict=True)
        return {f"{SKILL}{name}": 1.0 - ours / theirs for name, ours, theirs in found if theirs > 0.0} | {
            "world_model/standardised_residual": square,
            "world_model/coverage_90": inside,
            "world_model/uncertainty": float(log_var.exp().mean()),
            "world_model/latent_std": float(self.model.encode(obs).std(dim=0, correction=0).mean()),
        }


INSIDE_90 = 1.6448536269514722  # standard deviations on either side of a Gaussian's mean that hold 90 % of it


def calibration(mean: Tensor, log_var: Tensor, target: Tensor) -> tuple[float, float]:
    """Mean square of standardised errors; share of targets within the central 90 % interval."""
    z = (target.double() - mean.double()) * torch.exp(-0.5 * log_var.double())
    return float(z.square().mean()), float((z.abs() <= INSIDE_90).double().mean())
