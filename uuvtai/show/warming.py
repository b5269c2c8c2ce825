"""What ``uuv warm`` compiled, line by line."""

from __future__ import annotations

from typing import Any

from uuvtai.show.screen import Screen
from uuvtai.tables.table import Column, Table

_SHAPES = (
    Column("world", left=True, of=lambda shape: shape["world"]),
    Column("sensors", left=True, of=lambda shape: shape["sensors"]),
    Column("envs", of=lambda shape: f"{shape['num_envs']}"),
    Column("compiled", of=lambda shape: f"{shape['compiled']}"),
    Column("found", 1, of=lambda shape: f"{shape['found']}"),
    Column("time [s]", of=lambda shape: f"{shape['seconds']:.1f}"),
)


def show_shapes(screen: Screen, found: list[dict[str, Any]]) -> None:
    """One row per size: how many kernels were compiled, how many were there."""
    screen.table(Table(_SHAPES, found))
