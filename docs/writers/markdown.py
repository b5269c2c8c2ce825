"""Tables and lists of pages in Markdown, the MyST kind."""

from __future__ import annotations

from collections.abc import Sequence


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table; what would break its cells is escaped."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(_cell(cell) for cell in line) + " |" for line in lines)


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", r"\|")


def contents(names: Sequence[str]) -> str:
    """Table of contents of a page that stands above others."""
    return "\n".join(["```{toctree}", ":maxdepth: 1", "", *names, "```"])
