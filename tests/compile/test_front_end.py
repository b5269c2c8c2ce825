"""Taichi's front end with a memory says and compiles what it does without one."""

import ast
import inspect
import subprocess
import sys
import textwrap

import numpy as np
import pytest
import taichi as ti
from taichi.lang import kernel_impl
from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext

from uuvtai.compile import taichi_frontend
from uuvtai.compile.taichi_frontend import remember_sources


@ti.func
def halved(x):
    if x > 0.0:
        x = 0.5 * x
    for _ in range(2):
        x += (
            1.0
            - 1.0
        )  # fmt: skip
    return x


@ti.kernel
def wrong() -> ti.f32:
    return halved(unknown_name)  # noqa: F821


def context_of(decorated):
    """What Taichi makes before it transforms a func."""
    return kernel_impl._get_tree_and_ctx(decorated.func, is_kernel=False, args=())


def test_a_position_is_short_until_there_is_an_error_and_then_reads_as_taichi_words_it():
    remember_sources()
    plain = ASTTransformerContext.get_pos_info.__wrapped__
    tree, context = context_of(halved)
    nodes = [node for node in ast.walk(tree) if isinstance(node, (ast.stmt, ast.expr))]
    assert len(nodes) > 20
    for node in nodes:
        whole, short = plain(context, node), context.get_pos_info(node)
        assert whole.startswith(short) and short.count("\n") == 1 and whole.count("\n") > 1
        try:
            raise ValueError
        except ValueError:
            assert context.get_pos_info(node) == whole


def test_a_source_is_looked_up_once(monkeypatch):
    remember_sources()
    expected = [
        textwrap.fill(line, tabsize=4, width=9999) for line in inspect.getsourcelines(halved.func.func)[0]
    ]
    assert context_of(halved)[1].src == expected
    monkeypatch.setattr(inspect, "getsourcelines", lambda _: pytest.fail("looked up again"))
    assert context_of(halved)[1].src == expected


@ti.kernel
def load(field: ti.template(), values: ti.types.ndarray()):  # type: ignore[valid-type]
    for i in field:
        field[i] = values[i]


def test_a_source_is_parsed_once_and_serves_kernels_of_other_arguments(monkeypatch):
    remember_sources()
    short, long = ti.field(ti.f32, 2), ti.field(ti.i32, 3)
    load(short, np.array([1.0, 2.0], np.float32))
    monkeypatch.setattr(ast, "parse", lambda *_: pytest.fail("parsed again"))
    # Taichi takes the parameters out of a kernel's tree when it compiles
    load(long, np.array([3, 4, 5], np.int32))
    monkeypatch.undo()
    assert short.to_numpy().tolist() == [1.0, 2.0] and long.to_numpy().tolist() == [3, 4, 5]


def test_a_field_tells_where_it_was_declared():
    remember_sources()
    place = ti.field(ti.f32, 1).vars[0].declaration_tb
    assert place.count("\n") == 1
    assert "test_front_end.py" in place and "test_a_field_tells" in place


def test_an_error_still_names_its_line():
    with pytest.raises(
        ti.TaichiCompilationError,
        match=r'(?s)test_front_end\.py", line \d+, in wrong:.*halved\(unknown_name\).*\^.*unknown_name',
    ):
        wrong()


def test_kernels_in_classes_are_still_told_apart():
    @ti.data_oriented
    class Body:
        @ti.func
        def inside(self):
            return 1

        assert taichi_frontend.inside_class(2) is True  # 0: itself, 1: the class's body, 2: the test

    assert Body.inside.func.classfunc is True
    assert halved.func.classfunc is False
    assert kernel_impl._inside_class is taichi_frontend.inside_class


def test_a_taichi_without_these_names_is_left_alone():
    program = (
        "from taichi.lang import kernel_impl as k\n"
        "from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext as C\n"
        "from taichi.lang import impl, snode\n"
        "del C.get_pos_info, k.getsourcefile, k.getsourcelines, k._inside_class, k.textwrap, k.ast\n"
        "del impl.get_traceback, snode.get_traceback\n"
        "from uuvtai.compile.taichi_frontend import remember_sources\n"
        "remember_sources()\n"
        "assert not any(hasattr(k, n) for n in ('getsourcefile', 'getsourcelines', '_inside_class', "
        "'textwrap', 'ast'))"
        "\nassert not any(hasattr(m, 'get_traceback') for m in (impl, snode))"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def test_a_tracer_does_not_see_the_front_end_and_goes_on_afterwards():
    """Coverage and debuggers follow every line of Python; Taichi's run to millions."""

    @ti.kernel
    def doubled(x: ti.i32) -> ti.i32:
        return 2 * x

    seen = []

    def trace(frame, _event, _argument):
        seen.append(frame.f_code.co_filename)

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        found = doubled(4)
        assert sys.gettrace() is trace
        inspect.unwrap(doubled)
    finally:
        sys.settrace(before)
    assert found == 8
    assert any(name.endswith("inspect.py") for name in seen), "it goes on"
    assert not [name for name in seen if "taichi/lang/ast/" in name]
