"""What ``uuv doctor`` found, line by line."""

from __future__ import annotations

from typing import Any

from rich.text import Text

from uuvtai.show.screen import Column, Screen

_CHECKS = (Column("", left=True), Column("", left=True), Column("", prose=True))


def show_checks(screen: Screen, found: list[dict[str, Any]]) -> None:
    """One row per check: whether it went well, its name, what was found."""
    rows = [
        [Text("ok", style="green") if c["ok"] else Text("BAD", style="red"), c["name"], c["detail"]]
        for c in found
    ]
    screen.table(_CHECKS, rows)
