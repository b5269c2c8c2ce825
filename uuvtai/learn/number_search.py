"""A search among many numbers at once: trials drawn around the best ones so far, and steps along the response
surface of all trials.

A quadratic without mixed terms is fitted to the trials by ridge regression: a response surface (Box & Wilson
1951, Journal of the Royal Statistical Society B 13). Noise of one trial hardly matters, for every trial says
something about every number.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch


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


PAIR_CORRELATION = 0.4
"""of the scores of two trials of one episode: as measured in the fast gauntlet"""
SLOPE_SD, BEND_MEAN, BEND_SD = 0.02, -0.01, 0.01
"""what is expected of the terms per ``spread`` and per its square: the narrower, the more trials it takes to
believe in an effect; numbers that are in use have their best place somewhere near"""


def fitted(
    place: np.ndarray, score: np.ndarray, group: np.ndarray, spread: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(slopes, bends), both (n,) per unit of ``spread`` (n,), of the scores (m,) of trials at ``place`` (m,
    n): score = level of its group + slopes x + bends x^2. ``group`` (m,) are numbers from 0 on. Trials 0
    and 1, 2 and 3, .. are of one episode: what makes it easy or hard counts for both alike."""
    x = place / spread
    level = np.eye(int(group.max()) + 1)[group]
    columns = np.concatenate([level, x, x * x], axis=1)
    centred = score - (level @ (level.T @ score / np.maximum(level.sum(0), 1)))
    noise = max(float(np.mean(centred**2)), 1e-9)
    columns, score = _uncorrelated(columns), _uncorrelated(score)
    n, n_level = x.shape[1], level.shape[1]
    prior = np.concatenate(
        [np.full(n_level, 1e-6), np.full(n, noise / SLOPE_SD**2), np.full(n, noise / BEND_SD**2)]
    )
    mean = np.concatenate([np.zeros(n_level + n), np.full(n, BEND_MEAN)])
    found = np.linalg.solve(columns.T @ columns + np.diag(prior), columns.T @ score + prior * mean)
    return found[n_level : n_level + n], found[n_level + n :]


def _uncorrelated(rows: np.ndarray) -> np.ndarray:
    """Sums and differences of the pairs, both with errors of the same size that are not correlated."""
    first, second = rows[0::2], rows[1::2]
    total = (first + second) / np.sqrt(2.0 * (1.0 + PAIR_CORRELATION))
    return np.concatenate([total, (first - second) / np.sqrt(2.0 * (1.0 - PAIR_CORRELATION))])


def best_near(
    centre: np.ndarray,
    slope: np.ndarray,
    bend: np.ndarray,
    spread: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
) -> np.ndarray:
    """(n,) highest place of the surface within half a ``spread`` of ``centre`` and within the bounds."""
    first, last = np.maximum(centre - 0.5 * spread, low), np.minimum(centre + 0.5 * spread, high)
    top = np.where(bend < 0, -0.5 * slope / np.where(bend < 0, bend, -1.0) * spread, first)
    tries = np.stack([first, last, np.clip(top, first, last)])
    x = tries / spread
    return np.take_along_axis(tries, np.argmax(slope * x + bend * x * x, axis=0)[None], axis=0)[0]
