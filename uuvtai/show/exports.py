"""What was exported, in the terminal: do a policy's engines agree, and how long does each take."""

from __future__ import annotations

from typing import Any

from uuvtai.endings import say
from uuvtai.show.screen import Screen
from uuvtai.tables.table import Column, Table


def _largest(agreement: Any) -> str:
    worst = max(agreement.difference, key=lambda name: agreement.difference[name])
    return f"{agreement.difference[worst]:.1e} ({worst})"


_ENGINES = (
    Column("engine", left=True, of=lambda one: one.engine),
    Column("", left=True, of=lambda one: "agrees" if one.agrees else "DIFFERS"),
    Column("largest difference", 1, of=_largest),
    Column("p50 ms", 2, of=lambda one: f"{one.p50_ms:.3f}"),
    Column("p99 ms", 3, of=lambda one: f"{one.p99_ms:.3f}"),
)


def show_stack(document: dict[str, Any]) -> None:
    """What ``uuv export --stack`` wrote."""
    size = f"{document['bytes'] / 2**20:.1f} MiB"
    machines = " and ".join(document["machines"])
    say(f"wrote {document['folder']} ({size}): {document['kernels']} kernels for {machines}")
    say(f"there: python3 -m uuv_stack decides {document['checked_steps']} steps of the log anew")


def show_export(screen: Screen, found: Any) -> None:
    """One row per engine of a ``deploy.export`` result, where any could run, and what is damaged."""
    for damage in found.damages:
        say(damage)
    if found.agreements:
        screen.table(Table(_ENGINES, found.agreements, str(found.folder)))
