"""Policy over a set of obstacles: every obstacle goes through one encoder, and what comes out is pooled by
maximum and sum, so that neither their order nor their number matters."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from uuvtai.common.enums import EGO_COLUMNS, OBSTACLE_WIDTH
from uuvtai.config.learning import LearningConfig
from uuvtai.learning.checkpoint import Checkpoint
from uuvtai.learning.networks import Policy, RunningNorm, View, mlp
from uuvtai.learning.policy_agent import network

NUM_WISHES = 3  # ahead, left, up: parts of the fastest velocity, in the mirrored world
MOST_WISH = 2.0  # wishes beyond it are cut off before they are carried out
AT_DIRECTION = slice(3, 5)  # columns of ``own`` with the unit vector to the look-ahead point of the route
_SUM_SCALE = 0.3  # sums over the obstacles are a few times as large as a maximum


class SetEncoder(nn.Module):
    """Obstacles (..., n, n_obstacle), of which ``mask`` (..., n, 1) are there, and own columns to numbers."""

    def __init__(
        self, sizes: tuple[int, int, int], config: LearningConfig, gain: float, generator: torch.Generator
    ) -> None:
        """``sizes``: n_obstacle, n_own, n_out."""
        super().__init__()
        n_obstacle, n_own, n_out = sizes
        wide, head = config.surrogate.obstacle_hidden, config.surrogate.head_hidden
        self.obstacle = mlp((n_obstacle, wide, wide), "relu", generator, math.sqrt(2.0))
        self.own = nn.Sequential(*mlp((n_own, wide), "relu", generator, math.sqrt(2.0)), nn.ReLU())
        self.head = mlp((3 * wide, head, head, n_out), "relu", generator, gain)

    def forward(self, obstacles: Tensor, own: Tensor, mask: Tensor) -> Tensor:
        n, rows = obstacles.shape[-2], obstacles.shape[:-2]
        # obstacles first, as pooling wants them; as rows, for which ReLU in place costs nothing
        each = obstacles.reshape(-1, n, obstacles.shape[-1]).transpose(0, 1)
        said = self.obstacle(each.flatten(0, 1)).reshape(*each.shape[:2], -1)
        highest, total = MaxAndSum.apply(said, mask.reshape(-1, n).t())
        pooled = torch.cat((highest, _SUM_SCALE * total), dim=-1)
        return self.head(torch.cat((pooled.reshape(*rows, -1), self.own(own)), dim=-1))


class SetActor(nn.Module):
    """A diagonal Gaussian over the wish for a velocity, of what the vehicle knows."""

    def __init__(self, config: LearningConfig, generator: torch.Generator) -> None:
        super().__init__()
        self.goal_gain = config.surrogate.goal_gain
        self.net = SetEncoder((OBSTACLE_WIDTH, EGO_COLUMNS, NUM_WISHES), config, 0.01, generator)
        self.log_std = nn.Parameter(torch.full((NUM_WISHES,), math.log(config.policy.initial_std)))

    def forward(self, obstacles: Tensor, own: Tensor) -> Tensor:
        """(..., 3) mean wish; along the route at birth."""
        ahead = self.goal_gain * own[..., AT_DIRECTION]
        said = self.net(obstacles, own, obstacles[..., :1])
        return torch.cat([ahead + said[..., :2], said[..., 2:]], dim=-1)


class SetCritic(nn.Module):
    """Expected return, also by the obstacles' true places, now and later: it serves training alone."""

    def __init__(self, n_truth: int, config: LearningConfig, generator: torch.Generator) -> None:
        super().__init__()
        self.net = SetEncoder((OBSTACLE_WIDTH + n_truth, EGO_COLUMNS, 1), config, 1.0, generator)
        self.value_norm = RunningNorm(1, math.inf)

    def forward(self, obstacles: Tensor, own: Tensor, truth: Tensor) -> Tensor:
        there = torch.maximum(obstacles[..., :1], truth[..., 2:3])
        return self.net(torch.cat([obstacles, truth], dim=-1), own, there).squeeze(-1)


class SetPolicy(Policy):
    """Both, on ``obstacles`` (N, lanes, n_obstacle), ``own`` (N, n_own) and ``truth`` (N, lanes, n_truth)."""

    inputs = ("obstacles", "own", "truth")
    is_shuffled, most_std, critic_rate = True, 1.0, 1e-3

    def __init__(self, view: View, config: LearningConfig, generator: torch.Generator) -> None:
        super().__init__(config.policy)
        self.actor = SetActor(config, generator)
        self.critic = SetCritic(view["truth"].shape[-1], config, generator)
        self.log_std, self.value_norm = self.actor.log_std, self.critic.value_norm

    def mean_of(self, inputs: View) -> Tensor:
        return self.actor(inputs["obstacles"], inputs["own"])

    def value_of(self, inputs: View) -> Tensor:
        return self.critic(*(inputs[name] for name in self.inputs))

    def parts(self) -> dict[str, nn.Module]:
        return {"policy": self.actor, "critic": self.critic}  # no file that drives holds the critic


class MaxAndSum(torch.autograd.Function):
    """(highest, sum), both (rows, wide), of relu(said) (obstacles, rows, wide) where ``mask`` (obstacles,
    rows) is 1. Its gradient is that of torch's operations, in a fraction of their time."""

    @staticmethod
    def forward(ctx: Any, said: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        each = torch.relu(said).mul_(mask.unsqueeze(-1))
        highest = each.amax(dim=0)
        ctx.save_for_backward(each, highest)
        return highest, each.sum(dim=0)

    @staticmethod
    def backward(ctx: Any, *to_outputs: Tensor) -> tuple[Tensor, None]:
        to_highest, to_sum = to_outputs
        each, highest = ctx.saved_tensors
        is_highest = each.clone().eq_(highest)
        to_each = is_highest.mul_(to_highest / is_highest.sum(dim=0)).add_(to_sum)
        torch.ops.aten.threshold_backward.grad_input(to_each, each, 0, grad_input=to_each)
        return to_each, None


def actor_of(checkpoint: Checkpoint) -> SetActor:
    """A checkpoint's policy over a set. Raises CheckpointError for networks that do not fit its config."""
    return network(checkpoint, "policy", lambda: SetActor(checkpoint.config, torch.Generator()))
