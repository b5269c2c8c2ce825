"""One decision: an action held for one or several control steps."""

from __future__ import annotations

from typing import NamedTuple

import torch

from uuvtai.env import VectorEnv
from uuvtai.outcomes import SUCCESS


class Transition(NamedTuple):
    """What came of a decision in every env. ``obs`` and ``info`` are the simulator's memory: the next step or
    reset writes there."""

    obs: torch.Tensor
    reward: torch.Tensor
    """sum over the control steps"""
    terminated: torch.Tensor
    truncated: torch.Tensor
    info: dict[str, torch.Tensor]


def checked_hold_steps(hold_steps: int) -> int:
    """The number itself; ValueError where an action cannot be held for so many steps."""
    if type(hold_steps) is not int or hold_steps < 1:
        raise ValueError(f"hold_steps must be a whole number of at least 1 control step, got {hold_steps!r}")
    return hold_steps


def carry_out(env: VectorEnv, action: torch.Tensor, hold_steps: int) -> Transition:
    """Hold ``action`` (n_env, 4); rows whose episode ends on the way rest from there on and earn no more
    (``autoreset`` is off)."""
    obs, reward, terminated, truncated, info = env.step(action)
    total = reward.clone()
    for _ in range(hold_steps - 1):
        obs, reward, terminated, truncated, info = env.step(action)
        total += reward
    return Transition(obs, total, terminated.clone(), truncated.clone(), info)


def public_info(info: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """What an env of this package tells in its info, each (n_env, ...), in the simulator's memory.

    The number of the episode is not called "episode", which wrappers of Gymnasium and trainers keep for their
    statistics.
    """
    out = {
        name: info[name]
        for name in ("teacher_action", "seed", "outcome", "episode_return", "episode_steps", "episode_terms")
    }
    return out | {"episode_number": info["episode"], "is_success": info["outcome"] == SUCCESS}
