"""Behaviour trees: BehaviorTree.CPP format 4 XML in, flat preorder arrays for the kernels out, and trees as
text or Graphviz DOT.

A tree is data: every controller (straight, planner, bt, a user's file) runs on the same compiled kernels.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn
from xml.parsers import expat

import numpy as np

from uuvtai.common import tree_codes as codes
from uuvtai.common.files import read_bytes, read_json, refusing
from uuvtai.common.tree_codes import CONTROLS, DECORATORS, LEAVES, MAX_NODES, MAX_PORTS, Leaf
from uuvtai.config.loader import ConfigError, preset_path

if TYPE_CHECKING:
    from uuvtai.compile.memory import Put
    from uuvtai.state import TreeTable


# ------------------------------------------------------------------------------------------------------------
# Reading XML strictly and safely: no DTD, no entities, no loose text, bounded size and depth; every error
# names file and line.


MAX_BYTES = 1 << 20  # of a tree's file
_MAX_DEPTH = 64
_ENCODINGS = (None, "utf-8", "us-ascii", "iso-8859-1", "utf-16")
"""that the parser itself knows; for others it would ask Python, which knows some that are no character
sets"""
_MAX_WORD = 1000
"""characters of a name or an attribute: looking for the nearest known name takes the square of it"""


class TreeError(ConfigError):
    """A behaviour tree that cannot be used: file, line, node, reason."""


@dataclass
class Element:
    tag: str
    attributes: dict[str, str]
    line: int
    children: list[Element] = field(default_factory=list)


def read_elements(text: bytes, source: str) -> Element:
    """Element tree with line numbers; DTDs and entities are refused."""
    if len(text) > MAX_BYTES:
        raise TreeError(f"{source}: larger than {MAX_BYTES} bytes")
    parser = expat.ParserCreate()
    holder = Element("", {}, 0)
    stack = [holder]

    def begin(tag: str, attributes: dict[str, str]) -> None:
        if len(stack) > _MAX_DEPTH:
            raise TreeError(
                f"{source}:{parser.CurrentLineNumber}: <{tag[:40]}> is nested more than {_MAX_DEPTH} deep"
            )
        if any(len(word) > _MAX_WORD for word in (tag, *attributes, *attributes.values())):
            raise TreeError(
                f"{source}:{parser.CurrentLineNumber}: <{tag[:40]}> has a name or attribute longer than "
                f"{_MAX_WORD} characters"
            )
        element = Element(tag, attributes, parser.CurrentLineNumber)
        stack[-1].children.append(element)
        stack.append(element)

    def refuse(*_: object) -> NoReturn:
        raise TreeError(f"{source}:{parser.CurrentLineNumber}: DTDs and entities are not allowed in a tree")

    def declared(_version: str, encoding: str | None, _standalone: int) -> None:
        if (encoding.lower() if encoding else None) not in _ENCODINGS:
            raise TreeError(f"{source}:1: the encoding {encoding!r:.40} is not read; save the tree as UTF-8")

    def words(data: str) -> None:
        described = any(element.tag == "TreeNodesModel" for element in stack)  # the editor's palette
        if data.strip() and not described:
            raise TreeError(
                f"{source}:{parser.CurrentLineNumber}: text {data.strip()[:20]!r} inside <{stack[-1].tag}>"
            )

    parser.XmlDeclHandler = declared
    parser.StartElementHandler = begin
    parser.EndElementHandler = lambda _: stack.pop()
    parser.CharacterDataHandler = words
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
    try:
        parser.Parse(text, True)
    except expat.ExpatError as error:
        raise TreeError(
            f"{source}:{error.lineno}: not well-formed XML: {expat.errors.messages[error.code]}"
        ) from None
    return holder.children[0]


# ------------------------------------------------------------------------------------------------------------
# A tree as flat preorder arrays, and the way into the kernels' table.


UNSET = -1.0  # Value of a port that is not given: the leaf takes its usual number.


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
    """Copy a flat tree into the simulator's table by ``put`` (default: ``put_by_kernel``)."""
    if put is None:
        from uuvtai.compile.memory import put_by_kernel as put
    n, capacity = len(tree.kind), table.kind.shape[0]
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


# ------------------------------------------------------------------------------------------------------------
# From BehaviorTree.CPP format 4 XML to a flat tree: subtrees in place, ports as numbers; every error names
# file, line, node and reason.


_WRAPPERS = ("Action", "Condition", "Control", "Decorator")


