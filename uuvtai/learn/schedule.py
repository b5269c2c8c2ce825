"""Piecewise-linear schedules over the share of a run."""

from __future__ import annotations

import bisect
from collections.abc import Sequence


def piecewise_linear(points: Sequence[tuple[float, float]], fraction: float) -> float:
    """Value at ``fraction`` of (fraction, value) ``points``: linear in between, constant outside.

    Two points at the same fraction are a jump, and at the jump itself the later value holds. ValueError for
    no points or points out of order.
    """
    places = [place for place, _ in points]
    if not places or places != sorted(places):
        raise ValueError(
            "a schedule needs at least one (fraction, value) point, fractions not falling, got "
            f"{list(points)}"
        )
    after = bisect.bisect_right(places, fraction)
    if after == 0:
        return float(points[0][1])
    if after == len(points):
        return float(points[-1][1])
    (x0, y0), (x1, y1) = points[after - 1], points[after]
    return y0 + (y1 - y0) * (fraction - x0) / (x1 - x0)
