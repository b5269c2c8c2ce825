"""Behaviour trees: BehaviorTree.CPP format 4 XML in, flat preorder arrays for the kernels out, and trees as text or Graphviz DOT.

A tree is data: every controller (straight, planner, bt, a user's file) runs on the same compiled kernels. Reading is strict and safe: no
DTD, no entities, no includes, no scripts, bounded size and depth; every error names file, line, node and reason.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NoReturn
from xml.parsers import expat

import numpy as np

from uuvtai.kernels import tree_tick as codes
from uuvtai.loader import ConfigError, preset_path
from uuvtai.state import TreeTable

UNSET = -1.0
"""Value of a port that is not given: the leaf takes the number of the config's teacher section."""

MAX_PORTS = 4
_MAX_BYTES = 1 << 20
_MAX_DEPTH = 64


class TreeError(ConfigError):
    """A behaviour tree that cannot be used: file, line, node, reason."""


@dataclass(frozen=True)
class Leaf:
    """What a tree may contain as a leaf."""

    code: int
    kind: int
    ports: tuple[str, ...]
    meaning: str


def _condition(code: int, ports: str, meaning: str) -> Leaf:
    return Leaf(code, codes.CONDITION, tuple(ports.split()), meaning)


def _action(code: int, ports: str, meaning: str) -> Leaf:
    return Leaf(code, codes.ACTION, tuple(ports.split()), meaning)


LEAVES = {
    "EmergencyTtc": _condition(codes.EMERGENCY_TTC, "ttc_s range_m", "sonar: contact sooner than ttc_s, or closing in within range_m"),
    "PredictedConflict": _condition(codes.PREDICTED_CONFLICT, "within_s calm_s", "a forecast body comes too close; holds calm_s longer"),
    "RouteBlocked": _condition(codes.ROUTE_BLOCKED, "clearance_m", "mapped clearance on the way to the look-ahead point is too small"),
    "Stuck": _condition(codes.STUCK, "seconds", "hardly any motion for this long, away from the goal"),
    "HasRoute": _condition(codes.HAS_ROUTE, "", "a route exists"),
    "GoalNear": _condition(codes.GOAL_NEAR, "distance_m", "the goal is closer than distance_m"),
    "SafeHere": _condition(codes.SAFE_HERE, "within_s", "stopping here conflicts with no forecast body within within_s, or at all"),
    "BackOff": _action(codes.BACK_OFF, "speed_m_s", "retreat from the sensed threat"),
    "Evade": _action(codes.EVADE, "", "drive the evasive velocity of least cost"),
    "Hold": _action(codes.HOLD, "", "stay in place, away from mapped obstacles"),
    "Unstick": _action(codes.UNSTICK, "seconds speed_m_s", "creep away from the nearest mapped obstacle"),
    "FollowRoute": _action(codes.FOLLOW_ROUTE, "speed_m_s depth_guard", "pursue the look-ahead point; fails without a route"),
    "DriveStraight": _action(codes.DRIVE_STRAIGHT, "speed_m_s", "drive at the goal, blind"),
}

CONTROLS = {
    "Sequence": codes.SEQUENCE,
    "Fallback": codes.FALLBACK,
    "ReactiveSequence": codes.REACTIVE_SEQUENCE,
    "ReactiveFallback": codes.REACTIVE_FALLBACK,
}
DECORATORS = {"Inverter": codes.INVERTER, "ForceSuccess": codes.FORCE_SUCCESS, "ForceFailure": codes.FORCE_FAILURE}
_SYMBOLS = {
    "Sequence": "->",
    "Fallback": "?",
    "ReactiveSequence": "=>",
    "ReactiveFallback": "??",
    "Inverter": "!",
    "ForceSuccess": "+",
    "ForceFailure": "-",
}
_WRAPPERS = ("Action", "Condition", "Control", "Decorator")


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

    @property
    def depth(self) -> tuple[int, ...]:
        """Distance of each node from the root."""
        found: list[int] = []
        for parent in self.parent:
            found.append(0 if parent < 0 else found[parent] + 1)
        return tuple(found)


@dataclass
class _Element:
    tag: str
    attributes: dict[str, str]
    line: int
    children: list[_Element] = field(default_factory=list)


# ------------------------------------------------------------------------------------------------------------------- reading


