"""Rollouts: the policy drives the envs for T steps; what it met is kept, ended episodes are counted, what is
not finite is left out."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch

from uuvtai.common.enums import COLLIDED
from uuvtai.learning.distillation import LeafErrors, imitation_error
from uuvtai.learning.networks import NUM_ACTIONS, ActorCritic, Guard, PolicyStep

if TYPE_CHECKING:
    from uuvtai.envs.vector_env import VectorEnv
    from uuvtai.learning.world_model import WorldModel


# ------------------------------------------------------------------------------------------------------------
# Memory of one rollout: T steps of N envs, allocated once.


class Rollout:
    """Tensors (T, N, ...) in order of time; ``flat`` views them as (T N, ...), so that a run of rows is a
    block of memory.

    Row t of env n: input ``x``, what was done (``action``, ``log_prob``, ``value``) and what came of it
    (``reward``, ``next_value`` of the true next observation, ``terminated``, ``ended``), the teacher's action
    in x, the leaf of the tree that gave it (-1: none), and the weight of the sample in the distillation.
    """

    def __init__(self, steps: int, num_envs: int, n_in: int, device: torch.device | str = "cpu") -> None:
        """``steps`` = T, ``num_envs`` = N."""
        self.steps, self.num_envs, self.n_in = steps, num_envs, n_in

        def zeros(*more: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.zeros(steps, num_envs, *more, dtype=dtype, device=device)

        self.x = zeros(n_in)
        self.action, self.teacher_action = zeros(NUM_ACTIONS), zeros(NUM_ACTIONS)
        self.log_prob, self.value, self.reward, self.next_value = zeros(), zeros(), zeros(), zeros()
        self.terminated, self.ended = zeros(dtype=torch.bool), zeros(dtype=torch.bool)
        self.leaf = zeros(dtype=torch.int32)
        self.weight = zeros()
        self.filled = 0
        """steps added since ``clear``"""

    def clear(self) -> None:
        """Begin again at step 0."""
        self.filled = 0

    def add(
        self,
        x: torch.Tensor,
        step: PolicyStep,
        reward: torch.Tensor,
        terminated: torch.Tensor,
        ended: torch.Tensor,
        final_value: torch.Tensor,
        teacher_action: torch.Tensor,
        leaf: torch.Tensor | None = None,
        weight: torch.Tensor | None = None,
    ) -> None:
        """Copy one step of all envs.

        ``final_value`` (N,), as ``final_value(policy, x)`` gives it, is the value of the observation in which
        an episode ended, read where ``ended``; elsewhere the next step's value takes its place (``close``
        gives the last step's). Raises RuntimeError when full.
        """
        if self.filled == self.steps:
            raise RuntimeError(
                f"the rollout is full ({self.steps} steps): close and clear it before the next step"
            )
        t = self.filled
        if t > 0:
            self._bridge(t - 1, step.value)
        self.x[t].copy_(x)
        self.action[t].copy_(step.action)
        self.log_prob[t].copy_(step.log_prob)
        self.value[t].copy_(step.value)
        self.reward[t].copy_(reward)
        self.terminated[t].copy_(terminated)
        self.ended[t].copy_(ended)
        self.next_value[t].copy_(final_value)
        self.teacher_action[t].copy_(teacher_action)
        self.leaf[t].copy_(leaf) if leaf is not None else self.leaf[t].fill_(-1)
        self.weight[t].copy_(weight) if weight is not None else self.weight[t].fill_(1.0)
        self.filled += 1

    def close(self, last_value: torch.Tensor) -> None:
        """Give the value (N,) of the observations after the last step. Raises RuntimeError while steps are
        missing."""
        if self.filled != self.steps:
            raise RuntimeError(
                f"the rollout has {self.filled} of {self.steps} steps: add the others before it is closed"
            )
        self._bridge(self.steps - 1, last_value)

    def flat(self, name: str) -> torch.Tensor:
        """The tensor of this name as (T N, ...), a view."""
        return getattr(self, name).flatten(0, 1)

    def _bridge(self, t: int, value: torch.Tensor) -> None:
        """The value of the observation after step t, where the episode went on."""
        torch.where(self.ended[t], self.next_value[t], value, out=self.next_value[t])


@torch.no_grad()
def final_value(
    policy: ActorCritic, final_x: torch.Tensor, terminated: torch.Tensor, ended: torch.Tensor
) -> torch.Tensor:
    """(N,) value of the inputs final_x (N, n_in) in which episodes were cut off, zero elsewhere: few rows, so
    only they are computed."""
    value = torch.zeros(len(final_x), device=final_x.device)
    rows = (ended & ~terminated).nonzero().flatten()
    if len(rows):
        value[rows] = policy.value(final_x[rows])
    return value


# ------------------------------------------------------------------------------------------------------------
# Counts of a rollout, and the figures of the episodes that ended last.


WINDOW = 100
"""episodes at least that a figure is the mean of, once there were so many (as other trainers do)"""


@dataclass
class RolloutSums:
    """Sums over one rollout, kept on the device until its end."""

    outcomes: torch.Tensor
    """(n_outcome,) episodes that ended, by outcome"""
    episode_return: torch.Tensor
    """() sum over the episodes that ended"""
    episode_steps: torch.Tensor
    """() the same of their lengths"""
    terms: torch.Tensor
    """(n_term,) every weighted reward term, sum over all steps"""
    samples: torch.Tensor
    """() steps taken"""

    @classmethod
    def zeros(cls, n_outcome: int, n_term: int, device: torch.device) -> RolloutSums:
        """Nothing counted yet."""
        return cls(
            *(
                torch.zeros(size, dtype=torch.float64, device=device)
                for size in ((n_outcome,), (), (), (n_term,), ())
            )
        )


class Recent:
    """The newest iterations that together hold at least ``WINDOW`` ended episodes."""

    def __init__(self, outcomes: Sequence[str], terms: Sequence[str]) -> None:
        """Names of the outcomes and of the reward's terms, in the order of the sums."""
        self.outcomes, self.terms = tuple(outcomes), tuple(terms)
        self.rows: list[list[float]] = []
        """[return, steps, one count per outcome] of every iteration in the window, oldest first"""

    def add(self, sums: RolloutSums) -> dict[str, float]:
        """Take in a rollout; ``rollout/*`` over the window (none before the first episode has ended),
        ``reward/*`` over the rollout."""
        self.rows.append([float(sums.episode_return), float(sums.episode_steps), *sums.outcomes.tolist()])
        while sum(self._episodes(row) for row in self.rows[1:]) >= WINDOW:
            self.rows.pop(0)
        metrics = {
            f"reward/{n}": v / float(sums.samples)
            for n, v in zip(self.terms, sums.terms.tolist(), strict=True)
        }
        total, steps, *counts = (sum(column) for column in zip(*self.rows, strict=True))
        episodes = sum(counts)
        if not episodes:
            return metrics
        by_name = dict(zip(self.outcomes, counts, strict=True))
        return metrics | {
            "rollout/ep_rew_mean": total / episodes,
            "rollout/ep_len_mean": steps / episodes,
            "rollout/success_rate": by_name["success"] / episodes,
            "rollout/collision_rate": sum(by_name[name] for name in COLLIDED) / episodes,
            "rollout/timeout_rate": by_name["timeout"] / episodes,
            "rollout/episodes": self._episodes(self.rows[-1]),
        }

    @property
    def episodes(self) -> float:
        """Episodes that the figures are the mean of."""
        return sum(self._episodes(row) for row in self.rows)

    @staticmethod
    def _episodes(row: list[float]) -> float:
        return sum(row[2:])


# ------------------------------------------------------------------------------------------------------------
# A decision held for several control steps (frame skip): to the learner they are one transition.


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
    """Drives the envs through ``steps`` control steps by one action.

    An episode that begins on the way is driven by the behaviour tree until the next decision.
    """

    def __init__(self, env: VectorEnv, steps: int) -> None:
        self._env, self.steps = env, steps

    def drive(self, action: torch.Tensor, watch: Watch | None = None) -> HeldResult:
        """Carry out ``action`` (N, 4)."""
        end = self._step(action)
        if watch:
            watch(end.ended, end.info)
        if self.steps == 1:
            return end
        end = end._replace(
            final_obs=end.final_obs.clone(), reward=end.reward.clone(), terminated=end.terminated.clone()
        )
        for _ in range(self.steps - 1):
            newest = end.info["teacher_action"].nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
            step = self._step(torch.where(end.ended[:, None], newest, action))
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


# ------------------------------------------------------------------------------------------------------------


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
        self.hold = Hold(env, policy.config.hold_steps)
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
        end = self.hold.drive(action, None if sums is None else lambda ended, info: _count(sums, ended, info))
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
