"""The paper's claims in the terminal, each with what was found here and a verdict."""

from __future__ import annotations

from typing import Any

from rich.text import Text

from uuvtai.show.screen import Column, Screen

_CLAIMS = (
    Column("claim", prose=True),
    Column("the paper", prose=True),
    Column("here", prose=True),
    Column("verdict", prose=True),
)
_COLORS = {"holds": "green", "does not hold": "red"}


def show_claims(screen: Screen, result: dict[str, Any]) -> None:
    """Claims of a ``uuv reproduce --json`` document."""
    rows = [
        [
            claim["text"],
            claim["theirs"],
            claim["ours"],
            Text(claim["verdict"], style=_COLORS.get(claim["verdict"], "yellow")),
        ]
        for claim in result["claims"]
    ]
    screen.table(_CLAIMS, rows, f"the paper's claims, budget {result['budget']}", sections=range(len(rows)))
