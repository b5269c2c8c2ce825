"""Memory of one rollout: T steps of N envs, allocated once."""

from __future__ import annotations

import torch

from uuvtai.learn.policy import NUM_ACTIONS, ActorCritic, PolicyStep


class Rollout:
    """Tensors (T, N, ...) in order of time; ``flat`` views them as (T N, ...), so that a run of rows is a
    block of memory.

    Row t of env n: input ``x``, what was done (``action``, ``log_prob``, ``value``) and what came of it
    (``reward``, ``next_value`` of the true next observation, ``terminated``, ``ended``), the teacher's action
    in x, the leaf of the tree that gave it (-1: none), and the weight of the sample in the distillation.
    """

    def __init__(
        self,
        steps: int,
        num_envs: int,
        n_in: int,
        device: torch.device | str = "cpu",
    ) -> None:
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
