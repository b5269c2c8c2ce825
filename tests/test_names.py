"""One name for one thing: parameters, classes, files; and no module that imports itself by a detour."""

import ast
import re
from collections import Counter, defaultdict
from functools import cache
from pathlib import Path

import pytest

from tests.sources import nodes_of

PACKAGE = Path(__file__).parent.parent / "uuvtai"
PATHS = sorted(PACKAGE.rglob("*.py"))
DECKS = ("config", "state", "bundles")
"""what every room has: a file of the room's name in each of the first two, the last in its folder of
kernels"""


def module_of(path):
    return ".".join(("uuvtai", *path.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(".__init__")


@cache
def nodes():
    """Module -> nodes of its syntax tree. Not made at import: every process of the gate imports every
    file."""
    return {module_of(path): nodes_of(path) for path in PATHS}


@cache
def classes():
    """Name -> modules that define such a class."""
    found = defaultdict(list)
    for module, inside in nodes().items():
        for node in inside:
            if isinstance(node, ast.ClassDef):
                found[node.name].append(module)
    return found


def ours_in(module):
    """Names that stand for classes of the package in a module."""
    inside = nodes()[module]
    imported = {
        alias.asname or alias.name
        for node in inside
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("uuvtai")
        for alias in node.names
    }
    return (imported | {node.name for node in inside if isinstance(node, ast.ClassDef)}) & set(classes())


def kind_of(annotation):
    """'RouteState' of RouteState, In[RouteState], state.RouteState, RouteState | None."""
    match = re.fullmatch(
        r"(?:(?:In|Out|Const|Bundle)\[)?(?:\w+\.)?(\w+)\]?(?: \| None)?", ast.unparse(annotation).strip("'\"")
    )
    return match.group(1) if match else ""


def names_of_types(modules):
    """Type -> names of the parameters that alone in their function have it -> where."""
    found = defaultdict(lambda: defaultdict(list))
    for module in modules:
        ours = ours_in(module)
        for node in nodes()[module]:
            if isinstance(node, ast.FunctionDef):
                given = [
                    (kind_of(a.annotation), a.arg)
                    for a in node.args.args + node.args.kwonlyargs
                    if a.annotation is not None
                ]
                count = Counter(kind for kind, _ in given)
                for kind, name in given:
                    if kind in ours and count[kind] == 1:
                        found[kind][name].append(f"{module}.{node.name}")
    return found


def test_a_type_has_one_name_as_a_parameter():
    found = names_of_types(nodes())
    assert len(found) > 100
    assert not {
        kind: {name: where[:3] for name, where in names.items()}
        for kind, names in found.items()
        if len(names) > 1
    }


def test_a_second_name_would_be_found(monkeypatch):
    source = (
        "from uuvtai.run_folder import RunFolder\ndef one(folder: RunFolder): ...\ndef two(held: "
        "'RunFolder | None'): ..."
    )
    monkeypatch.setitem(nodes(), "made.up", tuple(ast.walk(ast.parse(source))))
    assert set(names_of_types(["made.up"])["RunFolder"]) == {"folder", "held"}


def test_no_two_classes_have_one_name():
    assert not {name: modules for name, modules in classes().items() if len(modules) > 1}


def test_no_two_files_have_one_name():
    found = defaultdict(list)
    for path in PATHS:
        if path.stem not in ("__init__", "__main__", "bundles") and path.parent.name not in DECKS:
            found[path.stem].append(str(path.relative_to(PACKAGE)))
    assert len(found) > 150
    assert not {name: paths for name, paths in found.items() if len(paths) > 1}
    decks = {path.stem for deck in ("config", "state") for path in (PACKAGE / deck).glob("*.py")} & set(found)
    assert not decks, f"named like a room: {decks}"


def imports():
    """Module -> modules of ours that it imports, inside functions too."""
    found = {}
    for module, inside in nodes().items():
        named = set()
        for node in inside:
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("uuvtai"):
                named |= {
                    f"{node.module}.{a.name}" if f"{node.module}.{a.name}" in nodes() else node.module
                    for a in node.names
                }
            elif isinstance(node, ast.Import):
                named |= {a.name for a in node.names if a.name.startswith("uuvtai")}
        found[module] = named - {module}
    return found


def circle_in(graph):
    """Modules along one circle of a graph, or nothing."""
    left = {node: {other for other in others if other in graph} for node, others in graph.items()}
    while free := [node for node, others in left.items() if not others & left.keys()]:
        for node in free:
            del left[node]
    return sorted(left)


def test_no_module_imports_itself_by_a_detour():
    graph = imports()
    assert sum(map(len, graph.values())) > 900
    assert not circle_in(graph)


@pytest.mark.parametrize(
    "graph", [{"a": {"b"}, "b": {"a"}}, {"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}]
)
def test_a_circle_would_be_found(graph):
    assert {"a", "b"} <= set(circle_in(graph))


@cache
def defined_in(module):
    """Names that a module's own text defines, wherever in it."""
    found = set()
    for node in nodes()[module]:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.ImportFrom | ast.Import):
            found |= {alias.asname or alias.name for alias in node.names}
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            found.add(node.id)
    return found


def test_what_is_imported_is_there():
    """Also inside functions and under conditions, which no other test may come by."""
    missing = [
        f"{module} imports {node.module}.{alias.name}"
        for module, inside in nodes().items()
        for node in inside
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("uuvtai")
        for alias in node.names
        if f"{node.module}.{alias.name}" not in nodes() and alias.name not in defined_in(node.module)
    ]
    assert not missing


def test_every_place_of_the_walk_through_the_house_is_there():
    text = (PACKAGE.parent / "CONTRIBUTING.md").read_text()
    walk = text[text.index("## A walk through the house") : text.index("## What a new thing touches")]
    places = re.findall(r"`([\w/]+)\.py(?::(\w+))?`", walk)
    assert len(places) > 30
    for path, function in places:
        inside = nodes()[f"uuvtai.{path.replace('/', '.')}"]
        names = {node.name for node in inside if isinstance(node, ast.FunctionDef)}
        assert not function or function in names, f"{path}.py has no {function}"