def read_tree(name: str) -> FlatTree:
    """Tree of a preset (straight, planner, bt) or of an XML file. Raises TreeError, or ConfigError for an
    unknown name."""
    return read_tree_file(preset_path("tree", name))


def read_tree_file(path: Path, folder: Path | None = None) -> FlatTree:
    """Tree of an XML file, which must lie below ``folder`` if one is given. Raises TreeError."""
    with refusing(TreeError, f"{path}: cannot be read", refused=""):
        text = read_bytes(path, MAX_BYTES, folder)
    return parse_tree(text, str(path))


def parse_tree(text: bytes | str, source: str = "tree") -> FlatTree:
    """Flat arrays of BehaviorTree.CPP format 4 XML. Raises TreeError."""
    xml = text.encode() if isinstance(text, str) else text
    return replace(_Flattener(read_elements(xml, source), source).flat(), xml=xml)


class _Flattener:
    """Writes the main tree in preorder, subtrees in place."""

    def __init__(self, element: Element, source: str) -> None:
        self.source = source
        self.rows: list[tuple[str, str, int, int, tuple[float, ...]]] = []
        self.end: list[int] = []
        self.parent: list[int] = []
        if element.tag != "root":
            self._fail(element, 'the outermost element must be <root BTCPP_format="4">')
        if element.attributes.get("BTCPP_format") != "4":
            self._fail(element, f'BTCPP_format must be "4", got {element.attributes.get("BTCPP_format")!r}')
        self.trees = self._collect(element)
        self.main = element.attributes.get("main_tree_to_execute")
        if self.main is None:
            if len(self.trees) > 1:
                self._fail(element, f"has {len(self.trees)} trees: name one in main_tree_to_execute")
            self.main = next(iter(self.trees))
        if self.main not in self.trees:
            self._fail(
                element,
                f"main_tree_to_execute={self.main!r} is no BehaviorTree "
                f"here{_nearest(self.main, self.trees)}",
            )

    def flat(self) -> FlatTree:
        """Flatten from the main tree on."""
        self._add(self.trees[self.main].children[0], -1, (self.main,))  # type: ignore[index,arg-type]
        names, types, kind, leaf, param = (tuple(column) for column in zip(*self.rows, strict=True))
        return FlatTree(names, types, kind, tuple(self.end), tuple(self.parent), leaf, param, self.source)

    def _collect(self, element: Element) -> dict[str, Element]:
        trees: dict[str, Element] = {}
        for child in element.children:
            if child.tag == "TreeNodesModel":
                continue
            if child.tag != "BehaviorTree":
                self._fail(
                    child,
                    "only <BehaviorTree> and <TreeNodesModel> may stand inside <root>; files are not "
                    "included",
                )
            name = child.attributes.get("ID")
            if not name or name in trees:
                self._fail(child, "needs an ID" if not name else f"ID {name!r} is given twice")
            if len(child.children) != 1:
                self._fail(child, f"must hold exactly one node, holds {len(child.children)}")
            trees[name] = child
        if not trees:
            self._fail(element, "holds no <BehaviorTree>")
        return trees

    def _add(self, element: Element, parent: int, inside: tuple[str, ...]) -> None:
        kind_name, attributes = self._type_of(element)
        if kind_name == "SubTree":
            self._add_subtree(element, attributes, parent, inside)
            return
        here = len(self.rows)
        if here >= MAX_NODES:
            self._fail(element, f"the tree has more than {MAX_NODES} nodes")
        self.rows.append(self._row(element, kind_name, attributes))
        self.parent.append(parent)
        self.end.append(0)
        for child in element.children:
            self._add(child, here, inside)
        self.end[here] = len(self.rows)

    def _add_subtree(
        self, element: Element, attributes: dict[str, str], parent: int, inside: tuple[str, ...]
    ) -> None:
        name = attributes.pop("ID", "")
        if name not in self.trees:
            self._fail(element, f"no BehaviorTree has the ID {name!r}{_nearest(name, self.trees)}")
        if name in inside:
            self._fail(element, f"tree {name!r} contains itself")
        if len(inside) > MAX_NODES:
            self._fail(element, f"subtrees are nested more than {MAX_NODES} deep")
        for port in attributes:
            if port not in ("name", "_autoremap"):
                self._fail(
                    element, f"port {port!r}: ports of subtrees are not supported, give numbers to the leaves"
                )
        self._add(self.trees[name].children[0], parent, (*inside, name))

    def _type_of(self, element: Element) -> tuple[str, dict[str, str]]:
        """Name of the node's type and its attributes; both compact and explicit (<Action ID="Evade"/>)
        forms."""
        attributes = dict(element.attributes)
        name = element.tag
        if name in _WRAPPERS:
            name = attributes.pop("ID", "")
        known = [*CONTROLS, *DECORATORS, *LEAVES, "SubTree"]
        if name not in known:
            self._fail(
                element,
                f"{name or 'no ID'!s} is no known node{_nearest(name, known)}; leaves are: "
                f"{', '.join(LEAVES)}",
            )
        if element.tag in _WRAPPERS and name != "SubTree" and element.tag != _wrapper_of(name):
            self._fail(element, f"{name} is no {element.tag} but a {_wrapper_of(name)}")
        return name, attributes

    def _row(
        self, element: Element, kind_name: str, attributes: dict[str, str]
    ) -> tuple[str, str, int, int, tuple[float, ...]]:
        label = attributes.pop("name", "") or kind_name
        count = len(element.children)
        if kind_name in LEAVES:
            if count:
                self._fail(element, "is a leaf and cannot have children")
            leaf = LEAVES[kind_name]
            return label, kind_name, leaf.kind, leaf.code, self._ports(element, leaf, attributes)
        if attributes:
            self._fail(
                element,
                f"unknown attribute {next(iter(attributes))!r}: it takes only a name (scripts are not "
                "supported)",
            )
        if kind_name in CONTROLS and not count:
            self._fail(element, "needs at least one child")
        if kind_name in DECORATORS and count != 1:
            self._fail(element, f"needs exactly one child, has {count}")
        kind = CONTROLS.get(kind_name, DECORATORS.get(kind_name, 0))
        return label, kind_name, kind, -1, (UNSET,) * MAX_PORTS

    def _ports(self, element: Element, leaf: Leaf, attributes: dict[str, str]) -> tuple[float, ...]:
        values = [UNSET] * MAX_PORTS
        for port, text in attributes.items():
            if port not in leaf.ports:
                known = f"its ports are: {', '.join(leaf.ports)}" if leaf.ports else "it has no ports"
                self._fail(element, f"unknown port {port!r}{_nearest(port, leaf.ports)}; {known}")
            values[leaf.ports.index(port)] = self._number(element, port, text)
        return tuple(values)

    def _number(self, element: Element, port: str, text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and value >= 0):
            self._fail(element, f"port {port}={text!r} must be a number >= 0 (no blackboard entries)")
        return value

    def _fail(self, element: Element, why: str) -> NoReturn:
        name = element.attributes.get("name") or element.attributes.get("ID")
        raise TreeError(f"{self.source}:{element.line}: <{element.tag}{f' {name!r}' if name else ''}>: {why}")


