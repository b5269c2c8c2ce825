"""Intervals for rates and means, paired comparison of agents, and the two time figures. Hand-checked in
tests/common/test_statistics.py."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np

Z95 = 1.959963984540054  # Two-sided 95 % quantile of the standard normal.


def wilson_interval(k: float, n: float) -> tuple[float, float] | None:
    """95 % Wilson score interval of k successes in n independent trials (Wilson 1927); None when there are no
    trials. Trials that go together count as k / ``design_effect`` of n / ``design_effect``.

    Raises ValueError unless 0 <= k <= n.
    """
    if not 0 <= k <= n:
        raise ValueError(f"k must lie in [0, n], got k={k}, n={n}")
    if n == 0:
        return None
    p = k / n
    scale = 1.0 / (1.0 + Z95 * Z95 / n)
    centre = scale * (p + Z95 * Z95 / (2 * n))
    half = scale * Z95 * math.sqrt(p * (1 - p) / n + Z95 * Z95 / (4 * n * n))
    # the bounds are exact at the ends; rounding must not leave 0.9999999 for 10/10
    return (0.0 if k == 0 else max(0.0, centre - half), 1.0 if k == n else min(1.0, centre + half))


def design_effect(won: Sequence[int], trials: Sequence[int]) -> float:
    """How many times fewer independent trials would say as much: won[i] of trials[i] in cluster i.

    Trials of one cluster go together, as episodes of one number do in all cells of a grid: same start, same
    goal, same layout. Ratio of the variance between clusters to the binomial one (Kish 1965), with Student's
    quantile for few clusters (Korn and Graubard 1998); at least 1, and 1 where no cluster has two trials.
    Where all or none succeeded nothing says how far trials go together: then a cluster counts as one trial.
    """
    n_all, k_all, m = sum(trials), sum(won), len(trials)
    if n_all == m:
        return 1.0
    if m < 2 or k_all in (0, n_all):
        return n_all / max(1, m)
    p = k_all / n_all
    spread = m / (m - 1) * sum((k - p * n) ** 2 for k, n in zip(won, trials, strict=True))
    return max(1.0, spread / (n_all * p * (1 - p))) * (student95(m - 1) / Z95) ** 2


def student_p(t: float, freedom: float) -> float:
    """Two-sided p value of Student's t with any positive ``freedom``: the tail of cos^(freedom - 1), into
    which t = sqrt(freedom) tan(angle) turns the density, by the midpoint rule."""
    first = math.atan2(abs(t), math.sqrt(freedom))
    width = (math.pi / 2 - first) / 4000
    tail = float((np.cos(first + width * (np.arange(4000) + 0.5)) ** (freedom - 1)).sum()) * width
    whole = math.exp(math.lgamma(freedom / 2) - math.lgamma((freedom + 1) / 2)) * math.sqrt(math.pi) / 2
    return min(1.0, tail / whole)


@functools.cache
def student95(freedom: float) -> float:
    """Two-sided 95 % quantile of Student's t for ``freedom`` of one or more, by bisection."""
    low, high = 0.0, 13.0
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if student_p(middle, freedom) > 0.05 else (low, middle)
    return low


def rate(k: int, n: int) -> float | None:
    """k / n, or None without trials."""
    return k / n if n else None


def mean(values: list[float]) -> float | None:
    return sum(values) / len(values) if values else None


def time_to_success_s(mean_time_s: float | None, success_rate: float | None) -> float | None:
    """The paper's TTS = AvgTime / SuccessRate [s]; None where it is undefined (no success, no episodes)."""
    if mean_time_s is None or not success_rate:
        return None
    return mean_time_s / success_rate


_RESAMPLES = 2000  # of a bootstrap: the ends of a 95 % interval then vary by about a twentieth of its width
_BOOTSTRAP_SEED = 20_240_229  # the same samples give the same interval


def bootstrap_interval(values: Sequence[float], resamples: int = _RESAMPLES) -> tuple[float, float] | None:
    """95 % percentile bootstrap interval of the mean (Efron 1979); None for fewer than two values."""
    if len(values) < 2:
        return None
    sample, rng = np.asarray(values, dtype=np.float64), np.random.default_rng(_BOOTSTRAP_SEED)
    means = [sample[rng.integers(len(sample), size=len(sample))].mean() for _ in range(resamples)]
    low, high = np.quantile(means, (0.025, 0.975))
    return float(low), float(high)


def mcnemar_p(only_a: int, only_b: int) -> float:
    """Two-sided exact p value of McNemar's test (1947): pairs in which only one of two agents succeeded,
    binomial with p = 1/2.

    1 where there is no such pair. Raises ValueError for negative counts.
    """
    if only_a < 0 or only_b < 0:
        raise ValueError(f"counts must not be negative, got {only_a} and {only_b}")
    n, few = only_a + only_b, range(min(only_a, only_b))
    _, tail = functools.reduce(lambda at, k: (term := at[0] * (n - k) // (k + 1), at[1] + term), few, (1, 1))
    return min(1.0, 2 * tail / 2**n)  # whole numbers: more than a float holds beyond 1,023 pairs


def binomial_p(k: int, n: int, p: float) -> float:
    """Two-sided exact p value of k successes in n trials against the rate p: twice the smaller tail (Clopper
    and Pearson 1934).

    1 without trials. Raises ValueError unless 0 <= k <= n and 0 < p < 1.
    """
    if not 0 <= k <= n or not 0.0 < p < 1.0:
        raise ValueError(f"want 0 <= k <= n and 0 < p < 1, got k={k}, n={n}, p={p}")
    terms = [math.exp(_log_choose(n, i) + i * math.log(p) + (n - i) * math.log1p(-p)) for i in range(n + 1)]
    return min(1.0, 2.0 * min(math.fsum(terms[: k + 1]), math.fsum(terms[k:])))


def fisher_p(k_a: int, n_a: int, k_b: int, n_b: int) -> float:
    """Two-sided p value of Fisher's exact test (1922) that two rates are one: all tables at most as probable
    as the one at hand.

    1 where either has no trials. Raises ValueError for impossible counts. On paired episodes it errs on the
    safe side.
    """
    if not (0 <= k_a <= n_a and 0 <= k_b <= n_b):
        raise ValueError(f"want 0 <= k <= n, got {k_a}/{n_a} and {k_b}/{n_b}")
    total = k_a + k_b
    logs = {
        i: _log_choose(n_a, i) + _log_choose(n_b, total - i)
        for i in range(max(0, total - n_b), min(n_a, total) + 1)
    }
    whole = _log_choose(n_a + n_b, total)
    limit = logs[k_a] + 1e-9  # rounding must not part tables that are equally probable
    return min(1.0, math.fsum(math.exp(value - whole) for value in logs.values() if value <= limit))


def _log_choose(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)


def holm_adjusted(p_values: Sequence[float]) -> list[float]:
    """p values of several tests, adjusted by Holm (1979): bounds the chance of any false alarm."""
    order = sorted(range(len(p_values)), key=lambda i: p_values[i])
    adjusted, largest = [0.0] * len(p_values), 0.0
    for rank, i in enumerate(order):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[i]))
        adjusted[i] = largest
    return adjusted
