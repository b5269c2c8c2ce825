"""Actor and critic: a diagonal Gaussian over the four commands and the value, with the normalisers of both
inside the module."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import nn

from uuvtai.config.learning import PolicyConfig
from uuvtai.errors import SettingError
from uuvtai.learn.mlp import mlp
from uuvtai.learn.normalise import Moments, RunningNorm

NUM_ACTIONS = 4
_MEAN_GAIN, _VALUE_GAIN = (
    0.01,
    1.0,
)  # small first actions (Andrychowicz et al. 2021, choice of the last layer's scale)
_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)


class PolicyStep(NamedTuple):
    """What the policy decided for N envs."""

    action: torch.Tensor
    """(N, 4) drawn, in parts of the vehicle's limits, unclamped: the environment clamps"""
    log_prob: torch.Tensor
    """(N,) [nat]"""
    value: torch.Tensor
    """(N,) expected return"""
    mean: torch.Tensor
    """(N, 4)"""


def log_prob(action: torch.Tensor, mean: torch.Tensor, log_std: torch.Tensor) -> torch.Tensor:
    """Log density [nat] of actions (..., 4) under a diagonal Gaussian of mean (..., 4) and log deviation
    (4,): (...,)."""
    scaled = (action - mean) * torch.exp(-log_std)
    return -0.5 * scaled.square().sum(dim=-1) - (log_std.sum() + log_std.shape[-1] * _HALF_LOG_2PI)


def entropy(log_std: torch.Tensor) -> torch.Tensor:
    """Differential entropy [nat] of a diagonal Gaussian of log deviation (4,), a scalar."""
    return log_std.sum() + log_std.shape[-1] * (0.5 + _HALF_LOG_2PI)


class ActorCritic(nn.Module):
    """Two separate networks on the normalised input; all it knows, statistics included, is in its
    ``state_dict``.

    Inputs x are (..., n_in) raw. With ``config.residual`` the mean is the teacher's action, read from x
    before normalisation, plus ``residual_limit`` tanh(network): the teacher itself at birth.
    """

    def __init__(
        self,
        n_in: int,
        config: PolicyConfig,
        teacher_slice: slice | None,
        generator: torch.Generator,
    ) -> None:
        """``teacher_slice``: columns of x with the teacher's action; ValueError where a residual policy has
        none."""
        super().__init__()
        if config.residual and (teacher_slice is None or len(range(n_in)[teacher_slice]) != NUM_ACTIONS):
            raise SettingError(
                f"policy.residual adds to the teacher's {NUM_ACTIONS} commands, but the observation has no "
                f"such columns (got {teacher_slice}): set features.teacher=true or policy.residual=false"
            )
        if config.initial_std < config.min_std:
            raise SettingError(
                f"policy.initial_std {config.initial_std:g} lies below the floor policy.min_std "
                f"{config.min_std:g}"
            )
        self.config, self.n_in, self.teacher_slice = config, n_in, teacher_slice
        self.actor = mlp(
            (n_in, *config.hidden, NUM_ACTIONS),
            config.activation,
            generator,
            0.0 if config.residual else _MEAN_GAIN,
        )
        self.critic = mlp((n_in, *config.hidden, 1), config.activation, generator, _VALUE_GAIN)
        self.log_std = nn.Parameter(torch.full((NUM_ACTIONS,), math.log(config.initial_std)))
        self.observation_norm = RunningNorm(n_in, config.clip_observation)
        self.value_norm = RunningNorm(1, math.inf)

    def distribution(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(mean (..., 4), log_std (4,)) of the action."""
        return self.mean(self.observation_norm(x), self.teacher_action(x)), self.log_std

    def value(self, x: torch.Tensor) -> torch.Tensor:
        """(...,) expected return, in units of the reward."""
        return self.value_norm.inverse(self.critic(self.observation_norm(x)).squeeze(-1))

    @torch.no_grad()
    def act(self, x: torch.Tensor, generator: torch.Generator) -> PolicyStep:
        """Draw actions for x (N, n_in) with noise from a CPU generator."""
        normalised = self.observation_norm(x)
        mean = self.mean(normalised, self.teacher_action(x))
        noise = torch.randn(mean.shape, generator=generator).to(mean.device)
        action = torch.addcmul(mean, noise, self.log_std.exp())
        value = self.value_norm.inverse(self.critic(normalised).squeeze(-1))
        return PolicyStep(action, log_prob(action, mean, self.log_std), value, mean)

    def mean(self, normalised: torch.Tensor, teacher_action: torch.Tensor | None) -> torch.Tensor:
        """(..., 4) mean action of normalised inputs; ``teacher_action`` is what ``teacher_action(x)``
        gave."""
        return self.mean_of(self.actor(normalised), teacher_action)

    def mean_of(self, out: torch.Tensor, teacher_action: torch.Tensor | None) -> torch.Tensor:
        """(..., 4) mean action from the actor network's output (..., 4)."""
        if not self.config.residual or teacher_action is None:
            return out
        return teacher_action + self.config.residual_limit * torch.tanh(out)

    def teacher_action(self, x: torch.Tensor) -> torch.Tensor | None:
        """(..., 4) the columns that a residual policy adds to (what is not finite counts as 0); None for
        others."""
        if not self.config.residual or self.teacher_slice is None:
            return None
        return x[..., self.teacher_slice].nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)

    @torch.no_grad()
    def floor_std(self) -> None:
        """Lift deviations that a step took below ``config.min_std`` back onto it: clamping inside would stop
        their gradient there."""
        self.log_std.clamp_(min=math.log(self.config.min_std))

    @torch.no_grad()
    def learn_returns(self, moments: Moments) -> None:
        """Add the moments of returns (width 1) to the value's statistics and change the critic's last layer
        so that no value changes.

        Source: van Hasselt et al. 2016, "Learning values across many orders of magnitude" (Pop-Art), equation
        9.
        """
        old_mean, old_std = self.value_norm.mean.clone(), self.value_norm.std()
        self.value_norm.merge(moments)
        mean, std = self.value_norm.mean, self.value_norm.std()
        last = self.critic[-1]
        assert isinstance(last, nn.Linear)
        last.weight.copy_(last.weight * (old_std / std))
        last.bias.copy_((last.bias * old_std + old_mean - mean) / std)