def _wrapper_of(name: str) -> str:
    if name in LEAVES:
        return "Condition" if LEAVES[name].kind == codes.CONDITION else "Action"
    return "Control" if name in CONTROLS else "Decorator"


def _nearest(name: str, known: Sequence[str] | dict[str, Element]) -> str:
    close = difflib.get_close_matches(name, list(known), 1)
    return f" (did you mean {close[0]!r}?)" if close else ""


# ------------------------------------------------------------------------------------------------------------
# Trees as text and Graphviz DOT, with what their nodes did in an evaluation.


_SYMBOLS = {
    "Sequence": "->",
    "Fallback": "?",
    "ReactiveSequence": "=>",
    "ReactiveFallback": "??",
    "Inverter": "!",
    "ForceSuccess": "+",
    "ForceFailure": "-",
}


@dataclass(frozen=True)
class NodeUse:
    """What a node did over an evaluation."""

    share: float
    """of the episodes (or envs) that ticked it"""
    ticks: int
    acted: int
    """control steps in which it set the action"""


def node_use(ticks: np.ndarray, acted: np.ndarray, n_node: int) -> list[NodeUse]:
    """Use of every node from counts of shape (n_episode, >= n_node)."""
    if not len(ticks):
        return [NodeUse(0.0, 0, 0)] * n_node
    return [
        NodeUse(float((ticks[:, i] > 0).mean()), int(ticks[:, i].sum()), int(acted[:, i].sum()))
        for i in range(n_node)
    ]


def tree_text(tree: FlatTree) -> str:
    """The tree as indented text, one line per node."""
    return "\n".join(f"{branch}{_label(tree, i)}" for i, branch in enumerate(_branches(tree)))


