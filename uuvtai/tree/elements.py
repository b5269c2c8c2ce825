"""Reading XML strictly and safely: no DTD, no entities, no loose text, bounded size and depth; every error
names file and line."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NoReturn
from xml.parsers import expat

from uuvtai.loader import ConfigError

MAX_BYTES = 1 << 20
"""of a tree's file"""
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
        if data.strip() and not _described(stack):
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


def _described(stack: list[Element]) -> bool:
    """Whether the innermost element is part of the editor's palette, which may hold descriptions."""
    return any(element.tag == "TreeNodesModel" for element in stack)
