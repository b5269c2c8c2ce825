"""Counts of a rollout, and the figures of the episodes that ended last."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from uuvtai.outcomes import COLLIDED

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
