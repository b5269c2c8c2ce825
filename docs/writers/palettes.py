"""Groot's palette of the built-in trees, from the table of leaves: ``python -m docs.writers.palettes``."""

from __future__ import annotations

import re
from pathlib import Path

import uuvtai
from uuvtai.common.tree_codes import ACTION, LEAVES

TREES = Path(uuvtai.__file__).parent / "presets" / "trees"
_PALETTE = re.compile(r" *<TreeNodesModel>.*?</TreeNodesModel>\n", re.DOTALL)


def palette() -> str:
    """Every leaf with its kind and ports, as Groot 2 reads them (``TreeNodesModel``)."""
    lines = ["  <TreeNodesModel>"]
    for name, leaf in LEAVES.items():
        kind = "Action" if leaf.kind == ACTION else "Condition"
        ports = [f'      <input_port name="{port}" type="double"/>' for port in leaf.ports]
        lines += (
            [f'    <{kind} ID="{name}">', *ports, f"    </{kind}>"]
            if ports
            else [f'    <{kind} ID="{name}"/>']
        )
    return "\n".join([*lines, "  </TreeNodesModel>\n"])


def with_palette(tree: str) -> str:
    """The text of a tree with the palette of today. Raises ValueError where it has none to replace."""
    if not _PALETTE.search(tree):
        raise ValueError("no <TreeNodesModel> to write anew")
    return _PALETTE.sub(lambda _: palette(), tree)


def main() -> None:
    """Write the palette of every built-in tree anew."""
    for path in sorted(TREES.glob("*.xml")):
        path.write_text(with_palette(path.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
