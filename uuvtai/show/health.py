"""What ``uuv doctor`` found and ``uuv warm`` compiled, line by line."""

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

_SHAPES = (
    Column("world", left=True, of=lambda shape: shape["world"]),
    Column("sensors", left=True, of=lambda shape: shape["sensors"]),
    Column("envs", of=lambda shape: f"{shape['num_envs']}"),
    Column("compiled", of=lambda shape: f"{shape['compiled']}"),
    Column("found", 1, of=lambda shape: f"{shape['found']}"),
    Column("time [s]", of=lambda shape: f"{shape['seconds']:.1f}"),
)


def show_checks(screen: Screen, found: list[dict[str, Any]]) -> None:
    """One row per check: whether it went well, its name, what was found."""
    screen.table(Table(_CHECKS, found))


def show_shapes(screen: Screen, found: list[dict[str, Any]]) -> None:
    """One row per size: how many kernels were compiled, how many were there."""
    screen.table(Table(_SHAPES, found))
