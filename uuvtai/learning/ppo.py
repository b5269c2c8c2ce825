"""Proximal policy optimisation (Schulman et al. 2017) with generalised advantages, an optional distillation
term and a guard against NaN.

Statistics of the normalisers stand still from the first step of a rollout to the last minibatch of its
update, so that the ratio of the first minibatch is one; only then do they take in the rollout.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn

from uuvtai.common.errors import SettingError
from uuvtai.config.learning import PpoConfig
from uuvtai.learning.distillation import imitation_error
from uuvtai.learning.networks import ActorCritic, PlainAdam, entropy, in_bfloat16, log_prob, moments_of
from uuvtai.learning.rollout import Rollout

ADAM_EPS = 1e-5
"""as in most PPO implementations (Huang et al. 2022, detail 3)"""
RATE_FACTOR, RATE_BOUNDS = 1.5, (1e-5, 1e-2)
"""steps and bounds of the KL-adaptive learning rate (rsl_rl)"""
CACHE_ROWS = 2048
"""rows of a minibatch in one pass on a CPU, twice as many in bfloat16: their activations stay in the cache
and in memory that is used again, and the gradients add up to the same sum"""


def gae(
    reward: torch.Tensor,
    value: torch.Tensor,
    next_value: torch.Tensor,
    terminated: torch.Tensor,
    ended: torch.Tensor,
    gamma: float,
    lam: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    """(advantage, return), both (T, N), by generalised advantage estimation (Schulman et al. 2016, equation
    16).

    All inputs are (T, N). ``next_value[t]`` is the value of the true next observation: after a timeout
    (ended, not terminated) it is bootstrapped from, after a termination it is not; past an ending nothing is
    carried back.
    """
    delta = reward + gamma * next_value * ~terminated - value
    carried = gamma * lam * ~ended
    advantage = torch.empty_like(reward)
    last = torch.zeros_like(reward[0])
    for t in range(len(reward) - 1, -1, -1):
        last = torch.addcmul(delta[t], carried[t], last, out=advantage[t])
    return advantage, advantage + value


def surrogate_loss(log_ratio: torch.Tensor, advantage: torch.Tensor, clip: float) -> torch.Tensor:
    """(B,) the negative clipped objective of every sample (Schulman et al. 2017, equation 7)."""
    ratio = log_ratio.exp()
    return -torch.minimum(ratio * advantage, ratio.clamp(1.0 - clip, 1.0 + clip) * advantage)


def approximate_kl(log_ratio: torch.Tensor) -> torch.Tensor:
    """(B,) samples of KL(old || new) [nat] that are never negative (Schulman 2020, estimator k3)."""
    return torch.expm1(log_ratio) - log_ratio


def adapted_rate(rate: torch.Tensor, kl: torch.Tensor, target_kl: float) -> torch.Tensor:
    """Learning rate after a minibatch of this mean KL divergence: slower above twice the target, faster below
    half of it (rsl_rl)."""
    slower, faster = rate / RATE_FACTOR, rate * RATE_FACTOR
    return torch.where(kl > 2.0 * target_kl, slower, torch.where(kl < 0.5 * target_kl, faster, rate)).clamp(
        *RATE_BOUNDS
    )


@dataclass(frozen=True)
class Minibatch:
    """Samples of a rollout as the losses want them: rows (M, ...), finite, with ``valid`` 1 or 0 for those
    that were not finite."""

    normalised: torch.Tensor
    action: torch.Tensor
    log_prob: torch.Tensor
    advantage: torch.Tensor
    """normalised over the valid samples"""
    target: torch.Tensor
    """return in the critic's units"""
    teacher_action: torch.Tensor
    weight: torch.Tensor
    valid: torch.Tensor

    def rows(self, index: slice | torch.Tensor) -> Minibatch:
        """These samples: views for a slice, copies for an index."""
        return Minibatch(**{name: value[index] for name, value in vars(self).items()})


_SUMS = ("policy_loss", "value_loss", "approx_kl", "clip_fraction", "distillation", "count")


