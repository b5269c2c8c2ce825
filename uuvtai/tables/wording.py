"""Figures as tables and pages write them: every rate with its count and its interval, and what is not known
as a dash."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from uuvtai.outcomes import COLLIDED
from uuvtai.tables.table import Cell

_NAMES = {"v_m_s": "v m/s"}
_LOCALIZED = {
    "truth": "position known",
    "dead_reckoning": "dead reckoning",
    "estimated": "position estimated",
}


def rate(k: int | None, n: int, interval: Sequence[float] | None) -> Cell:
    """'490/500 = 98.0 % [96.4, 98.9]', in a terminal '490/500 = 98.0 % [96, 99]'."""
    if k is None or not n:
        return Cell("-")
    share = f"{k}/{n} = {100 * k / n:.1f} %"
    if not interval:
        return Cell(share)
    low, high = (100 * bound for bound in interval)
    return Cell(f"{share} [{low:.1f}, {high:.1f}]", f"{share} [{low:.0f}, {high:.0f}]")


def sensing(result: Mapping[str, Any]) -> str:
    """'harsh sensing, position estimated'; results of old versions do not say how the position was found."""
    where = _LOCALIZED.get(str(result.get("localization")))
    return f"{result['sensors']} sensing" + (f", {where}" if where else "")


def bodies(result: Mapping[str, Any], resting: str = "", moving: str = "") -> str:
    """'S = 11 (3 fixed), D = 6' of a result, or of a world; old versions did not count the fixed ones."""
    told = []
    for name, fixed, kind in (("S", "fixed_static", resting), ("D", "fixed_moving", moving)):
        explicit = f" ({result[fixed]} fixed)" if result.get(fixed) else ""
        told.append(f"{name} = {result[name]}{explicit}{kind}")
    return ", ".join(told)


def vehicle(result: Mapping[str, Any]) -> str:
    """'vehicle bluerov2, ', '' of results of old versions."""
    return f"vehicle {result['vehicle']}, " if result.get("vehicle") else ""


def number(value: float | None, digits: int = 1) -> str:
    """Fixed digits, thousands apart."""
    return "-" if value is None else f"{value:,.{digits}f}"


def percent(share: float | None, digits: int = 1) -> str:
    """A share as per cent."""
    return "-" if share is None else f"{100 * share:.{digits}f} %"


def seconds(value: float | None) -> str:
    """'1.3 s'."""
    return "-" if value is None else f"{value:.1f} s"


def probability(p: float | None, form: str = ".2g") -> str:
    """A p value, of two digits unless ``form`` says otherwise; never a zero that it is not."""
    return "-" if p is None else "< 0.0001" if p < 1e-4 else f"{p:{form}}"


def with_interval(value: float | None, interval: Sequence[float] | None, digits: int = 2) -> str:
    """'-0.15 [-0.28, -0.02]'."""
    bounds = f" [{interval[0]:.{digits}f}, {interval[1]:.{digits}f}]" if interval else ""
    return number(value, digits) + bounds


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
