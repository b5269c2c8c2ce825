"""Watched episodes in the terminal: how each ended."""

from __future__ import annotations

from typing import Any

from uuvtai.show.screen import Screen
from uuvtai.tables.table import Column, Table

_COLUMNS = (
    Column("method"),
    Column("seed"),
    Column("episode"),
    Column("outcome"),
    Column("time s"),
    Column("min clearance m", 1),
    Column("real-time factor", 2),
)


def show_watched(screen: Screen, watched: list[dict[str, Any]]) -> None:
    """A row per episode of ``uuv watch --json``."""
    rows = [
        [
            entry["method"],
            str(entry["seed"]),
            str(entry["episode"]),
            entry["outcome"],
            f"{entry['time_s']:.1f}",
            f"{entry['min_clearance_m']:.2f}",
            f"{entry['real_time_factor']:.2f}",
        ]
        for entry in watched
    ]
    screen.table(Table(_COLUMNS, rows))
