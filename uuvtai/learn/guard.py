"""What is not a finite number neither spreads nor stays silent: it is replaced, counted by name, and
iteration after iteration an error."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from uuvtai.errors import UserError

PREFIX = "non_finite/"
"""of the metrics that count what was replaced; they are there only when something was"""


class TrainingError(UserError, RuntimeError):
    """Training cannot go on: what is wrong, since when, and what to type next."""


class Guard:
    """Replaces values that are not finite and counts them, without a wait for the device."""

    def __init__(
        self, columns: Sequence[tuple[str, slice]], num_envs: int, patience: int, device: torch.device
    ) -> None:
        """``columns``: names of the observation's columns; ``patience``: iterations in a row with something
        bad before it is an error."""
        self.columns, self.patience = tuple(columns), patience
        width = max((place.stop for _, place in self.columns), default=0)
        self._observation = torch.zeros(width, dtype=torch.int64, device=device)
        self._rows = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self._none = torch.zeros_like(self._rows)
        self._other: dict[str, torch.Tensor] = {
            name: torch.zeros((), dtype=torch.int64, device=device) for name in _NAMES
        }
        self.bad_in_a_row = 0

    def observation(
        self, obs: torch.Tensor, fill: torch.Tensor, out: torch.Tensor, counted: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Copy obs (N, n_obs) into ``out``, with ``fill`` (n_obs,) in place of what is not finite; returns
        which rows were bad, (N,).

        ``counted`` (N,): rows that count (default: all).
        """
        if _is_sound(obs):
            out.copy_(obs)
            return self._none
        bad = ~torch.isfinite(obs)
        torch.where(bad, fill, obs, out=out)
        counting = bad if counted is None else bad & counted[:, None]
        self._observation += counting.sum(dim=0)
        rows = bad.any(dim=1)
        self._rows |= counting.any(dim=1)
        return rows

    def values(self, name: str, values: torch.Tensor, out: torch.Tensor) -> torch.Tensor:
        """Copy ``values`` (N, ...) into ``out`` with 0 in place of what is not finite; returns which rows
        were bad, (N,)."""
        if _is_sound(values):
            out.copy_(values)
            return self._none
        bad = ~torch.isfinite(values)
        out.copy_(values).masked_fill_(bad, 0.0)
        rows = bad if bad.dim() == 1 else bad.any(dim=1)
        self._other[name] += bad.sum()
        self._rows |= rows
        return rows

    def take(self) -> dict[str, float]:
        """Counts since the last call by name, those above zero only: ``non_finite/<column>``,
        ``non_finite/reward`` and so on."""
        counts = self._observation.tolist()
        found = {name: sum(counts[place]) for name, place in self.columns} | {
            n: int(t) for n, t in self._other.items()
        }
        self._observation.zero_()
        for counter in self._other.values():
            counter.zero_()
        return {f"{PREFIX}{name}": float(count) for name, count in found.items() if count}

    def judge(
        self, iteration: int, complaints: Sequence[str], seed: torch.Tensor, episode: torch.Tensor
    ) -> None:
        """Count an iteration with or without complaints; TrainingError after ``patience`` in a row with some.

        ``seed`` and ``episode`` (N,): which scenarios the envs are in, for the message.
        """
        rows = self._rows.nonzero().flatten().tolist()
        self._rows.zero_()
        self.bad_in_a_row = self.bad_in_a_row + 1 if complaints else 0
        if self.bad_in_a_row < self.patience:
            return
        envs = "".join(
            f"; env {row} (seed {int(seed[row])}, episode {int(episode[row])})" for row in rows[:_ROWS_TOLD]
        )
        raise TrainingError(
            f"iterations {iteration - self.bad_in_a_row + 1} to {iteration} were all bad: "
            f"{'; '.join(complaints)}{envs}. What was bad did not change the networks. If updates were left "
            "out, go on with smaller steps: uuv train --resume RUN --set ppo.learning_rate=1e-4. If an "
            "observation or a reward is not finite, the simulator is at fault: please report seed and episode"
        )


def guarded_step(loss: torch.Tensor, module: torch.nn.Module, optimiser: torch.optim.Optimizer) -> bool:
    """One gradient step on ``loss`` (a scalar); False where the gradient is zero or not finite, and nothing
    was changed."""
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    gradients = [p.grad for p in module.parameters() if p.grad is not None]
    sound = 0.0 < float(torch.nn.utils.get_total_norm(gradients)) < math.inf
    if sound:
        optimiser.step()
    return sound


def _is_sound(values: torch.Tensor) -> bool:
    """Whether everything is finite, asked where that is no wait for a device: whatever is not makes the sum
    so, and so may large numbers, which are then looked at one by one."""
    return values.device.type == "cpu" and math.isfinite(values.sum())


_ROWS_TOLD = 4
_NAMES = ("reward", "teacher_action", "world_model_features")
