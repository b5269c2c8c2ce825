"""Trees as text and Graphviz DOT, with what their nodes did in an evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uuvtai import tree_codes as codes
from uuvtai.tree.flat import UNSET, FlatTree
from uuvtai.tree_codes import LEAVES

_SYMBOLS = {
    "Sequence": "->",
    "Fallback": "?",
    "ReactiveSequence": "=>",
    "ReactiveFallback": "??",
    "Inverter": "!",
    "ForceSuccess": "+",
    "ForceFailure": "-",
}


@dataclass(frozen=True)
class NodeUse:
    """What a node did over an evaluation."""

    share: float
    """of the episodes (or envs) that ticked it"""
    ticks: int
    acted: int
    """control steps in which it set the action"""


def node_use(ticks: np.ndarray, acted: np.ndarray, n_node: int) -> list[NodeUse]:
    """Use of every node from counts of shape (n_episode, >= n_node)."""
    if not len(ticks):
        return [NodeUse(0.0, 0, 0)] * n_node
    return [
        NodeUse(float((ticks[:, i] > 0).mean()), int(ticks[:, i].sum()), int(acted[:, i].sum()))
        for i in range(n_node)
    ]


def tree_text(tree: FlatTree) -> str:
    """The tree as indented text, one line per node."""
    return "\n".join(f"{branch}{_label(tree, i)}" for i, branch in enumerate(_branches(tree)))


def _label(tree: FlatTree, node: int) -> str:
    kind = tree.types[node]
    given = zip(LEAVES[kind].ports, tree.param[node], strict=False) if kind in LEAVES else ()
    ports = ", ".join(f"{port}={value:g}" for port, value in given if value != UNSET)
    text = f"{_SYMBOLS.get(kind, '')} {kind}".strip() + (f"({ports})" if ports else "")
    return text if tree.names[node] == kind else f"{tree.names[node]}: {text}"


def _branches(tree: FlatTree) -> list[str]:
    """Line art before every node."""
    arts: list[str] = []
    stems: list[str] = []
    for node, parent in enumerate(tree.parent):
        if parent < 0:
            arts.append("")
            stems.append("")
            continue
        last = tree.end[node] == tree.end[parent]
        arts.append(stems[parent] + ("└─ " if last else "├─ "))
        stems.append(stems[parent] + ("   " if last else "│  "))
    return arts


def tree_dot(tree: FlatTree, use: Sequence[NodeUse] | None = None) -> str:
    """The tree as Graphviz DOT; with ``use`` nodes carry the share of episodes that ticked them."""
    shapes = {codes.CONDITION: "ellipse", codes.ACTION: "box"}
    lines = ["digraph tree {", "  ordering=out; node [fontname=sans];"]
    for node, kind in enumerate(tree.kind):
        share = f"\\n{100 * use[node].share:.1f} %" if use else ""
        label = _label(tree, node).replace("\\", "\\\\").replace('"', '\\"')
        lines.append(f'  n{node} [label="{label}{share}", shape={shapes.get(kind, "plaintext")}];')
        if tree.parent[node] >= 0:
            lines.append(f"  n{tree.parent[node]} -> n{node};")
    return "\n".join([*lines, "}"])
