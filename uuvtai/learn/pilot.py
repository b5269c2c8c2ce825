"""A trained policy at the wheel: the mean action without exploration noise, with the world model's memory of every row.

What a row does must not depend on its neighbours, the batch's size or the number of threads. The networks therefore always see
``CHUNK`` rows at once, the last chunk filled up: equal shapes take equal paths through the matrix products.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch

from uuvtai.learn.checkpoint import Checkpoint
from uuvtai.learn.manifest import MODEL, CheckpointError
from uuvtai.learn.policy import NUM_ACTIONS, Policy
from uuvtai.learn.risk import RiskHead
from uuvtai.learn.world_model import N_FEATURES, WorldModel

CHUNK = 64
"""rows that go through the networks together"""
TEACHER_COLUMN = "teacher_action"
"""column of the observation that a residual policy adds to"""


class Decision(NamedTuple):
    """What the policy chooses for N rows, and what it thinks of their state."""

    action: torch.Tensor
    """(N, 4) mean action in parts of the vehicle's limits, within [-1, 1]"""
    value: torch.Tensor
    """(N,) expected return"""
    std: torch.Tensor
    """(4,) of the exploration it was trained with"""
    residual: torch.Tensor
    """(N,) of the world model's last prediction; 0 = none yet, or no world model"""
    uncertainty: torch.Tensor
    """(N,) of that prediction"""
    risk_logit: torch.Tensor
    """(N,) uncalibrated logit of a collision or TTC stop soon; empty without a risk head"""


class Pilot:
    """Drives ``num_envs`` rows. ``decide`` looks, ``advance`` goes on to the next step; ``reset`` when a row begins another episode."""

    def __init__(
        self,
        policy: Policy,
        world_model: WorldModel | None,
        num_envs: int,
        device: torch.device | str = "cpu",
        risk: RiskHead | None = None,
    ) -> None:
        """``world_model``: None where the policy was trained without its features. The networks are used, not copied."""
        self.policy, self.world_model, self.risk, self.device = policy, world_model, risk, torch.device(device)
        self._n_obs = policy.n_in - N_FEATURES
        rows = -(-num_envs // CHUNK) * CHUNK
        self._num_envs = num_envs
        self._x, self._last_obs = (torch.zeros(rows, width, device=device) for width in (policy.n_in, self._n_obs))
        self._action, self._last_action = (torch.zeros(rows, NUM_ACTIONS, device=device) for _ in range(2))
        self._has_last = torch.zeros(rows, dtype=torch.bool, device=device)
        self.decision = Decision(*(torch.zeros(0) for _ in Decision._fields))
        """the last one"""

    def reset(self, rows: torch.Tensor) -> None:
        """Forget the last step of the rows (num_envs,) where this is not 0."""
        self._has_last[: self._num_envs] &= rows.to(self.device) == 0

    @torch.no_grad()
    def decide(self, obs: torch.Tensor) -> Decision:
        """Decision for observations (num_envs, n_obs); changes nothing that the next one depends on."""
        n, x = self._num_envs, self._x
        fill = self.policy.observation_norm.mean[: self._n_obs].float()
        x[:n, : self._n_obs] = torch.where(torch.isfinite(obs), obs, fill)
        x[:, self._n_obs :] = self._features()
        self._action = self._by_chunk(lambda part: self.policy.distribution(part)[0], x)
        value = self._by_chunk(self.policy.value, x)[:n]
        std = self.policy.log_std.exp()
        risk_logit = value[:0] if self.risk is None else self._by_chunk(self.risk.logit, x)[:n]
        self.decision = Decision(self._action[:n].clamp(-1.0, 1.0), value, std, x[:n, -2].clone(), x[:n, -1].clone(), risk_logit)
        return self.decision

    def advance(self) -> None:
        """The last decision has been carried out."""
        self._last_obs.copy_(self._x[:, : self._n_obs])
        self._last_action.copy_(self._action)
        self._has_last.fill_(True)

    def act(self, obs: torch.Tensor) -> torch.Tensor:
        """Decide and carry it out: actions (num_envs, 4)."""
        action = self.decide(obs).action
        self.advance()
        return action

    def _features(self) -> torch.Tensor:
        if self.world_model is None:
            return self._x.new_zeros(len(self._x), N_FEATURES)
        found = self._by_chunk(self.world_model.features, self._last_obs, self._last_action, self._x[:, : self._n_obs])
        return torch.where(self._has_last[:, None], found, 0.0)

    def _by_chunk(self, function: Callable[..., torch.Tensor], *inputs: torch.Tensor) -> torch.Tensor:
        parts = [function(*(tensor[i : i + CHUNK].contiguous() for tensor in inputs)) for i in range(0, len(self._x), CHUNK)]
        return torch.cat(parts)


def load_pilot(checkpoint: Checkpoint, num_envs: int, device: torch.device | str = "cpu") -> Pilot:
    """Pilot with the networks of a checkpoint. Raises CheckpointError where they do not fit what its config says."""
    config, rows = checkpoint.config, checkpoint.manifest.observation_table
    n_obs = max(row["stop"] for row in rows)
    teacher = next((slice(row["first"], row["stop"]) for row in rows if row["name"] == TEACHER_COLUMN), None)
    parts, generator = checkpoint.model(), torch.Generator()
    try:
        policy = Policy(n_obs + N_FEATURES, config.policy, teacher, generator)
        policy.load_state_dict(parts["policy"])
        world_model = None
        if config.world_model.enabled and config.world_model.as_features:
            world_model = WorldModel(n_obs, config.world_model, generator)
            world_model.load_state_dict(parts["world_model"])
        risk = None
        if config.risk.enabled:
            risk = RiskHead(n_obs + N_FEATURES, config.risk, generator)
            risk.load_state_dict(parts["risk"])
    except (KeyError, ValueError, RuntimeError, TypeError) as error:
        raise CheckpointError(f"{checkpoint.path / MODEL}: its networks are not those of its config ({error}); take another one") from None
    modules = [module for module in (policy, world_model, risk) if module is not None]
    for module in modules:
        for name, tensor in module.state_dict().items():
            if not bool(torch.isfinite(tensor).all()):
                raise CheckpointError(f"{checkpoint.path / MODEL}: {name} is not finite: the training failed; take an older checkpoint")
        module.to(device).eval()
    return Pilot(policy, world_model, num_envs, device, risk)
