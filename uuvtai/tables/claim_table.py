"""Table of the paper's claims (the document of ``uuv reproduce --json``), each with its verdict."""

from __future__ import annotations

from typing import Any

from uuvtai.tables.table import PAGE, Cell, Column, Table
from uuvtai.tables.wording import probability

_COLOURS = {"holds": "green", "does not hold": "red"}


def _verdict(claim: dict[str, Any]) -> Cell:
    return Cell(claim["verdict"], style=_COLOURS.get(claim["verdict"], "yellow"))


_CLAIMS = (
    Column("claim", prose=True, of=lambda c: c["text"]),
    Column("the paper", prose=True, of=lambda c: c["theirs"]),
    Column("here", prose=True, of=lambda c: c["ours"]),
    Column(
        "verdict", prose=True, of=lambda c: Cell(c["verdict"], style=_COLOURS.get(c["verdict"], "yellow"))
    ),
    Column("p", only=PAGE, of=lambda c: probability(c["p"], ".4f")),
    Column("p (Holm)", only=PAGE, of=lambda c: probability(c["p_holm"], ".4f")),
)


def claim_table(document: dict[str, Any]) -> Table:
    """One row a claim; the terminal draws a rule after each."""
    claims = document["claims"]
    title = f"the paper's claims, budget {document['budget']}"
    return Table(_CLAIMS, claims, title, sections=range(len(claims)))
