"""Intervals for rates, and the two time figures. Hand-checked in tests/test_statistics.py."""

from __future__ import annotations

import math

Z95 = 1.959963984540054
"""Two-sided 95 % quantile of the standard normal."""


def wilson_interval(k: int, n: int, z: float = Z95) -> tuple[float, float] | None:
    """Wilson score interval of k successes in n trials (Wilson 1927); None when there are no trials.

    Raises ValueError unless 0 <= k <= n.
    """
    if not 0 <= k <= n:
        raise ValueError(f"k must lie in [0, n], got k={k}, n={n}")
    if n == 0:
        return None
    p = k / n
    scale = 1.0 / (1.0 + z * z / n)
    centre = scale * (p + z * z / (2 * n))
    half = scale * z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    # the bounds are exact at the ends; rounding must not leave 0.9999999 for 10/10
    return (0.0 if k == 0 else max(0.0, centre - half), 1.0 if k == n else min(1.0, centre + half))


def rate(k: int, n: int) -> float | None:
    """k / n, or None without trials."""
    return k / n if n else None


def mean(values: list[float]) -> float | None:
    """Arithmetic mean, or None of nothing."""
    return sum(values) / len(values) if values else None


def time_to_success_s(mean_time_s: float | None, success_rate: float | None) -> float | None:
    """The paper's TTS = AvgTime / SuccessRate [s]; None where it is undefined (no success, no episodes)."""
    if mean_time_s is None or not success_rate:
        return None
    return mean_time_s / success_rate
