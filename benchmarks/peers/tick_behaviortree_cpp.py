"""A flattened behaviour tree rebuilt in BehaviorTree.CPP, by the binding behaviortreepy, which reads no other
status than the root's."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from behaviortreepy import BehaviorTreeFactory, NodeStatus

from uuvtai.common import tree_codes as codes
from uuvtai.sim.behavior_tree import FlatTree

_FIXED = {
    codes.RUNNING: "<KeepRunningUntilFailure><AlwaysSuccess/></KeepRunningUntilFailure>",
    codes.SUCCESS: "<AlwaysSuccess/>",
    codes.FAILURE: "<AlwaysFailure/>",
}


class CppTree:
    """One env's tree, with leaves that are Python functions and answer what they are told."""

    def __init__(self, flat: FlatTree) -> None:
        self.answers: list[NodeStatus] = []
        self.came_to: list[int] = []
        factory = BehaviorTreeFactory()
        for node, kind in enumerate(flat.kind):
            if kind >= codes.CONDITION:
                factory.register_simple_condition(f"Given{node}", lambda _self, node=node: self.answers[node])
                factory.register_simple_condition(f"Noted{node}", lambda _self, node=node: self._noted(node))
        self.root, self.noting = (
            factory.create_tree_from_text(_xml(flat, lambda node, name=name: f"<{name}{node}/>"))
            for name in ("Given", "Noted")
        )

    def _noted(self, node: int) -> NodeStatus:
        self.came_to.append(node)
        return self.answers[node]

    @staticmethod
    def prepared(answers: Sequence[int]) -> list[NodeStatus]:
        """Leaf answers as BehaviorTree.CPP wants them."""
        return [NodeStatus(int(code)) for code in answers]

    def tick_prepared(self, answers: list[NodeStatus]) -> None:
        """One tick."""
        self.answers = answers
        self.root.tick_exactly_once()

    def tick(self, answers: Sequence[int]) -> tuple[int, list[int]]:
        """One tick of the tree that notes: the root's status, coded as in ``tree_codes``, and the leaves that
        it came to, in order."""
        self.answers, self.came_to = self.prepared(answers), []
        return int(self.noting.tick_exactly_once().value), self.came_to


def fixed_tree(flat: FlatTree, answers: Sequence[int]) -> Callable[[], NodeStatus]:
    """The tick of a tree whose leaves always answer the same, in C++: what the engine itself takes."""
    text = _xml(flat, lambda node: _FIXED[int(answers[node])])
    return BehaviorTreeFactory().create_tree_from_text(text).tick_exactly_once


def _xml(flat: FlatTree, leaf: Callable[[int], str]) -> str:
    def built(node: int) -> str:
        if flat.kind[node] >= codes.CONDITION:
            return leaf(node)
        inner = "".join(map(built, (n for n, parent in enumerate(flat.parent) if parent == node)))
        return f"<{flat.types[node]}>{inner}</{flat.types[node]}>"

    return f'<root BTCPP_format="4"><BehaviorTree ID="bt">{built(0)}</BehaviorTree></root>'
