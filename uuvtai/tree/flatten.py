"""From BehaviorTree.CPP format 4 XML to a flat tree: subtrees in place, ports as numbers; every error names
file, line, node and reason."""

from __future__ import annotations

import difflib
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

from uuvtai import tree_codes as codes
from uuvtai.files import FileError, read_bytes
from uuvtai.loader import preset_path
from uuvtai.tree.elements import MAX_BYTES, Element, TreeError, read_elements
from uuvtai.tree.flat import UNSET, FlatTree
from uuvtai.tree_codes import CONTROLS, DECORATORS, LEAVES, MAX_PORTS, Leaf

_WRAPPERS = ("Action", "Condition", "Control", "Decorator")


def read_tree(name: str, max_node: int = 64) -> FlatTree:
    """Tree of a preset (straight, planner, bt) or of an XML file. Raises TreeError, or ConfigError for an
    unknown name."""
    return read_tree_file(preset_path("tree", name), max_node)


def read_tree_file(path: Path, max_node: int = 64, folder: Path | None = None) -> FlatTree:
    """Tree of an XML file, which must lie below ``folder`` if one is given. Raises TreeError."""
    try:
        text = read_bytes(path, MAX_BYTES, folder)
    except FileError as error:
        raise TreeError(str(error)) from None
    except OSError as error:
        raise TreeError(f"{path}: cannot be read: {error.strerror}") from None
    return parse_tree(text, str(path), max_node)


def parse_tree(text: bytes | str, source: str = "tree", max_node: int = 64) -> FlatTree:
    """Flat arrays of BehaviorTree.CPP format 4 XML. Raises TreeError."""
    xml = text.encode() if isinstance(text, str) else text
    return replace(_Flattener(read_elements(xml, source), source, max_node).flat(), xml=xml)


class _Flattener:
    """Writes the main tree in preorder, subtrees in place."""

    def __init__(self, element: Element, source: str, max_node: int) -> None:
        self.source, self.max_node = source, max_node
        self.rows: list[tuple[str, str, int, int, tuple[float, ...]]] = []
        self.end: list[int] = []
        self.parent: list[int] = []
        self._check_root(element)
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

    def _check_root(self, element: Element) -> None:
        if element.tag != "root":
            self._fail(element, 'the outermost element must be <root BTCPP_format="4">')
        if element.attributes.get("BTCPP_format") != "4":
            self._fail(element, f'BTCPP_format must be "4", got {element.attributes.get("BTCPP_format")!r}')

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
        if here >= self.max_node:
            self._fail(element, f"the tree has more than {self.max_node} nodes (teacher.max_node)")
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
        if len(inside) > self.max_node:
            self._fail(element, f"subtrees are nested more than {self.max_node} deep")
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
