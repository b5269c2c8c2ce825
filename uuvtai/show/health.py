"""What ``uuv doctor`` found, line by line."""

from __future__ import annotations

from typing import Any

from uuvtai.show.screen import Screen
from uuvtai.tables.table import Cell, Column, Table

_OK, _BAD = Cell("ok", style="green"), Cell("BAD", style="red")
_CHECKS = (
    Column("", left=True, of=lambda check: _OK if check["ok"] else _BAD),
    Column("", left=True, of=lambda check: check["name"]),
    Column("", prose=True, of=lambda check: check["detail"]),
)


def show_checks(screen: Screen, found: list[dict[str, Any]]) -> None:
    """One row per check: whether it went well, its name, what was found."""
    screen.table(Table(_CHECKS, found))
