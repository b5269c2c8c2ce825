"""Numbers as the report writes them: every rate with its count and its interval, and what is not known as a
dash."""

from __future__ import annotations

from collections.abc import Sequence

from uuvtai.outcomes import COLLIDED

_NAMES = {"v_m_s": "v m/s"}


def rate(k: int | None, n: int, interval: Sequence[float] | None) -> str:
    """'490/500 = 98.0 % [96.4, 98.9]'."""
    if k is None or not n:
        return "-"
    bounds = f" [{100 * interval[0]:.1f}, {100 * interval[1]:.1f}]" if interval else ""
    return f"{k}/{n} = {100 * k / n:.1f} %{bounds}"


def number(value: float | None, digits: int = 1) -> str:
    """Fixed digits, thousands apart."""
    return "-" if value is None else f"{value:,.{digits}f}"


def percent(share: float | None, digits: int = 1) -> str:
    """A share as per cent."""
    return "-" if share is None else f"{100 * share:.{digits}f} %"


def value_name(value: object) -> str:
    """A value of an axis as a tick says it: 0.6, 4, nominal."""
    return f"{value:g}" if isinstance(value, int | float) and not isinstance(value, bool) else str(value)


def axis_name(key: str) -> str:
    """An axis as a person reads it."""
    return _NAMES.get(key, key)


def accidents(outcomes: dict[str, int]) -> int:
    """Contacts, TTC stops and episodes out of the tank."""
    return sum(outcomes.get(name, 0) for name in COLLIDED)


def megabytes(n_bytes: int) -> str:
    """'23.6 MB'."""
    return f"{n_bytes / 1e6:.1f} MB"
