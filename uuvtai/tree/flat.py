"""A tree as flat preorder arrays, and the way into the kernels' table."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from uuvtai.tree.elements import TreeError
from uuvtai.tree_codes import MAX_PORTS

if TYPE_CHECKING:  # a tree is read and printed without Taichi and torch
    from uuvtai.state import TreeTable
    from uuvtai.taichi_patches.memory import Put

UNSET = -1.0
"""Value of a port that is not given: the leaf takes the number of the config's teacher section."""


@dataclass(frozen=True)
class FlatTree:
    """A tree in preorder; one entry per node everywhere."""

    names: tuple[str, ...]
    """what the author calls the node, else its type"""
    types: tuple[str, ...]
    """Sequence, Evade, ..."""
    kind: tuple[int, ...]
    end: tuple[int, ...]
    parent: tuple[int, ...]
    leaf: tuple[int, ...]
    param: tuple[tuple[float, ...], ...]
    source: str = ""
    """file it was read from"""
    xml: bytes = field(default=b"", compare=False, repr=False)
    """what was read: a run keeps the tree that drove, whatever becomes of the file meanwhile"""

    @property
    def depth(self) -> tuple[int, ...]:
        """Distance of each node from the root."""
        found: list[int] = []
        for parent in self.parent:
            found.append(0 if parent < 0 else found[parent] + 1)
        return tuple(found)


def load_tree(table: TreeTable, tree: FlatTree, put: Put | None = None) -> None:
    """Copy a flat tree into the simulator's table by ``put`` (default: ``put_by_kernel``). Raises TreeError
    when it does not fit."""
    if put is None:
        from uuvtai.taichi_patches.memory import put_by_kernel as put
    n, capacity = len(tree.kind), table.kind.shape[0]
    if n > capacity:
        raise TreeError(
            f"{tree.source}: {n} nodes do not fit the {capacity} that were allocated (teacher.max_node)"
        )
    for array, values in (
        (table.kind, tree.kind),
        (table.end, tree.end),
        (table.parent, tree.parent),
        (table.leaf, tree.leaf),
    ):
        padded = np.zeros(capacity, np.int32)
        padded[:n] = values
        put(array, padded)
    param = np.full((capacity, MAX_PORTS), UNSET, np.float32)
    param[:n] = tree.param
    put(table.param, param)
    put(table.n_node, np.array(n, np.int32))
