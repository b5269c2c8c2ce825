"""What the chooser learns from: moments of episodes in which tree and policy took turns, and where each
moment led to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch


class Choices(NamedTuple):
    """Rows of one choice each."""

    bodies: torch.Tensor
    """(n, lanes, n_body) float16"""
    own: torch.Tensor
    """(n, n_own) float16"""
    drives: torch.Tensor
    """(n,) uint8: the policy drove on"""
    ahead: torch.Tensor
    """(n,) int32: so many rows later the same one still drives, or the other takes over, or it ends"""
    ended: torch.Tensor
    """(n,) uint8: the episode ended before that"""
    arrived: torch.Tensor
    """(n,) uint8: the episode's end"""


@dataclass(frozen=True)
class Tick:
    """The choices of one tick, as they came, rows of several episodes."""

    job: torch.Tensor
    age: torch.Tensor
    bodies: torch.Tensor
    own: torch.Tensor
    drives: torch.Tensor


def moments_of_episodes(ticks: list[Tick], arrived: torch.Tensor, steps: int) -> Choices:
    """Choices of whole episodes, one episode after the other; ``arrived`` (jobs,) by job. A moment looks at
    most ``steps`` choices ahead, as long as nobody takes over."""
    job, age = (torch.cat([getattr(tick, name) for tick in ticks]) for name in ("job", "age"))
    order = torch.argsort(job * (int(age.max()) + 1) + age)
    bodies, own, drives = (
        torch.cat([getattr(tick, name) for tick in ticks])[order] for name in ("bodies", "own", "drives")
    )
    job = job[order]
    rows = torch.arange(len(job))
    goes_on = torch.cat([job[1:] == job[:-1], torch.zeros(1, dtype=torch.bool)])
    at, ended, free = (
        rows.clone(),
        torch.zeros(len(job), dtype=torch.bool),
        torch.ones(len(job), dtype=torch.bool),
    )
    for _ in range(steps):
        ended |= free & ~goes_on[at]
        free &= goes_on[at]
        at = torch.where(free, at + 1, at)
        free &= drives[at] == drives
    return Choices(
        bodies.half(), own.half(), drives.byte(), (at - rows).int(), ended.byte(), arrived[job].byte()
    )


class ChooserMemory:
    """The newest moments, in a ring of a fixed size. A moment is never newer than what it led to, so that one
    whose future has been overwritten has been overwritten too."""

    def __init__(self, size: int, lanes: int, n_body: int, n_own: int) -> None:
        def empty(dtype: torch.dtype, *shape: int) -> torch.Tensor:
            return torch.zeros(size, *shape, dtype=dtype)

        self.rows = Choices(
            bodies=empty(torch.float16, lanes, n_body),
            own=empty(torch.float16, n_own),
            drives=empty(torch.uint8),
            ahead=empty(torch.int32),
            ended=empty(torch.uint8),
            arrived=empty(torch.uint8),
        )
        self.count = self.at = 0

    def add(self, new: Choices) -> None:
        """Write over the oldest ones."""
        size = len(self.rows.drives)
        n = min(len(new.drives), size)
        place = (self.at + torch.arange(n)) % size
        for own, part in zip(self.rows, new, strict=True):
            own[place] = part[-n:]
        self.at, self.count = (self.at + n) % size, min(self.count + n, size)

    def draw(self, n: int, generator: torch.Generator) -> torch.Tensor:
        """(n,) rows, any of them."""
        return torch.randint(self.count, (n,), generator=generator)

    def after(self, rows: torch.Tensor) -> torch.Tensor:
        """(n,) rows that these led to."""
        return (rows + self.rows.ahead[rows]) % len(self.rows.drives)
