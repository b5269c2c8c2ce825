"""Markdown, the MyST kind: lists of pages to write, shell blocks to read."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

FENCE = re.compile(r"^(<!-- (?P<mark>run) -->\n)?```(?P<language>\w*)\n(?P<body>.*?)^```", re.M | re.S)


def contents(names: Sequence[str]) -> str:
    """Table of contents of a page that stands above others."""
    return "\n".join(["```{toctree}", ":maxdepth: 1", "", *names, "```"])


def shell_blocks(text: str) -> Iterator[tuple[str | None, list[str]]]:
    """(mark, lines) of every shell block; continued lines are one, as the shell sees them."""
    for fence in FENCE.finditer(text):
        if fence["language"] == "sh":
            body = re.sub(r" *\\\n *", " ", fence["body"])
            yield fence["mark"], [line for line in body.splitlines() if line.strip()]
