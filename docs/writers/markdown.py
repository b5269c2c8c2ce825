"""Markdown, the MyST kind: tables and lists of pages to write, shell blocks to read."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

FENCE = re.compile(r"^(<!-- (?P<mark>run) -->\n)?```(?P<language>\w*)\n(?P<body>.*?)^```", re.M | re.S)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table; what would break its cells is escaped."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(_cell(cell) for cell in line) + " |" for line in lines)


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", r"\|")


def contents(names: Sequence[str]) -> str:
    """Table of contents of a page that stands above others."""
    return "\n".join(["```{toctree}", ":maxdepth: 1", "", *names, "```"])


def shell_blocks(text: str) -> Iterator[tuple[str | None, list[str]]]:
    """(mark, lines) of every shell block; continued lines are one, as the shell sees them."""
    for fence in FENCE.finditer(text):
        if fence["language"] == "sh":
            body = re.sub(r" *\\\n *", " ", fence["body"])
            yield fence["mark"], [line for line in body.splitlines() if line.strip()]