def _label(tree: FlatTree, node: int) -> str:
    kind = tree.types[node]
    given = zip(LEAVES[kind].ports, tree.param[node], strict=False) if kind in LEAVES else ()
    ports = ", ".join(f"{port}={value:g}" for port, value in given if value != UNSET)
    text = f"{_SYMBOLS.get(kind, '')} {kind}".strip() + (f"({ports})" if ports else "")
    return text if tree.names[node] == kind else f"{tree.names[node]}: {text}"


def _branches(tree: FlatTree) -> list[str]:
    """Line art before every node."""
    arts: list[str] = []
    stems: list[str] = []
    for node, parent in enumerate(tree.parent):
        if parent < 0:
            arts.append("")
            stems.append("")
            continue
        last = tree.end[node] == tree.end[parent]
        arts.append(stems[parent] + ("└─ " if last else "├─ "))
        stems.append(stems[parent] + ("   " if last else "│  "))
    return arts


def tree_dot(tree: FlatTree, use: Sequence[NodeUse] | None = None) -> str:
    """The tree as Graphviz DOT; with ``use`` nodes carry the share of episodes that ticked them."""
    shapes = {codes.CONDITION: "ellipse", codes.ACTION: "box"}
    lines = ["digraph tree {", "  ordering=out; node [fontname=sans];"]
    for node, kind in enumerate(tree.kind):
        share = f"\\n{100 * use[node].share:.1f} %" if use else ""
        label = _label(tree, node).replace("\\", "\\\\").replace('"', '\\"')
        lines.append(f'  n{node} [label="{label}{share}", shape={shapes.get(kind, "plaintext")}];')
        if tree.parent[node] >= 0:
            lines.append(f"  n{tree.parent[node]} -> n{node};")
    return "\n".join([*lines, "}"])


# ------------------------------------------------------------------------------------------------------------
# ``uuv presets show TREE``: a tree as text, DOT or JSON, with how an evaluation used it.


@dataclass(frozen=True)
class TreeReport:
    """The same tree three ways."""

    text: str
    """one line per node"""
    dot: str
    document: dict[str, Any]
    """nodes in the order of the lines, with their use where a run was given"""
    is_used: bool


def tree_report(name: str, run: Path | None) -> TreeReport:
    """Report of a tree, given by name or path; with a run folder, of the tree of that name there and the use
    of its nodes. Raises ConfigError."""
    use = None
    if run is not None:
        used = _record(run)
        if name not in used:
            raise ConfigError(f"{run}: has no tree {name!r}; there are: {', '.join(used)}")
        tree = read_tree_file(run / "eval" / "trees" / f"{name}.xml", folder=run)
        use = used[name]
        if len(use) != len(tree.names):
            raise ConfigError(
                f"{run}: the tree {name!r} has changed since that evaluation; run it again with 'uuv eval'"
            )
    else:
        tree = read_tree(name)
    return TreeReport(tree_text(tree), tree_dot(tree, use), _document(name, tree, use), use is not None)


def _record(run: Path) -> dict[str, list[NodeUse]]:
    """Use of every node by tree."""
    path = run / "eval" / "tree.json"
    if not run.is_dir():
        raise ConfigError(f"{run}: is no run folder; give one of an evaluation ('uuv eval' prints it)")
    give = "give the run folder of an evaluation ('uuv eval' prints it)"
    with refusing(ConfigError, f"{path}: cannot be read", give, "run the evaluation again with 'uuv eval'"):
        record = read_json(path, folder=run)
    try:
        return {name: [_use(node) for node in nodes] for name, nodes in record["use"].items()}
    except (ValueError, OverflowError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ConfigError(
            f"{path}: is not what 'uuv eval' writes ({error!r}); run the evaluation again with 'uuv eval'"
        ) from None


def _use(node: dict[str, Any]) -> NodeUse:
    share, ticks, acted = node["share"], int(node["ticks"]), int(node["acted"])
    if not (isinstance(share, int | float) and 0.0 <= share <= 1.0 and 0 <= acted <= ticks):
        raise ValueError(
            f"a node ticked in {share!r:.40} of the episodes, {ticks} times, {acted} of which acted"
        )
    return NodeUse(float(share), ticks, acted)


def _document(name: str, tree: FlatTree, use: list[NodeUse] | None) -> dict[str, Any]:
    nodes = []
    for i, label in enumerate(tree.names):
        node: dict[str, Any] = {"id": i, "name": label, "type": tree.types[i], "parent": tree.parent[i]}
        if use is not None:
            node |= vars(use[i])
        nodes.append(node)
    return {"schema": 1, "tree": name, "source": tree.source, "nodes": nodes}
