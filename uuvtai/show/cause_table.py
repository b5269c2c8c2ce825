"""Why episodes failed, in the terminal: one table per method, and what each cause means."""

from __future__ import annotations

from typing import Any

from rich.text import Text

from uuvtai.endings import plain
from uuvtai.show.screen import Screen
from uuvtai.tables.method_tables import causes_table

_REMARKABLE_SHARE = 0.2
"""Remarks on fewer of a cause's episodes are left to the JSON."""

_LEGEND = (
    "knew: share whose forecast of the killer, made 1 s before the end, was right. Medians before the end: "
    "unseen = since a beam last met the killer, evading = since evasion began, chance = until when some "
    "velocity still escaped. worst: seed:episode of the hardest hit"
)


def show_causes(screen: Screen, result: dict[str, Any]) -> None:
    """Causes of every method of a ``uuv eval --explain --json`` document."""
    for m in result["methods"]:
        if "explain" in m:
            _show_method(screen, m)
    if any(m.get("explain") for m in result["methods"]):
        screen.line(_LEGEND, "dim")


def _show_method(screen: Screen, m: dict[str, Any]) -> None:
    failed = len(m["explain"])
    screen.line("")
    if not failed:
        screen.line(f"{m['name']}: no episode failed, nothing to explain")
        return
    screen.table(causes_table(m, f"{m['name']}: why {failed} of {m['episodes']} episodes failed"))
    for c in m["causes"]:
        remarks = ", ".join(
            f"{k} {remark}" for remark, k in c["remarks"].items() if k >= _REMARKABLE_SHARE * c["count"]
        )
        meaning = Text(plain(c["label"]), style="bold").append(plain(f": {c['meaning']}"), style="not bold")
        screen.line(meaning.append(plain(f" ({remarks})"), style="not bold dim") if remarks else meaning)