class Ppo:
    """Adam on the clipped surrogate, the value error, the entropy and the distillation term of one policy."""

    def __init__(self, policy: ActorCritic, config: PpoConfig) -> None:
        self.policy, self.config = policy, config
        device = policy.log_std.device
        self.rate = torch.tensor(config.learning_rate, device=device)
        self.optimiser = PlainAdam(policy.parameters(), lr=self.rate, eps=ADAM_EPS, fused=True)
        self.updates = 0
        """minibatches that changed the policy"""
        self.skipped = 0
        """minibatches left out because loss or gradient was not finite"""
        self._normalised = torch.empty(0, device=device)

    def update(
        self,
        rollout: Rollout,
        distillation_weight: float = 0.0,
        surrogate: bool = True,
        generator: torch.Generator | None = None,
    ) -> dict[str, float]:
        """Learn from a closed rollout; metrics by their names in metrics.jsonl, means over all minibatches of
        the update.

        ``distillation_weight`` is lambda_t s_t of weight ||mean - teacher_action||^2; without ``surrogate``
        only the critic and the distillation learn (critic warm-up). ``generator`` (CPU) draws the minibatches
        of
        ``config.shuffle``. Samples that are not finite have no part in any of it and are counted. ValueError
        for more minibatches than samples.
        """
        batch, metrics = self._prepared(rollout)
        if self.config.minibatches > len(batch.valid):
            raise SettingError(
                f"ppo.minibatches={self.config.minibatches}, but a rollout has only {len(batch.valid)} "
                "samples: raise ppo.rollout_steps or train.num_envs"
            )
        skipped, sums = self.skipped, torch.zeros(len(_SUMS), dtype=torch.float64, device=batch.valid.device)
        for _ in range(self.config.epochs):
            for minibatch in self._minibatches(batch, generator):
                self._learn(minibatch, distillation_weight, surrogate, sums)
        if self.config.normalise_observations:
            self.observe(rollout.x)
        return metrics | self._metrics(sums, skipped)

    def observe(self, x: torch.Tensor) -> None:
        """Take inputs x (..., n_in) into the normaliser's statistics; before the first rollout, so that it
        does not begin unscaled."""
        self.policy.observation_norm.merge(moments_of(x))

    def state_dict(self) -> dict[str, Any]:
        """Adam's moments, the learning rate and the counters."""
        return {
            "optimiser": self.optimiser.state_dict(),
            "learning_rate": self.rate.clone(),
            "updates": self.updates,
            "skipped": self.skipped,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """What ``state_dict`` gave."""
        self.optimiser.load_state_dict(state["optimiser"])
        self.rate.copy_(state["learning_rate"])
        for group in self.optimiser.param_groups:
            group["lr"] = self.rate
        self.updates, self.skipped = int(state["updates"]), int(state["skipped"])

    # ----------------------------------------------------------------------------------- what is learned from

    @torch.no_grad()
    def _prepared(self, rollout: Rollout) -> tuple[Minibatch, dict[str, float]]:
        valid = _valid(rollout)
        reward, value, next_value = (
            torch.where(valid, getattr(rollout, name), 0.0) for name in ("reward", "value", "next_value")
        )
        advantage, returns = gae(
            reward,
            value,
            next_value,
            rollout.terminated,
            rollout.ended | ~valid,
            self.config.gamma,
            self.config.gae_lambda,
        )
        kept = returns[valid]
        metrics = {
            "train/explained_variance": _explained_variance(value[valid], kept),
            "train/invalid_samples": float(valid.numel() - len(kept)),
        }
        if self.config.normalise_values:
            self.policy.learn_returns(moments_of(kept[:, None]))
        norm = self.policy.value_norm
        flat_valid = valid.flatten()
        zero_where_invalid = {
            name: torch.where(
                flat_valid.view(-1, *[1] * (rollout.flat(name).ndim - 1)), rollout.flat(name), 0.0
            )
            for name in ("action", "log_prob", "teacher_action", "weight")
        }
        return Minibatch(
            normalised=self._normalise(rollout.flat("x")),
            advantage=_standardised(advantage, valid).flatten(),
            target=norm(returns.flatten()),
            valid=flat_valid.float(),
            **zero_where_invalid,
        ), metrics

    def _normalise(self, x: torch.Tensor) -> torch.Tensor:
        if self._normalised.shape != x.shape:
            self._normalised = torch.empty_like(x)
        return self.policy.observation_norm(x, out=self._normalised)

    def _minibatches(self, batch: Minibatch, generator: torch.Generator | None) -> Iterator[Minibatch]:
        """Blocks of neighbouring rows (all envs in a span of steps) as views, or random ones as copies."""
        samples, parts = len(batch.valid), self.config.minibatches
        bounds = [samples * part // parts for part in range(parts + 1)]
        order = None
        if self.config.shuffle:
            if generator is None:
                raise ValueError("ppo.shuffle draws minibatches at random: pass update() a generator")
            order = torch.randperm(samples, generator=generator).to(batch.valid.device)
        for first, last in itertools.pairwise(bounds):
            yield batch.rows(slice(first, last) if order is None else order[first:last])

    # ------------------------------------------------------------------------------------------ one minibatch

    def _learn(
        self, batch: Minibatch, distillation_weight: float, surrogate: bool, sums: torch.Tensor
    ) -> None:
        self.optimiser.zero_grad(set_to_none=True)
        count = batch.valid.sum().clamp(min=1.0)
        kl_before = sums[_SUMS.index("approx_kl")].clone()
        device = self.rate.device.type
        rows = CACHE_ROWS * (1 + in_bfloat16(self.config, device)) if device == "cpu" else len(batch.valid)
        for first in range(0, len(batch.valid), rows):
            block = batch.rows(slice(first, first + rows))
            self._add_gradients(block, count, distillation_weight, surrogate, sums)
        self._step((sums[_SUMS.index("approx_kl")] - kl_before).float() / count, surrogate)

    def _add_gradients(
        self,
        batch: Minibatch,
        count: torch.Tensor,
        distillation_weight: float,
        surrogate: bool,
        sums: torch.Tensor,
    ) -> None:
        x = batch.normalised
        bfloat16 = in_bfloat16(self.config, x.device.type)
        value = _output(self.policy.critic, x, bfloat16)
        acting = surrogate or distillation_weight != 0.0
        mean = _output(self.policy.actor, x, bfloat16) if acting else batch.action
        self._loss(batch, value, mean, count, distillation_weight, surrogate, sums).backward()

    def _loss(
        self,
        batch: Minibatch,
        value_out: torch.Tensor,
        mean: torch.Tensor,
        count: torch.Tensor,
        distillation_weight: float,
        surrogate: bool,
        sums: torch.Tensor,
    ) -> torch.Tensor:
        """This block's share of the minibatch's loss by the networks' outputs; its sums are added to ``sums``
        in the order of ``_SUMS``."""
        config, share = self.config, batch.valid / count
        value_error = (value_out.squeeze(-1) - batch.target).square()
        loss = config.value_weight * (share * value_error).sum()
        zero = torch.zeros_like(batch.valid)
        policy_loss, kl, clipped, distill = zero, zero, zero, zero
        if surrogate:
            log_ratio = log_prob(batch.action, mean, self.policy.log_std) - batch.log_prob
            policy_loss = surrogate_loss(log_ratio, batch.advantage, config.clip)
            loss = (
                loss
                + (share * policy_loss).sum()
                - config.entropy_weight * share.sum() * entropy(self.policy.log_std)
            )
            with torch.no_grad():
                kl, clipped = approximate_kl(log_ratio), (log_ratio.expm1().abs() > config.clip).float()
        if distillation_weight:
            distill = batch.weight * imitation_error(mean, batch.teacher_action)
            loss = loss + distillation_weight * (share * distill).sum()
        with torch.no_grad():
            terms = torch.stack([policy_loss, value_error, kl, clipped, distill, torch.ones_like(zero)])
            sums += (terms @ batch.valid).double()
        return loss

    def _step(self, kl: torch.Tensor, surrogate: bool) -> None:
        """Adapt the rate, cut the gradient's norm, step; or nothing where the gradient is not finite."""
        parameters = [p for p in self.policy.parameters() if p.grad is not None]
        norm = torch.nn.utils.clip_grad_norm_(parameters, self.config.max_grad_norm)
        if not math.isfinite(float(norm)):
            self.skipped += 1
            self.optimiser.zero_grad(set_to_none=True)
            return
        if self.config.target_kl > 0 and surrogate:
            self.rate.copy_(adapted_rate(self.rate, kl, self.config.target_kl))
        self.optimiser.step()
        self.policy.floor_std()
        self.updates += 1

    def _metrics(self, sums: torch.Tensor, skipped_before: int) -> dict[str, float]:
        *totals, count = sums.tolist()
        means = dict(zip(_SUMS, (total / max(count, 1.0) for total in totals), strict=False))
        log_std = self.policy.log_std.detach()
        return {
            "train/policy_loss": means["policy_loss"],
            "train/value_loss": means["value_loss"],
            "train/entropy": float(entropy(log_std)),
            "train/approx_kl": means["approx_kl"],
            "train/clip_fraction": means["clip_fraction"],
            "train/learning_rate": float(self.rate),
            "train/std": float(log_std.exp().mean()),
            "train/skipped_updates": float(self.skipped - skipped_before),
            "train/distill_loss": means["distillation"],
        }


def _output(net: nn.Sequential, x: torch.Tensor, bfloat16: bool) -> torch.Tensor:
    """Output (B, n_out) float32 of an ``mlp``; ``bfloat16``: the products of all layers but the last, whose
    output is what the losses see, in half of the width."""
    if not bfloat16:
        return net(x)
    with torch.autocast(x.device.type, torch.bfloat16):
        hidden = net[:-1](x)
    return net[-1](hidden.float())


def _valid(rollout: Rollout) -> torch.Tensor:
    """(T, N) bool: everything that the update reads of the sample is finite."""
    total = rollout.x.sum(dim=-1) + rollout.action.sum(dim=-1) + rollout.teacher_action.sum(dim=-1)
    for name in ("log_prob", "value", "reward", "next_value", "weight"):
        total += getattr(rollout, name)
    return torch.isfinite(total)


def _standardised(advantage: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """Mean 0, deviation 1 by the moments of the valid samples; the others become 0."""
    moments = moments_of(advantage[valid][:, None])
    std = (moments.m2 / moments.count.clamp(min=1.0)).sqrt()
    return torch.where(valid, (advantage - moments.mean.float()) / (std.float() + 1e-8), 0.0)


def _explained_variance(value: torch.Tensor, returns: torch.Tensor) -> float:
    """1 - var(return - value) / var(return); 0 where the returns do not vary."""
    if len(returns) < 2 or not float(returns.var()):
        return 0.0
    return 1.0 - float((returns - value).var() / returns.var())
