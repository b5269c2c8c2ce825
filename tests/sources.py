"""Source as syntax trees, read once in a process: many tests look through the whole package."""

import ast
from functools import cache


@cache
def nodes_of(path):
    """Every node of a file's syntax tree, its root first."""
    return tuple(ast.walk(ast.parse(path.read_text())))
