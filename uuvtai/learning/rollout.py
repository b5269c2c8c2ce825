"""Rollouts: the policy drives the envs for T steps; what it met is kept, and ended episodes are counted."""

from __future__ import annotations

import functools
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from uuvtai.common.enums import COLLIDED, OUTCOMES
from uuvtai.learning.networks import Policy, TrainingError, View


class Step(NamedTuple):
    """What came of a decision, (N, ...)."""

    reward: Tensor
    """NaN where the sample is to be left out"""
    terminated: Tensor
    ended: Tensor
    """bool, terminated or cut off; the env has begun its next episode"""
    final: View | None
    """the view that the decision led to; None where no episode was cut off"""
    told: View
    """more of the step that the rollout keeps"""


class Environment(ABC):
    """What a rollout needs of the places where a policy learns (``environments.py``)."""

    env: Any
    carried: View
    """what is kept beside ``env.capture()``"""
    device: torch.device
    view: View
    """what is known now; written anew by ``step``"""
    node_names: Sequence[str] = ()
    """of the tree that teaches: ``teacher_action`` and ``leaf`` are then in the view"""
    outcomes: Sequence[str] = OUTCOMES
    reward_terms: Sequence[str] = ()

    @abstractmethod
    def step(self, action: Tensor, sums: RolloutSums) -> Step:
        """Carry out a decision (N, n_action), and count it."""

    def state_dict(self) -> View:
        return dict(self.carried)

    def load_state_dict(self, state: View) -> None:
        """After ``restore``."""
        for name, part in self.carried.items():
            part.copy_(state[name])

    def restore(self, arrays: dict[str, Any]) -> None:
        """Go on with what ``env.capture`` gave; ValueError, with nothing changed, for another env's."""
        self.env.restore(arrays)


# ------------------------------------------------------------------------------------------------------------
# Memory of one rollout: T steps of N envs, allocated once.


class Rollout(dict[str, Tensor]):
    """Tensors (T, N, ...) by name: the view, what was decided (``PolicyStep``), what came of it (``reward``,
    ``next_value`` of the true next view, ``terminated``, ``ended``) and what the environment told beside."""

    def __init__(self, steps: int) -> None:
        super().__init__()
        self.steps = steps

    def note(self, t: int, row: View) -> None:
        """Copy what is known of step t, each (N, ...)."""
        for name, part in row.items():
            if name not in self:
                self[name] = part.new_zeros(self.steps, *part.shape)
            self[name][t].copy_(part)

    def close(self, last_value: Tensor) -> None:
        """``next_value`` where an episode went on: of the next view, after the last step ``last_value``."""
        following = torch.cat([self["value"][1:], last_value[None]])
        torch.where(self["ended"], self["next_value"], following, out=self["next_value"])

    def flat(self) -> View:
        """Everything as (T N, ...), views: a run of rows is a block of memory."""
        return {name: part.flatten(0, 1) for name, part in self.items()}

    def valid(self) -> Tensor:
        """(T, N) bool: everything about the sample is finite."""
        total = torch.zeros_like(self["reward"])
        for part in self.values():
            if part.is_floating_point():
                total += part.flatten(2).sum(dim=2) if part.dim() > 2 else part
        return torch.isfinite(total)

    def where(self, valid: Tensor) -> Rollout:
        """A copy that is 0 where ``valid`` (T, N) is not."""
        found = Rollout(self.steps)
        for name, part in self.items():
            found[name] = part.masked_fill(~valid.view(*valid.shape, *[1] * (part.dim() - 2)), 0)
        return found


@torch.no_grad()
def collect(
    env: Environment, policy: Policy, rollout: Rollout, generator: torch.Generator
) -> tuple[RolloutSums, dict[str, float]]:
    """Fill the rollout; what is counted, and the wall time [s] of simulating and of inferring."""
    began, simulate_s = time.perf_counter(), 0.0
    sums = RolloutSums(len(env.outcomes), len(env.reward_terms), env.device)
    for t in range(rollout.steps):
        step = policy.act(env.view, generator)
        if not bool(torch.isfinite(step.action).all()):
            raise TrainingError(
                "the policy's actions are not finite: begin anew with a smaller ppo.learning_rate"
            )
        rollout.note(t, env.view | step._asdict())
        between = time.perf_counter()
        end = env.step(step.action, sums)
        simulate_s += time.perf_counter() - between
        came = {"reward": end.reward, "terminated": end.terminated, "ended": end.ended}
        rollout.note(t, came | {"next_value": final_value(policy, end)} | end.told)
    rollout.close(policy.expected(env.view))
    infer_s = time.perf_counter() - began - simulate_s
    return sums, {"time/simulate_s": simulate_s, "time/infer_s": infer_s}


def final_value(policy: Policy, step: Step) -> Tensor:
    """(N,) value of the views in which episodes were cut off, zero elsewhere."""
    value = torch.zeros(len(step.ended), device=step.ended.device)
    rows = (step.ended & ~step.terminated).nonzero().flatten()
    if len(rows) and step.final is not None:
        value[rows] = policy.expected({name: part[rows] for name, part in step.final.items()})
    return value


# ------------------------------------------------------------------------------------------------------------
# Counts of a rollout, and the figures of the episodes that ended last.


WINDOW = 100  # episodes at least that a figure is the mean of, once there were so many (as other trainers do)


class RolloutSums:
    """Sums over one rollout, kept on the device until its end."""

    def __init__(self, n_outcome: int, n_term: int, device: torch.device) -> None:
        zeros = functools.partial(torch.zeros, dtype=torch.float64, device=device)
        self.outcomes, self.episode_return, self.episode_steps = zeros(n_outcome), zeros(()), zeros(())
        """of the episodes that ended: number by outcome (n_outcome,), sums of returns and of steps"""
        self.terms, self.samples = zeros(n_term), zeros(())
        """sums of the weighted reward terms (n_term,), and number, of all steps"""

    def count(self, ended: Tensor, info: View) -> None:
        """Add one control step of all envs, of which these (N,) ended: ``info`` of ``VectorEnv.step``."""
        self.outcomes.index_add_(0, info["outcome"].long(), ended.double())
        self.episode_return += torch.where(ended, info["episode_return"], 0.0).nansum()
        self.episode_steps += (info["episode_steps"] * ended).sum()
        self.terms += info["reward_terms"].nansum(dim=0)
        self.samples += len(ended)


class Recent:
    """The newest iterations that together hold at least ``WINDOW`` ended episodes."""

    def __init__(self, outcomes: Sequence[str], terms: Sequence[str]) -> None:
        self.outcomes, self.terms = tuple(outcomes), tuple(terms)
        self.rows: list[list[float]] = []
        """[return, steps, one count per outcome] of every iteration in the window, oldest first"""

    def add(self, sums: RolloutSums) -> dict[str, float]:
        """Take in a rollout; ``rollout/*`` over the window, ``reward/*`` over the rollout."""
        self.rows.append([float(sums.episode_return), float(sums.episode_steps), *sums.outcomes.tolist()])
        while sum(sum(row[2:]) for row in self.rows[1:]) >= WINDOW:
            self.rows.pop(0)
        by_term = zip(self.terms, (sums.terms / sums.samples).tolist(), strict=True)
        metrics = {f"reward/{name}": mean for name, mean in by_term}
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
            "rollout/episodes": float(sums.outcomes.sum()),
        }

    @property
    def episodes(self) -> float:
        """Episodes that the figures are the mean of."""
        return sum(sum(row[2:]) for row in self.rows)
