"""An exported policy in the terminal: do its engines agree, and how long does each take."""

from __future__ import annotations

from typing import Any

from uuvtai.endings import say
from uuvtai.show.screen import Column, Screen

_ENGINES = (
    Column("engine", left=True),
    Column("", left=True),
    Column("largest difference", 1),
    Column("p50 ms", 2),
    Column("p99 ms", 3),
)


def show_export(screen: Screen, found: Any) -> None:
    """One row per engine of a ``deploy.export`` result, where any could run, and what is damaged."""
    for damage in found.damages:
        say(damage)
    rows = []
    for one in found.agreements:
        worst = max(one.difference, key=lambda name: one.difference[name])
        largest = f"{one.difference[worst]:.1e} ({worst})"
        rows.append(
            [
                one.engine,
                "agrees" if one.agrees else "DIFFERS",
                largest,
                f"{one.p50_ms:.3f}",
                f"{one.p99_ms:.3f}",
            ]
        )
    if rows:
        screen.table(_ENGINES, rows, str(found.folder))
