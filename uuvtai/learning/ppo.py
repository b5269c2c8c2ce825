"""Proximal policy optimisation (Schulman et al. 2017) with generalised advantages and an optional
distillation term, for any ``Policy``."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from uuvtai.config.learning import PpoConfig
from uuvtai.learning import networks
from uuvtai.learning.distillation import imitation_error
from uuvtai.learning.networks import CACHE_ROWS, AdamLearner, Policy, View, entropy, log_prob, moments_of
from uuvtai.learning.rollout import Rollout

ADAM_EPS = 1e-5  # as in most PPO implementations (Huang et al. 2022, detail 3)
RATE_FACTOR, RATE_BOUNDS = 1.5, (1e-5, 2e-3)
"""steps of the KL-adaptive learning rate (rsl_rl), and its bounds (EC)"""
DECAY_FROM, LEAST_RATE = 0.5, 0.1
"""share of the run from which an adaptive rate falls, and the part of it that is left at the end"""


def gae(
    reward: Tensor, value: Tensor, next_value: Tensor, ended: Tensor, gamma: float, lam: float
) -> tuple[Tensor, Tensor]:
    """(advantage, return), both (T, N) as all inputs, by generalised advantage estimation (Schulman et al.
    2016, equation 16). ``next_value`` is that of the true next observation after a timeout, 0 after a
    termination; past an ending nothing is carried back."""
    delta = reward + gamma * next_value - value
    carried = gamma * lam * ~ended
    advantage = torch.empty_like(reward)
    last = torch.zeros_like(reward[0])
    for t in range(len(reward) - 1, -1, -1):
        last = torch.addcmul(delta[t], carried[t], last, out=advantage[t])
    return advantage, advantage + value


def surrogate_loss(log_ratio: Tensor, advantage: Tensor, clip: float) -> Tensor:
    """(B,) the negative clipped objective of every sample (Schulman et al. 2017, equation 7)."""
    ratio = log_ratio.exp()
    return -torch.minimum(ratio * advantage, ratio.clamp(1.0 - clip, 1.0 + clip) * advantage)


def approximate_kl(log_ratio: Tensor) -> Tensor:
    """(B,) samples of KL(old || new) [nat] that are never negative (Schulman 2020, estimator k3)."""
    return torch.expm1(log_ratio) - log_ratio


def adapted_rate(rate: Tensor, kl: Tensor, target_kl: float) -> Tensor:
    """Learning rate after an update of this mean KL divergence (rsl_rl)."""
    slower, faster = rate / RATE_FACTOR, rate * RATE_FACTOR
    found = torch.where(kl > 2.0 * target_kl, slower, torch.where(kl < 0.5 * target_kl, faster, rate))
    return found.clamp(*RATE_BOUNDS)


_SUMS = ("policy_loss", "value_loss", "approx_kl", "clip_fraction", "distill_loss", "count")
Piece = tuple[tuple[Tensor, ...], Tensor]
"""of some rows of a minibatch: gradients; sums over the valid ones, in the order of ``_SUMS``"""


class Ppo(AdamLearner):
    """Adam on the clipped surrogate, the value error, the entropy and the distillation term of one policy."""

    def __init__(self, policy: Policy, config: PpoConfig) -> None:
        self.policy, self.config = policy, config
        self.rate = torch.tensor(config.learning_rate, device=policy.log_std.device)
        self._rate_now = self.rate.clone()
        critic = list(policy.critic.parameters())
        actor = [parameter for parameter in policy.parameters() if parameter not in {*critic}]
        groups: list[dict[str, Any]] = [{"params": actor + critic}]
        if policy.critic_rate is not None:
            groups = [{"params": actor}, {"params": critic, "lr": policy.critic_rate}]
        super().__init__(groups, lr=self._rate_now, eps=ADAM_EPS, fused=True)
        self._nets = actor, critic

    def update(
        self, rollout: Rollout, generator: torch.Generator, strength: float = 0.0, share: float = 0.0
    ) -> dict[str, float]:
        """Learn from a closed rollout when ``share`` of the run is over; metrics, means over all minibatches.
        ``strength`` of the distillation is lambda_t s_t. Samples that are not finite have no part in it."""
        config = self.config
        samples, metrics = self._prepared(rollout)
        fade = min(1.0, (1.0 - share) / (1.0 - DECAY_FROM)) if config.target_kl > 0 else 1.0
        self._rate_now.copy_(self.rate * max(LEAST_RATE, fade))
        skipped, sums = self.skipped, torch.zeros(len(_SUMS), dtype=torch.float64, device=self.rate.device)
        with networks.torch_threads_rest():
            for _ in range(config.epochs):
                for index in self._minibatches(len(samples["valid"]), generator):
                    sums += self._learn(samples, index, strength)
        means = dict(zip(_SUMS[:-1], sums / sums[-1].clamp(min=1.0), strict=False))
        if config.target_kl > 0:
            self.rate.copy_(adapted_rate(self.rate, means["approx_kl"].float(), config.target_kl))
        if config.normalise_observations:
            self.policy.observe(rollout)
        log_std = self.policy.log_std.detach()
        metrics |= {f"train/{name}": float(mean) for name, mean in means.items()}
        return metrics | {
            "train/entropy": float(entropy(log_std)),
            "train/learning_rate": float(self._rate_now),
            "train/std": float(log_std.exp().mean()),
            "train/skipped_updates": float(self.skipped - skipped),
        }

    def state_dict(self) -> dict[str, Any]:
        return super().state_dict() | {"learning_rate": self.rate.clone()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self.optimiser.param_groups[0]["lr"] = self._rate_now
        self.rate.copy_(state["learning_rate"])

    @torch.no_grad()
    def _prepared(self, rollout: Rollout) -> tuple[View, dict[str, float]]:
        """Samples as the losses want them, (T N, ...), zero where one is not finite: ``valid`` 1 or 0;
        ``advantage`` standardised; ``target``, the return in the critic's units; the prepared inputs."""
        valid = rollout.valid()
        if not bool(valid.all()):
            rollout = rollout.where(valid)
        reward, value, following = rollout["reward"], rollout["value"], rollout["next_value"]
        gamma, lam = self.config.gamma, self.config.gae_lambda
        advantage, returns = gae(reward, value, following, rollout["ended"] | ~valid, gamma, lam)
        good, explained = returns[valid], 0.0
        if len(good) > 1 and float(good.var()):
            explained = 1.0 - float((good - value[valid]).var() / good.var())
        invalid = float(valid.numel() - len(good))
        metrics = {"train/explained_variance": explained, "train/invalid_samples": invalid}
        if self.config.normalise_values:
            self.policy.learn_returns(good[:, None])
        moments = moments_of(advantage[valid][:, None])
        std = (moments.m2 / moments.n.clamp(min=1.0)).sqrt().float()
        standardised = torch.where(valid, (advantage - moments.mean.float()) / (std + 1e-8), 0.0)
        found = {
            "advantage": standardised.flatten(),
            "target": self.policy.value_norm(returns.flatten()),
            "valid": valid.flatten().float(),
        }
        flat = rollout.flat()
        kept = {n: flat[n] for n in ("action", "log_prob", "teacher_action") if n in flat}
        return kept | self.policy.prepared(flat) | found, metrics

    def _minibatches(self, count: int, generator: torch.Generator) -> Sequence[Tensor]:
        """Rows of blocks of neighbours (all envs in a span of steps), or random ones."""
        order, parts = torch.arange(count), self.config.minibatches
        if self.policy.is_shuffled:
            order = torch.randperm(count, generator=generator)
        return order.to(self.rate.device).tensor_split([count * part // parts for part in range(1, parts)])

    def _learn(self, samples: View, index: Tensor, strength: float) -> Tensor:
        """A step by these samples; their sums. The number of threads changes no bit."""
        self.optimiser.zero_grad(set_to_none=True)
        count, device = samples["valid"][index].sum().clamp(min=1.0), self.rate.device.type
        together = functools.partial(networks.side_by_side, device=device)

        def rows(part: Tensor) -> View:
            return {name: values[part] for name, values in samples.items()}

        pieces: list[Callable[[], Piece]] = []
        parts = index.split(CACHE_ROWS) if device == "cpu" else [index]
        for block in together(*(functools.partial(rows, part) for part in parts)):
            pieces.append(functools.partial(self._of_actor, block, count, strength))
            pieces.append(functools.partial(self._of_critic, block, count))
        found = together(*pieces)
        for parameters, mine in zip(self._nets, (found[::2], found[1::2]), strict=True):
            for parameter, *found_by in zip(parameters, *(gradients for gradients, _ in mine), strict=True):
                parameter.grad = functools.reduce(torch.add, found_by)
        if self.step(most=self.config.max_grad_norm):
            self.policy.floor_std()
        return torch.stack([sums for _, sums in found]).sum(dim=0)

    def _of_actor(self, batch: View, count: Tensor, strength: float) -> Piece:
        config, valid, log_std = self.config, batch["valid"], self.policy.log_std
        share, mean = valid / count, self.policy.mean_of(batch)
        log_ratio = log_prob(batch["action"], mean, log_std) - batch["log_prob"]
        policy_loss = surrogate_loss(log_ratio, batch["advantage"], config.clip)
        loss = (share * policy_loss).sum() - config.entropy_weight * share.sum() * entropy(log_std)
        with torch.no_grad():
            clipped = (log_ratio.expm1().abs() > config.clip).float()
            sums = {"count": torch.ones_like(valid), "policy_loss": policy_loss}
            sums |= {"approx_kl": approximate_kl(log_ratio), "clip_fraction": clipped}
        if strength:
            distill = imitation_error(mean, batch["teacher_action"])
            loss = loss + strength * (share * distill).sum()
            sums |= {"distill_loss": distill}
        return torch.autograd.grad(loss, self._nets[0]), _summed(sums, valid)

    def _of_critic(self, batch: View, count: Tensor) -> Piece:
        error = (self.policy.value_of(batch) - batch["target"]).square()
        loss = self.config.value_weight * (batch["valid"] / count * error).sum()
        gradients = torch.autograd.grad(loss, self._nets[1])
        return gradients, _summed({"value_loss": error}, batch["valid"])


@torch.no_grad()
def _summed(terms: View, valid: Tensor) -> Tensor:
    """Sums of terms (B,) over the valid rows, in the order of ``_SUMS``; those that are not there are 0."""
    zero = torch.zeros_like(valid)
    return (torch.stack([terms.get(name, zero) for name in _SUMS]) @ valid).double()