def read_tree(name: str, max_node: int = 64) -> FlatTree:
    """Tree of a preset (straight, planner, bt) or of an XML file. Raises TreeError, or ConfigError for an unknown name."""
    path = preset_path("tree", name)
    try:
        text = path.read_bytes()
    except OSError as error:
        raise TreeError(f"{path}: cannot be read: {error.strerror}") from None
    return parse_tree(text, str(path), max_node)


def parse_tree(text: bytes | str, source: str = "tree", max_node: int = 64) -> FlatTree:
    """Flat arrays of BehaviorTree.CPP format 4 XML. Raises TreeError."""
    return _Flattener(_elements(text.encode() if isinstance(text, str) else text, source), source, max_node).flat()


def _elements(text: bytes, source: str) -> _Element:
    """Element tree with line numbers; DTDs and entities are refused."""
    if len(text) > _MAX_BYTES:
        raise TreeError(f"{source}: larger than {_MAX_BYTES} bytes")
    parser = expat.ParserCreate()
    holder = _Element("", {}, 0)
    stack = [holder]

    def begin(tag: str, attributes: dict[str, str]) -> None:
        if len(stack) > _MAX_DEPTH:
            raise TreeError(f"{source}:{parser.CurrentLineNumber}: <{tag}> is nested more than {_MAX_DEPTH} deep")
        element = _Element(tag, attributes, parser.CurrentLineNumber)
        stack[-1].children.append(element)
        stack.append(element)

    def refuse(*_: object) -> NoReturn:
        raise TreeError(f"{source}:{parser.CurrentLineNumber}: DTDs and entities are not allowed in a tree")

    def words(data: str) -> None:
        if data.strip() and not _described(stack):
            raise TreeError(f"{source}:{parser.CurrentLineNumber}: text {data.strip()[:20]!r} inside <{stack[-1].tag}>")

    parser.StartElementHandler = begin
    parser.EndElementHandler = lambda _: stack.pop()
    parser.CharacterDataHandler = words
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
    try:
        parser.Parse(text, True)
    except expat.ExpatError as error:
        raise TreeError(f"{source}:{error.lineno}: not well-formed XML: {expat.errors.messages[error.code]}") from None
    return holder.children[0]


def _described(stack: list[_Element]) -> bool:
    """Whether the innermost element is part of the editor's palette, which may hold descriptions."""
    return any(element.tag == "TreeNodesModel" for element in stack)


