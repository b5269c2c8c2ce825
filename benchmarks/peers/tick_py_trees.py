"""A flattened behaviour tree rebuilt in py_trees, with leaves that answer what they are told."""

from __future__ import annotations

from collections.abc import Sequence

import py_trees
from py_trees.common import Status

from uuvtai.common import tree_codes as codes
from uuvtai.sim.behavior_tree import FlatTree

_CODE = {
    Status.INVALID: codes.IDLE,
    Status.RUNNING: codes.RUNNING,
    Status.SUCCESS: codes.SUCCESS,
    Status.FAILURE: codes.FAILURE,
}
_STATUS = {code: status for status, code in _CODE.items()}
_DECORATORS = {
    codes.INVERTER: py_trees.decorators.Inverter,
    codes.FORCE_SUCCESS: py_trees.decorators.FailureIsSuccess,
    codes.FORCE_FAILURE: py_trees.decorators.SuccessIsFailure,
}


class _Given(py_trees.behaviour.Behaviour):
    """A leaf that answers what it is told."""

    def __init__(self, node: int, tree: PyTree) -> None:
        super().__init__(str(node))
        self.node, self.tree = node, tree

    def update(self) -> Status:
        return self.tree.answers[self.node]


class PyTree:
    """One env's tree; ``nodes`` in preorder."""

    def __init__(self, flat: FlatTree) -> None:
        self.answers: Sequence[Status] = ()
        self.nodes: list[py_trees.behaviour.Behaviour] = []
        self.root = self._built(flat, 0)

    def _built(self, flat: FlatTree, node: int) -> py_trees.behaviour.Behaviour:
        kind, place = flat.kind[node], len(self.nodes)
        self.nodes.append(None)  # type: ignore[arg-type]
        children = [
            self._built(flat, child)
            for child in range(node + 1, flat.end[node])
            if flat.parent[child] == node
        ]
        if kind >= codes.CONDITION:
            made = _Given(node, self)
        elif kind in (codes.SEQUENCE, codes.REACTIVE_SEQUENCE):
            made = py_trees.composites.Sequence(str(node), memory=kind == codes.SEQUENCE, children=children)
        elif kind in (codes.FALLBACK, codes.REACTIVE_FALLBACK):
            made = py_trees.composites.Selector(str(node), memory=kind == codes.FALLBACK, children=children)
        else:
            made = _DECORATORS[kind](str(node), children[0])
        self.nodes[place] = made
        return made

    @staticmethod
    def prepared(answers: Sequence[int]) -> list[Status]:
        """Leaf answers as py_trees wants them."""
        return [_STATUS[int(code)] for code in answers]

    def tick_prepared(self, answers: list[Status]) -> None:
        """One tick; statuses stay in ``nodes``."""
        self.answers = answers
        self.root.tick_once()

    def tick(self, answers: Sequence[int]) -> list[int]:
        """One tick; the status of every node, coded as in ``tree_codes``."""
        self.tick_prepared(self.prepared(answers))
        return self.statuses()

    def visited(self, answers: Sequence[int]) -> list[int]:
        """One tick; the nodes that it came to, children before parents."""
        self.answers = self.prepared(answers)
        return [int(node.name) for node in self.root.tick()]

    def statuses(self) -> list[int]:
        """Status of every node, coded as in ``tree_codes``."""
        return [_CODE[node.status] for node in self.nodes]
