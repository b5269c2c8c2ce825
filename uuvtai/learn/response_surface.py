"""Which way to change many numbers at once, from many noisy trials in which each was changed at random.

A quadratic without mixed terms is fitted to the trials by ridge regression: a response surface (Box & Wilson
1951, Journal of the Royal Statistical Society B 13). Noise of one trial hardly matters, for every trial says
something about every number.
"""

from __future__ import annotations

import numpy as np

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