class _Flattener:
    """Writes the main tree in preorder, subtrees in place."""

    def __init__(self, root: _Element, source: str, max_node: int) -> None:
        self.source, self.max_node = source, max_node
        self.rows: list[tuple[str, str, int, int, tuple[float, ...]]] = []
        self.end: list[int] = []
        self.parent: list[int] = []
        self._check_root(root)
        self.trees = self._collect(root)
        self.main = root.attributes.get("main_tree_to_execute")
        if self.main is None:
            if len(self.trees) > 1:
                self._fail(root, f"has {len(self.trees)} trees: name one in main_tree_to_execute")
            self.main = next(iter(self.trees))
        if self.main not in self.trees:
            self._fail(root, f"main_tree_to_execute={self.main!r} is no BehaviorTree here{_nearest(self.main, self.trees)}")

    def flat(self) -> FlatTree:
        """Flatten from the main tree on."""
        self._add(self.trees[self.main].children[0], -1, (self.main,))  # type: ignore[index,arg-type]
        names, types, kind, leaf, param = (tuple(column) for column in zip(*self.rows, strict=True))
        return FlatTree(names, types, kind, tuple(self.end), tuple(self.parent), leaf, param, self.source)

    def _check_root(self, root: _Element) -> None:
        if root.tag != "root":
            self._fail(root, 'the outermost element must be <root BTCPP_format="4">')
        if root.attributes.get("BTCPP_format") != "4":
            self._fail(root, f'BTCPP_format must be "4", got {root.attributes.get("BTCPP_format")!r}')

    def _collect(self, root: _Element) -> dict[str, _Element]:
        trees: dict[str, _Element] = {}
        for element in root.children:
            if element.tag == "TreeNodesModel":
                continue
            if element.tag != "BehaviorTree":
                self._fail(element, "only <BehaviorTree> and <TreeNodesModel> may stand inside <root>; files are not included")
            name = element.attributes.get("ID")
            if not name or name in trees:
                self._fail(element, "needs an ID" if not name else f"ID {name!r} is given twice")
            if len(element.children) != 1:
                self._fail(element, f"must hold exactly one node, holds {len(element.children)}")
            trees[name] = element
        if not trees:
            self._fail(root, "holds no <BehaviorTree>")
        return trees

    def _add(self, element: _Element, parent: int, inside: tuple[str, ...]) -> None:
        kind_name, attributes = self._type_of(element)
        if kind_name == "SubTree":
            self._add_subtree(element, attributes, parent, inside)
            return
        here = len(self.rows)
        if here >= self.max_node:
            self._fail(element, f"the tree has more than {self.max_node} nodes (teacher.max_node)")
        self.rows.append(self._row(element, kind_name, attributes))
        self.parent.append(parent)
        self.end.append(0)
        for child in element.children:
            self._add(child, here, inside)
        self.end[here] = len(self.rows)

    def _add_subtree(self, element: _Element, attributes: dict[str, str], parent: int, inside: tuple[str, ...]) -> None:
        name = attributes.pop("ID", "")
        if name not in self.trees:
            self._fail(element, f"no BehaviorTree has the ID {name!r}{_nearest(name, self.trees)}")
        if name in inside:
            self._fail(element, f"tree {name!r} contains itself")
        for port in attributes:
            if port not in ("name", "_autoremap"):
                self._fail(element, f"port {port!r}: ports of subtrees are not supported, give numbers to the leaves")
        self._add(self.trees[name].children[0], parent, (*inside, name))

    def _type_of(self, element: _Element) -> tuple[str, dict[str, str]]:
        """Name of the node's type and its attributes; both compact and explicit (<Action ID="Evade"/>) forms."""
        attributes = dict(element.attributes)
        name = element.tag
        if name in _WRAPPERS:
            name = attributes.pop("ID", "")
        known = [*CONTROLS, *DECORATORS, *LEAVES, "SubTree"]
        if name not in known:
            self._fail(element, f"{name or 'no ID'!s} is no known node{_nearest(name, known)}; leaves are: {', '.join(LEAVES)}")
        if element.tag in _WRAPPERS and name != "SubTree" and element.tag != _wrapper_of(name):
            self._fail(element, f"{name} is no {element.tag} but a {_wrapper_of(name)}")
        return name, attributes

    def _row(self, element: _Element, kind_name: str, attributes: dict[str, str]) -> tuple[str, str, int, int, tuple[float, ...]]:
        label = attributes.pop("name", "") or kind_name
        count = len(element.children)
        if kind_name in LEAVES:
            if count:
                self._fail(element, "is a leaf and cannot have children")
            leaf = LEAVES[kind_name]
            return label, kind_name, leaf.kind, leaf.code, self._ports(element, leaf, attributes)
        if attributes:
            self._fail(element, f"unknown attribute {next(iter(attributes))!r}: it takes only a name (scripts are not supported)")
        if kind_name in CONTROLS and not count:
            self._fail(element, "needs at least one child")
        if kind_name in DECORATORS and count != 1:
            self._fail(element, f"needs exactly one child, has {count}")
        kind = CONTROLS.get(kind_name, DECORATORS.get(kind_name, 0))
        return label, kind_name, kind, -1, (UNSET,) * MAX_PORTS

    def _ports(self, element: _Element, leaf: Leaf, attributes: dict[str, str]) -> tuple[float, ...]:
        values = [UNSET] * MAX_PORTS
        for port, text in attributes.items():
            if port not in leaf.ports:
                known = f"its ports are: {', '.join(leaf.ports)}" if leaf.ports else "it has no ports"
                self._fail(element, f"unknown port {port!r}{_nearest(port, leaf.ports)}; {known}")
            values[leaf.ports.index(port)] = self._number(element, port, text)
        return tuple(values)

    def _number(self, element: _Element, port: str, text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and value >= 0):
            self._fail(element, f"port {port}={text!r} must be a number >= 0 (no blackboard entries)")
        return value

    def _fail(self, element: _Element, why: str) -> NoReturn:
        name = element.attributes.get("name") or element.attributes.get("ID")
        raise TreeError(f"{self.source}:{element.line}: <{element.tag}{f' {name!r}' if name else ''}>: {why}")


def _wrapper_of(name: str) -> str:
    if name in LEAVES:
        return "Condition" if LEAVES[name].kind == codes.CONDITION else "Action"
    return "Control" if name in CONTROLS else "Decorator"


