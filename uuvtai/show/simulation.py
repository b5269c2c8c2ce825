"""Open-loop physics in the terminal: a dozen moments of ``uuv simulate``."""

from __future__ import annotations

from typing import Any

from uuvtai.show.screen import Screen
from uuvtai.tables.table import Column, Table

_ROWS = 12
_STATE = (
    Column("t s"),
    Column("x m"),
    Column("y m"),
    Column("z m"),
    Column("roll deg", 3),
    Column("pitch deg", 3),
    Column("yaw deg", 1),
    Column("u m/s", 1),
    Column("v m/s", 2),
    Column("w m/s", 2),
    Column("p rad/s", 4),
    Column("q rad/s", 4),
    Column("r rad/s", 4),
)


def show_simulation(screen: Screen, result: dict[str, Any], title: str, driven: str | None = None) -> None:
    """Position, attitude and body velocities of a ``uuv simulate --json`` document at moments evenly spread;
    ``driven``: who drove to its goal."""
    if driven is not None:
        goal = ", ".join(f"{value:.2f}" for value in result["goal"])
        title = f"{title}, {driven.removeprefix('controller:')} drives to ({goal})"
    rows = []
    for i in _picked(len(result["t"]), _ROWS):
        values = [result["t"][i], *result["position"][i], *result["rpy_deg"][i], *result["nu"][i]]
        rows.append([f"{value:.3f}" for value in values])
    screen.table(Table(_STATE, rows, title))


def _picked(n: int, wanted: int) -> list[int]:
    return sorted({round(i * (n - 1) / max(1, wanted - 1)) for i in range(wanted)}) if n else []
