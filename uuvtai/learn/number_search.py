"""A search among many numbers at once: trials drawn around the best ones so far, and steps along the response
surface of all trials (``response_surface``)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from uuvtai.learn.response_surface import best_near, fitted


class NumberSearch:
    """Best numbers so far, every trial, and where the next ones lie. It draws from a generator of its own:
    what two searches find does not depend on whether they run in turns or one after the other."""

    def __init__(
        self, centre: torch.Tensor, bounds: torch.Tensor, spread: float, size: int, seed: int
    ) -> None:
        """``centre`` (n,) to begin at, within ``bounds`` (2, n); trials lie within ``spread`` of the way
        between these around the best ones; ``size`` is the most trials there will be."""
        self.centre = centre.clone()
        self.low, self.high = bounds
        self.spread = spread * (self.high - self.low)
        self.trials = 0
        self._generator = torch.Generator().manual_seed(seed)
        self._place, self._score = torch.zeros(size, len(centre)), torch.zeros(size)
        self._group = torch.zeros(size, dtype=torch.int64)

    @property
    def size(self) -> int:
        """The most trials there will be."""
        return len(self._score)

    def drawn(self, count: int) -> torch.Tensor:
        """(count, n) numbers to try, by pairs for one episode each: anywhere within ``spread``, the second of
        a pair as far the other way (mirrored sampling)."""
        draw = torch.rand(count // 2, len(self.centre), generator=self._generator)
        way = (2.0 * draw - 1.0) * self.spread
        tried = self.centre + torch.stack([way, -way], 1).reshape(count, len(self.centre))
        return tried.clamp(self.low, self.high)

    def take(self, place: torch.Tensor, score: torch.Tensor, group: int) -> None:
        """Remember trials at ``place`` (count, n) with scores (count,), all of one ``group``: the levels of
        groups say nothing about the numbers."""
        rows = slice(self.trials, self.trials + len(place))
        self._place[rows], self._score[rows], self._group[rows] = place, score, group
        self.trials += len(place)

    def move(self) -> None:
        """One step along the surface of all trials."""
        n = slice(self.trials)
        place, spread = self._place[n].double().numpy(), self.spread.double().numpy()
        slope, bend = fitted(place, self._score[n].double().numpy(), self._group[n].numpy(), spread)
        centre, low, high = (part.double().numpy() for part in (self.centre, self.low, self.high))
        self.centre = torch.from_numpy(best_near(centre, slope, bend, spread, low, high)).float()

    def state(self) -> dict[str, Any]:
        """All that the next steps depend on, but for ``memory``."""
        return {"centre": self.centre, "generator": self._generator.get_state(), "trials": self.trials}

    def memory(self) -> dict[str, torch.Tensor]:
        """Every trial."""
        return {"place": self._place, "score": self._score, "group": self._group}

    def load_state(self, state: Mapping[str, Any], memory: Mapping[str, torch.Tensor]) -> None:
        """Go on from what ``state`` and ``memory`` gave."""
        self.centre = state["centre"].clone()
        self._generator.set_state(state["generator"])
        self.trials = int(state["trials"])
        for name, own in self.memory().items():
            own.copy_(memory[name])
