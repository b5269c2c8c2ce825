"""Texts of files without what no figure and no table can show."""

from __future__ import annotations

from typing import Any


def shown(text: str) -> str:
    """The text on one line, without control characters."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


def all_shown(document: Any) -> Any:
    """A JSON document with such texts alone."""
    if isinstance(document, str):
        return shown(document)
    if isinstance(document, dict):
        return {shown(key): all_shown(value) for key, value in document.items()}
    return [all_shown(value) for value in document] if isinstance(document, list) else document
