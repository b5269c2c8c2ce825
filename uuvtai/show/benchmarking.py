"""A benchmark in the terminal: its scenes, an entry, the check of one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from uuvtai.endings import say
from uuvtai.show.screen import Screen
from uuvtai.tables.benchmark_tables import checks_table, entry_table, scenes_table


def show_scenes(screen: Screen, document: dict[str, Any]) -> None:
    """What there is to enter, and how."""
    screen.table(scenes_table(document))
    screen.line(
        "enter one: uuv benchmark pool --controller mine.py:act; all of them: uuv benchmark all", "dim"
    )
    screen.line("check an entry: uuv benchmark verify entry.json (docs/benchmark.md)", "dim")


def show_entry(screen: Screen, entry: dict[str, Any], file: Path) -> None:
    """Results of an entry, and where its file lies."""
    screen.table(entry_table(entry))
    said = "the entry" if entry["is_entry"] else "no entry (--quick plays episodes that anybody may tune on)"
    say(f"{said}: {file}")


def show_check(screen: Screen, document: dict[str, Any]) -> None:
    """Every check, and the verdict."""
    screen.table(checks_table(document))
    if document["ok"]:
        what = "an entry" if document["is_entry"] else "a quick look, no entry,"
        screen.line(f"agrees: {what} of {document['pilot']} for {document['benchmark']}", "green")
        return
    screen.line(f"does not agree; it was played on: {document['machine']}", "red")
    if any(check["is_told"] and not check["ok"] for check in document["checks"]):
        screen.line(
            "code or scenarios are not the entry's: check it with that version of uuvtai, on a machine of "
            "that kind, before you call it wrong",
            "dim",
        )