def _nearest(name: str, known: Sequence[str] | dict[str, _Element]) -> str:
    close = difflib.get_close_matches(name, list(known), 1)
    return f" (did you mean {close[0]!r}?)" if close else ""


# ------------------------------------------------------------------------------------------------------------ to the kernels


def load_tree(table: TreeTable, flat: FlatTree) -> None:
    """Copy a flat tree into the simulator's table. Raises TreeError when it does not fit."""
    n, capacity = len(flat.kind), table.kind.shape[0]
    if n > capacity:
        raise TreeError(f"{flat.source}: {n} nodes do not fit the {capacity} that were allocated (teacher.max_node)")
    for array, values in ((table.kind, flat.kind), (table.end, flat.end), (table.parent, flat.parent), (table.leaf, flat.leaf)):
        padded = np.zeros(capacity, np.int32)
        padded[:n] = values
        array.from_numpy(padded)
    param = np.full((capacity, MAX_PORTS), UNSET, np.float32)
    param[:n] = flat.param
    table.param.from_numpy(param)
    table.n_node[None] = n


# ------------------------------------------------------------------------------------------------------------------- showing


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
    return [NodeUse(float((ticks[:, i] > 0).mean()), int(ticks[:, i].sum()), int(acted[:, i].sum())) for i in range(n_node)]


def tree_text(flat: FlatTree, use: Sequence[NodeUse] | None = None) -> str:
    """The tree as indented text; with ``use`` also the share of episodes, ticks and steps acted of every node."""
    lines = [f"{branch}{_label(flat, i)}" for i, branch in enumerate(_branches(flat))]
    if use is None:
        return "\n".join(lines)
    width = max(map(len, lines))
    head = f"{'node':{width}}  {'episodes':>8}  {'ticks':>10}  {'acted':>8}  {'acted %':>7}"
    total = max(1, sum(u.acted for u in use))
    rows = [
        f"{line:{width}}  {100 * u.share:7.1f}%  {u.ticks:10d}  {_acted(flat, i, u, total)}"
        for i, (line, u) in enumerate(zip(lines, use, strict=True))
    ]
    return "\n".join([head, *(row.rstrip() for row in rows)])


def _acted(flat: FlatTree, node: int, use: NodeUse, total: int) -> str:
    return f"{use.acted:8d}  {100 * use.acted / total:6.1f}%" if flat.kind[node] == codes.ACTION else ""


def _label(flat: FlatTree, node: int) -> str:
    kind = flat.types[node]
    given = zip(LEAVES[kind].ports, flat.param[node], strict=False) if kind in LEAVES else ()
    ports = ", ".join(f"{port}={value:g}" for port, value in given if value != UNSET)
    text = f"{_SYMBOLS.get(kind, '')} {kind}".strip() + (f"({ports})" if ports else "")
    return text if flat.names[node] == kind else f"{flat.names[node]}: {text}"


def _branches(flat: FlatTree) -> list[str]:
    """Line art before every node."""
    arts: list[str] = []
    stems: list[str] = []
    for node, parent in enumerate(flat.parent):
        if parent < 0:
            arts.append("")
            stems.append("")
            continue
        last = flat.end[node] == flat.end[parent]
        arts.append(stems[parent] + ("└─ " if last else "├─ "))
        stems.append(stems[parent] + ("   " if last else "│  "))
    return arts


def tree_dot(flat: FlatTree, use: Sequence[NodeUse] | None = None) -> str:
    """The tree as Graphviz DOT; with ``use`` nodes carry the share of episodes that ticked them."""
    shape: Callable[[int], str] = lambda kind: {codes.CONDITION: "ellipse", codes.ACTION: "box"}.get(kind, "plaintext")  # noqa: E731
    lines = ["digraph tree {", "  ordering=out; node [fontname=sans];"]
    for node, kind in enumerate(flat.kind):
        share = f"\\n{100 * use[node].share:.1f} %" if use else ""
        label = _label(flat, node).replace("\\", "\\\\").replace('"', '\\"')
        lines.append(f'  n{node} [label="{label}{share}", shape={shape(kind)}];')
        if flat.parent[node] >= 0:
            lines.append(f"  n{flat.parent[node]} -> n{node};")
    return "\n".join([*lines, "}"])
