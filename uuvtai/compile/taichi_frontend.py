"""Taichi's front end with a memory: what it works out again for every call of a ``ti.func`` is worked out
once.

Taichi inlines: it transforms a func's source anew wherever it is called, thousands of times before the first
step of a simulator. Each time it looks the source up and wraps its lines, which are pure functions of the
source; and it words a position that quotes the source for every node of the syntax tree, errors or not: a
fifth of a warm start. Here the quotation is made when there is an error, a source is parsed once, and a field
keeps the line that declared it instead of a stack trace. Positions are no part of what Taichi's cache is
asked for, so it finds kernels that were compiled without this.

What works around Taichi 1.7.4 in this room. A Taichi without one of the names in ``taichi_frontend`` is left
as it is there; the other files fail loudly. Try a new version of Taichi with ``tests/compile`` first.

``taichi_frontend`` (replaced in ``taichi.lang`` when ``uuvtai.kernels`` is imported)
    ``ASTTransformerContext.get_pos_info``: words a position, source and all, for every node of every inlined
    func; here only where an error is being raised. Can go when Taichi words positions when it raises.
    ``kernel_impl.getsourcefile``, ``getsourcelines``, ``textwrap``, ``ast.parse``: ask for the same source at
    every call of a func; here once. Can go when Taichi keeps what it has read of a func.
    ``kernel_impl._inside_class``: searches all loaded modules for the source of a frame, for every decorator;
    here the frame is asked, from Taichi's import on (``first_import``). Can go when a decorator learns its
    class in another way.
    ``impl.get_traceback``, ``snode.get_traceback``: a whole stack trace for every field; here one line. Can
    go when a field keeps no more than that.
    ``Kernel.materialize``: counts the kernels made, so that a stopwatch leaves their time out, and keeps
    debuggers and coverage out of Taichi's own code. Can go when Taichi tells how many kernels it has made.

``memory``
    ``Memory`` finds every array in Taichi's one block of memory, by the offsets that SNodes hold, because
    ``to_numpy`` and ``from_numpy`` compile two kernels for each field; a log reads its rows there. Can go
    when fields show their memory.

``runtime``
    ``stale_locks``: a process that is killed leaves its lock, and from then on nobody uses the cache. Can go
    when Taichi's lock dies with its process. ``CACHE_BYTES`` lifts a limit by an option of ``ti.init``.

``launch`` (``docs/performance.md``)
    ``quick_launch`` goes round ``Kernel.__call__``, which looks at every argument and hashes every section at
    every launch: the same objects again go straight to the compiled kernel. Stands on ``compiled_kernels``,
    ``ensure_compiled``, ``compile_kernel`` and ``launch_kernel``. Can go when launching with arguments seen
    before costs a lookup.

``launch`` and ``cache``
    ``as_arguments`` takes the place of ``transform_tree``, ``make_constant_expr`` and ``_infer_entry_dt``
    while a kernel is read: numbers of the config become arguments. Can go when Taichi has arguments that
    Python may reckon with beforehand.

``runtime``
    ``cache_loop_invariant_global_vars`` is off: that pass keeps an element in a register while the kernel
    writes the same one by another index. With it a scenario's flood fill never began.

Elsewhere, by what Taichi publishes: ``kernels.core.stage.loop_end`` (its scheduler keeps short loops on one
core), ``config.base.Section.__getattr__`` (what it asks of every argument), ``state.arrays`` (layouts by
nested ``dense``).
"""

from __future__ import annotations

import ast
import functools
import sys
import textwrap
import types
from typing import Any

from taichi.lang import impl, kernel_impl, snode
from taichi.lang.ast import ast_transformer_utils

from uuvtai.compile.first_import import inside_class


def remember_sources() -> None:
    """Give this process's Taichi the memory; once is enough. A Taichi without these names is left as it
    is."""
    context: Any = getattr(ast_transformer_utils, "ASTTransformerContext", None)
    if hasattr(context, "get_pos_info") and not hasattr(context.get_pos_info, "__wrapped__"):
        context.get_pos_info = _short_unless_raised(context.get_pos_info)
    for name in ("getsourcefile", "getsourcelines"):
        if hasattr(kernel_impl, name) and not hasattr(getattr(kernel_impl, name), "__wrapped__"):
            setattr(kernel_impl, name, functools.cache(getattr(kernel_impl, name)))
    if hasattr(kernel_impl, "_inside_class"):
        kernel_impl._inside_class = inside_class  # type: ignore[attr-defined]
    if getattr(kernel_impl, "textwrap", None) is textwrap:
        kernel_impl.textwrap = types.SimpleNamespace(
            fill=functools.cache(textwrap.fill), dedent=functools.cache(textwrap.dedent)
        )  # type: ignore[attr-defined]
    if getattr(kernel_impl, "ast", None) is ast:
        ours = types.SimpleNamespace(**{**vars(ast), "parse": _parse})
        kernel_impl.ast = ours  # type: ignore[attr-defined]
    for module in (impl, snode):
        if hasattr(module, "get_traceback"):
            module.get_traceback = _caller
    if hasattr(kernel_impl.Kernel, "materialize") and not hasattr(
        kernel_impl.Kernel.materialize, "__wrapped__"
    ):
        kernel_impl.Kernel.materialize = _counted(kernel_impl.Kernel.materialize)


_made = [0]


def kernels_made() -> int:
    """How many kernels were compiled, or found in the cache, since this process began: time in which this
    grows is no working time."""
    return _made[0]


def _counted(materialize: Any) -> Any:
    @functools.wraps(materialize)
    def counted(kernel: Any, *arguments: Any, **named: Any) -> Any:
        before, tracer = len(kernel.compiled_kernels), sys.gettrace()
        # nobody debugs Taichi's front end, or measures its coverage: a third of the time under either
        if tracer is not None:
            sys.settrace(None)
        try:
            result = materialize(kernel, *arguments, **named)
        finally:
            if tracer is not None:
                sys.settrace(tracer)
        _made[0] += len(kernel.compiled_kernels) - before
        return result

    return counted


@functools.cache
def _tree(source: str) -> tuple[ast.Module, list[ast.arg]]:
    tree = ast.parse(source)
    return tree, list(tree.body[0].args.args)  # type: ignore[attr-defined]


def _parse(source: str) -> ast.Module:
    """The tree of a function's source, as good as new: Taichi takes a kernel's parameters out, and what it
    notes at nodes it overwrites."""
    tree, parameters = _tree(source)
    tree.body[0].args.args = list(parameters)  # type: ignore[attr-defined]
    return tree


def _caller(stacklevel: int = 1) -> str:
    """Where a field is declared: the frame that asked Taichi for it; Taichi's ``stacklevel`` has no meaning
    here."""
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith("taichi."):
        frame = frame.f_back
    return f'  File "{frame.f_code.co_filename}", line {frame.f_lineno}, in {frame.f_code.co_name}\n'


def _short_unless_raised(get_pos_info: Any) -> Any:
    """``get_pos_info(context, node)`` that quotes the source only while an exception is being handled, and
    else names file and line."""

    @functools.wraps(get_pos_info)
    def position(context: Any, node: Any) -> str:
        if sys.exc_info()[0] is not None:
            return get_pos_info(context, node)
        return (
            f'File "{context.file}", line {node.lineno + context.lineno_offset}, in '
            f"{context.func.func.__name__}:\n"
        )

    return position
