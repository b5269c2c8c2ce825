"""Behaviour trees: BehaviorTree.CPP format 4 XML in, flat preorder arrays for the kernels out, and trees as
text or Graphviz DOT.

A tree is data: every controller (straight, planner, bt, a user's file) runs on the same compiled kernels.
"""

from __future__ import annotations

from uuvtai.tree.elements import TreeError
from uuvtai.tree.flat import FlatTree, load_tree
from uuvtai.tree.flatten import parse_tree, read_tree, read_tree_file
from uuvtai.tree.show import NodeUse, node_use, tree_dot, tree_text
from uuvtai.tree_codes import CONTROLS, DECORATORS, LEAVES, Leaf

__all__ = [
    "CONTROLS",
    "DECORATORS",
    "LEAVES",
    "FlatTree",
    "Leaf",
    "NodeUse",
    "TreeError",
    "load_tree",
    "node_use",
    "parse_tree",
    "read_tree",
    "read_tree_file",
    "tree_dot",
    "tree_text",
]
