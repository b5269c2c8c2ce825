"""A simulator kept busy, for measurements of speed."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from uuvtai.sim import Sim


@dataclass
class SimBatch:
    """A simulator kept running: ended rows begin their next episode at once."""

    sim: Sim
    first_episode: int = 0
    """number of row 0's first episode; the other rows begin with the numbers after it"""
    env_steps: int = 0
    replans: int = 0
    episodes: int = 0

    def __post_init__(self) -> None:
        n, device = self.sim.num_envs, self.sim.device
        self._number = torch.arange(n, dtype=torch.int32, device=device) + self.first_episode
        self._seed = torch.zeros(n, dtype=torch.int32, device=device)
        self.sim.reset(torch.ones(n, dtype=torch.int32, device=device), self._seed, self._number)

    def step(self, action: torch.Tensor | None = None) -> None:
        """One step of every env, resets included."""
        self.sim.step(action)
        self.env_steps += self.sim.num_envs
        self.renew()

    def renew(self) -> None:
        """Begin the next episode of every row whose episode has ended."""
        ended = self.sim.terminated | self.sim.truncated
        if bool(ended.any()):
            rows = ended.nonzero().flatten().tolist()
            self.replans += int(self.sim.rows(self.sim.s.route.replans, rows).sum())
            self.episodes += len(rows)
            self._number += ended * self.sim.num_envs
            self.sim.reset(ended, self._seed, self._number)
