"""Texts of files without what no figure and no table can show."""

from __future__ import annotations

from typing import Any

_LONGEST = 300
"""characters of a text in a document: names, not novels"""


def shown(text: str) -> str:
    """The text on one line, without control characters."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


def all_shown(document: Any) -> Any:
    """A JSON document with such texts alone, none of them long."""
    if isinstance(document, str):
        return shown(document[:_LONGEST])
    if isinstance(document, dict):
        return {shown(key[:_LONGEST]): all_shown(value) for key, value in document.items()}
    return [all_shown(value) for value in document] if isinstance(document, list) else document
