"""Figures as the terminal writes them: short, every rate with its count and its interval, and what is not
known as a dash."""

from __future__ import annotations

from collections.abc import Sequence


def rate(k: int, n: int, interval: Sequence[float] | None) -> str:
    """'490/500 = 98.0 % [96, 99]'."""
    bounds = f" [{100 * interval[0]:.0f}, {100 * interval[1]:.0f}]" if interval else ""
    return f"{k}/{n} = {100 * k / n:.1f} %{bounds}" if n else "-"


def number(value: float | None, digits: int = 1) -> str:
    """Fixed digits."""
    return "-" if value is None else f"{value:.{digits}f}"


def percent(share: float | None) -> str:
    """A share as whole per cent."""
    return "-" if share is None else f"{100 * share:.0f} %"


def seconds(value: float | None) -> str:
    """'1.3 s'."""
    return "-" if value is None else f"{value:.1f} s"


def probability(p: float | None) -> str:
    """A p value: two digits, and never a zero that it is not."""
    if p is None:
        return "-"
    return "< 0.0001" if p < 1e-4 else f"{p:.2g}"


def with_interval(value: float | None, interval: Sequence[float] | None, digits: int = 2) -> str:
    """'-0.15 [-0.28, -0.02]'."""
    if value is None:
        return "-"
    return f"{value:.{digits}f}" + (
        f" [{interval[0]:.{digits}f}, {interval[1]:.{digits}f}]" if interval else ""
    )
