"""A behaviour tree in the terminal, with what its nodes did in an evaluation."""

from __future__ import annotations

from typing import Any

from uuvtai.show.screen import Screen
from uuvtai.tables.table import Column, Table
from uuvtai.tree_codes import ACTION, LEAVES

_NODES = (
    Column("node", left=True),
    Column("episodes"),
    Column("ticks", 3),
    Column("acted", 2),
    Column("acted %", 1),
)
_LEGEND = "episodes: share that ticked the node; acted: control steps whose action the leaf set"


def show_tree(screen: Screen, text: str, nodes: list[dict[str, Any]]) -> None:
    """One row per line of ``text``, for ``nodes`` of a ``uuv tree RUN --json`` document. Actions alone can
    act."""
    total = max(1, sum(node["acted"] for node in nodes))
    rows = []
    for line, node in zip(text.split("\n"), nodes, strict=True):
        leaf = LEAVES.get(node["type"])
        is_action = leaf is not None and leaf.kind == ACTION
        acted = [str(node["acted"]), f"{100 * node['acted'] / total:.1f} %"] if is_action else ["", ""]
        rows.append([line, f"{100 * node['share']:.1f} %", str(node["ticks"]), *acted])
    screen.table(Table(_NODES, rows))
    screen.line(_LEGEND, "dim")
