"""Taichi's front end with a memory: what it works out again for every call of a ``ti.func`` is worked out once.

Taichi inlines: it transforms a func's source anew wherever it is called, thousands of times before the first step of a simulator. Each
time it looks the source up and wraps its lines, and it words a position for error messages for every node of the syntax tree, errors or
not. These are pure functions of the source. Texts stay the same, so Taichi finds kernels that were compiled without this in its cache.
"""

from __future__ import annotations

import functools
import sys
import textwrap
import types
from typing import Any

from taichi.lang import kernel_impl
from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext

_OPENING = ("For", "While", "FunctionDef", "If")
"""nodes whose position is that of their first line"""


def remember_sources() -> None:
    """Give this process's Taichi the memory; once is enough. A Taichi without these names is left as it is."""
    if hasattr(ASTTransformerContext, "get_pos_info") and not hasattr(ASTTransformerContext.get_pos_info, "__wrapped__"):
        ASTTransformerContext.get_pos_info = _remembered(ASTTransformerContext.get_pos_info)
    for name in ("getsourcefile", "getsourcelines"):
        if hasattr(kernel_impl, name) and not hasattr(getattr(kernel_impl, name), "__wrapped__"):
            setattr(kernel_impl, name, functools.cache(getattr(kernel_impl, name)))
    if hasattr(kernel_impl, "_inside_class"):
        kernel_impl._inside_class = _inside_class  # type: ignore[attr-defined]
    if getattr(kernel_impl, "textwrap", None) is textwrap:
        kernel_impl.textwrap = types.SimpleNamespace(fill=functools.cache(textwrap.fill), dedent=textwrap.dedent)  # type: ignore[attr-defined]


def _inside_class(level_of_class_stackframe: int) -> bool:
    """Whether a decorator is at work in the body of a class; ``level_of_class_stackframe`` is the frame that executes the class statement.

    Taichi reads that frame's source and searches all loaded modules for it, for each of our funcs and kernels when it is imported.
    """
    return "__qualname__" in sys._getframe(level_of_class_stackframe - 1).f_locals


def _remembered(get_pos_info: Any) -> Any:
    """``get_pos_info(context, node)`` by everything that its text depends on."""
    known: dict[tuple, str] = {}

    @functools.wraps(get_pos_info)
    def position(context: Any, node: Any) -> str:
        kind = type(node).__name__
        first = node.body[0].lineno if kind in _OPENING else 0
        key = (
            context.file, context.func.func.__name__, context.lineno_offset, context.indent, kind, first,
            node.lineno, node.end_lineno, node.col_offset, node.end_col_offset,
        )  # fmt: skip
        text = known.get(key)
        if text is None:
            text = known[key] = get_pos_info(context, node)
        return text

    return position
