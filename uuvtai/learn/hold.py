"""A decision held for several control steps (frame skip): to the learner they are one transition."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import torch

from uuvtai.learn.policy import ActorCritic

if TYPE_CHECKING:
    from uuvtai.env import VectorEnv

Info = dict[str, torch.Tensor]
"""what ``VectorEnv.step`` tells beside the observation"""
Watch = Callable[[torch.Tensor, Info], None]
"""called after every control step with the rows (N,) whose episode ended in it, and its info"""


class HeldResult(NamedTuple):
    """What came of a decision, all (N, ...); rows whose episode ended on the way tell of that episode,
    ``obs`` and ``info`` of the next."""

    obs: torch.Tensor
    """observation of the next decision"""
    final_obs: torch.Tensor
    """observation that the decision led to"""
    reward: torch.Tensor
    """sum over the steps"""
    terminated: torch.Tensor
    ended: torch.Tensor
    outcome: torch.Tensor
    """int64 index of how the episode ended; without meaning where it went on"""
    info: Info
    """of the last control step"""


class Hold:
    """Drives the envs through ``policy.hold_steps`` control steps by one decision.

    An episode that begins on the way is driven by the behaviour tree until the next decision.
    """

    def __init__(self, env: VectorEnv, policy: ActorCritic) -> None:
        """What is held is the policy's action, or its difference from the tree's for a residual policy."""
        self._env, self.steps, self._residual = env, policy.config.hold_steps, policy.config.residual

    def drive(self, action: torch.Tensor, teacher: torch.Tensor, watch: Watch | None = None) -> HeldResult:
        """Carry out ``action`` (N, 4), decided where the tree would have done ``teacher`` (N, 4)."""
        end = self._step(action)
        if watch:
            watch(end.ended, end.info)
        if self.steps == 1:
            return end
        end = end._replace(
            final_obs=end.final_obs.clone(), reward=end.reward.clone(), terminated=end.terminated.clone()
        )
        offset = action - teacher if self._residual else action
        for _ in range(self.steps - 1):
            newest = end.info["teacher_action"].nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
            held = newest + offset if self._residual else offset
            step = self._step(torch.where(end.ended[:, None], newest, held))
            if watch:
                watch(step.ended, step.info)
            end = _joined(end, step)
        return end

    def _step(self, action: torch.Tensor) -> HeldResult:
        obs, reward, terminated, truncated, info = self._env.step(action)
        return HeldResult(
            obs, info["final_obs"], reward, terminated, terminated | truncated, info["outcome"].long(), info
        )


def _joined(first: HeldResult, then: HeldResult) -> HeldResult:
    """One stretch after the other; rows that ended in the first keep what it told."""
    on = ~first.ended
    return HeldResult(
        obs=then.obs,
        final_obs=torch.where(on[:, None], then.final_obs, first.final_obs),
        reward=torch.where(on, first.reward + then.reward, first.reward),
        terminated=first.terminated | (on & then.terminated),
        ended=first.ended | (on & then.ended),
        outcome=torch.where(on, then.outcome, first.outcome),
        info=then.info,
    )
