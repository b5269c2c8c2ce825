"""Rollouts: the policy drives the envs for T steps; what it met is kept, ended episodes are counted, what is
not finite is left out."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING

import torch

from uuvtai.learn.distill import LeafErrors, imitation_error
from uuvtai.learn.guard import Guard
from uuvtai.learn.hold import HeldResult, Hold, Info
from uuvtai.learn.policy import NUM_ACTIONS, ActorCritic
from uuvtai.learn.rollout import Rollout, final_value
from uuvtai.learn.rollout_sums import RolloutSums

if TYPE_CHECKING:
    from uuvtai.env import VectorEnv
    from uuvtai.learn.world_model import WorldModel

N_FEATURES = 2
"""columns of the policy's input behind the observation: the world model's residual and uncertainty, zero
without one"""


class Collector:
    """Drives the envs by the policy and fills a rollout; every tensor it needs is allocated once."""

    def __init__(
        self,
        env: VectorEnv,
        policy: ActorCritic,
        world_model: WorldModel | None,
        rollout: Rollout,
        guard: Guard,
        generator: torch.Generator,
        as_features: bool = True,
    ) -> None:
        """``generator`` (CPU) draws the exploration; without ``as_features`` the world model's columns stay
        zero, but its uncertainty is noted all the same. Call ``begin`` before the first rollout.
        """
        self.env, self.policy, self.world_model, self.rollout, self.guard = (
            env,
            policy,
            world_model,
            rollout,
            guard,
        )
        self.as_features, self.generator = as_features, generator
        n, device = env.num_envs, env.device
        self.x, self.final_x = (torch.zeros(n, rollout.n_in, device=device) for _ in range(2))
        self.uncertainty = torch.zeros(rollout.steps, n, device=device)
        """(T, N) the world model's uncertainty proxy of every transition in the rollout"""
        self.leaf_errors = LeafErrors(env.node_names, device)
        self.hold = Hold(env, policy)
        self._teacher, self._reward = (
            torch.zeros(n, NUM_ACTIONS, device=device),
            torch.zeros(n, device=device),
        )
        self._leaf = torch.zeros(n, dtype=torch.int32, device=device)
        self._bad = torch.zeros(n, dtype=torch.bool, device=device)
        self._features = torch.zeros(n, N_FEATURES, device=device)
        self._obs, self.info = torch.zeros(0), Info()
        """what the last step or reset told"""
        self.simulate_s = self.infer_s = 0.0
        """[s] wall time of the last rollout; on a GPU the waits fall where the host reads something"""

    def begin(self, obs: torch.Tensor, info: Info) -> None:
        """Take what ``env.reset`` gave as the first input; there is no prediction to compare it with yet."""
        self.info = info
        self.x.zero_()
        self._bad.copy_(self._cleaned(obs, self.x))

    @torch.no_grad()
    def look_around(self) -> None:
        """Let the behaviour tree drive for T steps and keep inputs, actions and endings: what the statistics
        begin with."""
        rollout = self.rollout
        for t in range(rollout.steps):
            self._note_teacher()
            rollout.x[t].copy_(self.x)
            rollout.action[t].copy_(self._teacher)
            end = self._drive(self._teacher)
            rollout.ended[t].copy_(end.ended)
            self._move_on(end.ended)

    @torch.no_grad()
    def fill_model_features(self) -> None:
        """Fill in the world-model columns of what ``look_around`` saw, by what the model has learned from
        it."""
        if self.world_model is None or not self.as_features:
            return
        x, n = self.rollout.x, self.env.num_obs
        for t in range(1, len(x)):
            found = self.world_model.features(x[t - 1, :, :n], self.rollout.action[t - 1], x[t, :, :n])
            x[t, :, n:] = torch.where(self.rollout.ended[t - 1, :, None], 0.0, found)

    @torch.no_grad()
    def collect(self) -> RolloutSums:
        """Fill the rollout, all but the samples' weights."""
        began, self.simulate_s = time.perf_counter(), 0.0
        env, rollout = self.env, self.rollout
        sums = RolloutSums.zeros(len(env.outcomes), len(env.reward_terms), env.device)
        rollout.clear()
        for t in range(rollout.steps):
            step = self.policy.act(self.x, self.generator)
            self._note_teacher()
            self.leaf_errors.add(imitation_error(step.mean, self._teacher), self._leaf)
            end = self._drive(step.action, sums)
            self.uncertainty[t].copy_(self._features[:, -1])
            last_value = final_value(self.policy, self.final_x, end.terminated, end.ended)
            rollout.add(
                self.x, step, self._reward, end.terminated, end.ended, last_value, self._teacher, self._leaf
            )
            self._move_on(end.ended)
        rollout.close(self.policy.value(self.x))
        self.infer_s = time.perf_counter() - began - self.simulate_s
        return sums

    def _note_teacher(self) -> None:
        """Copy what the tree would do now: the next step overwrites it."""
        self._bad |= self.guard.values("teacher_action", self.info["teacher_action"], self._teacher)
        self._leaf.copy_(self.info["leaf"])

    def _drive(self, action: torch.Tensor, sums: RolloutSums | None = None) -> HeldResult:
        """Hold a decision; fills the reward, NaN for samples with anything bad, and the input it led to."""
        began = time.perf_counter()
        end = self.hold.drive(
            action, self._teacher, None if sums is None else lambda ended, info: _count(sums, ended, info)
        )
        self._obs, self.info = end.obs, end.info
        self.simulate_s += time.perf_counter() - began
        self._bad |= self.guard.values("reward", end.reward, self._reward)
        self._bad |= self._cleaned(end.final_obs, self.final_x, end.ended)
        self._sense(action)
        self._reward.masked_fill_(self._bad, math.nan)  # PPO leaves such samples out
        return end

    def _sense(self, action: torch.Tensor) -> None:
        """World-model columns of the input that ``action`` led to."""
        if self.world_model is not None:
            n = self.env.num_obs
            self._features = self.world_model.features(self.x[:, :n], action, self.final_x[:, :n])
            if self.as_features:
                self.final_x[:, n:] = self._features

    def _move_on(self, ended: torch.Tensor) -> None:
        """The input that was led to becomes the present one; where an episode ended, the first of the
        next."""
        self.x.copy_(self.final_x).masked_fill_(ended[:, None], 0.0)
        self._bad.copy_(self._cleaned(self._obs, self.x))

    def _cleaned(
        self, obs: torch.Tensor, x: torch.Tensor, counted: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Write the observation into an input, the column's mean in place of what is not finite; which rows
        were bad."""
        n = self.env.num_obs
        return self.guard.observation(obs, self.policy.observation_norm.mean[:n].float(), x[:, :n], counted)

    def state_dict(self) -> dict[str, torch.Tensor]:
        """The present input: its world-model columns remember the last step."""
        return {"x": self.x.clone(), "bad": self._bad.clone()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """What ``state_dict`` gave; then call ``resume``."""
        self.x.copy_(state["x"])
        self._bad.copy_(state["bad"])

    def resume(self, obs: torch.Tensor, info: Info) -> None:
        """Go on with what ``env.restore`` gave."""
        self._obs, self.info = obs, info


def _count(sums: RolloutSums, ended: torch.Tensor, info: Info) -> None:
    """Add one control step of all envs to the sums."""
    weight = ended.double()
    sums.outcomes.index_add_(0, info["outcome"].long(), weight)
    sums.episode_return += torch.where(ended, info["episode_return"], 0.0).nansum()
    sums.episode_steps += (info["episode_steps"] * ended).sum()
    sums.terms += info["reward_terms"].nansum(dim=0)
    sums.samples += len(ended)
