"""Table of the paper's claims (the document of ``uuv reproduce --json``), each with its verdict."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from uuvtai.config.loader import ConfigError
from uuvtai.report.blocks import Block, Heading, Notice, PageSection, Paragraph, Verdict, Verdicts
from uuvtai.report.tables import PAGE, Cell, Column, Data, Table, heads, probability, value_name

_COLOURS = {"holds": "green", "does not hold": "red"}


def _verdict(claim: dict[str, Any]) -> Cell:
    why = f": {claim['reason']}" if claim["reason"] else ""
    return Cell(claim["verdict"] + why, style=_COLOURS.get(claim["verdict"], "yellow"))


_CLAIMS = (
    Column("claim", prose=True, of=lambda c: c["text"]),
    Column("the paper", prose=True, of=lambda c: c["theirs"]),
    Column("here", prose=True, of=lambda c: c["ours"]),
    Column("verdict", prose=True, of=_verdict),
    Column("p", only=PAGE, of=lambda c: probability(c["p"], ".4f")),
    Column("p (Holm)", only=PAGE, of=lambda c: probability(c["p_holm"], ".4f")),
)


def claim_table(document: dict[str, Any]) -> Table:
    """One row a claim; the terminal draws a rule after each."""
    claims = document["claims"]
    title = f"the paper's claims, budget {document['budget']}"
    return Table(_CLAIMS, claims, title, sections=range(len(claims)))


# ---- Blocks of ``reproduce.json``: sections of prose, tables, verdicts and the runs that they rest on.
#
# ``{"schema": 1, "title": "..", "sections": [{"title": "..", "blocks": [BLOCK, ..]}]}``, a BLOCK being one of
# - ``{"kind": "prose" | "heading" | "notice", "text": ".."}``
# - ``{"kind": "table", "columns": [..], "rows": [[..], ..], "caption": "..", "n_left": 1}``
# - ``{"kind": "verdicts", "items": [{"claim": "..", "verdict": one of RULINGS, "numbers": ".."}]}``
# - ``{"kind": "run", "path": ".."}``: all that a run folder inside this one has to show
# - ``{"kind": "curves", "paths": ["..", ..]}``: curves of trainings inside this one, seeds as one band

RULINGS = ("holds", "does not hold", "cannot be judged")

_MAX_BLOCKS = 1000

Described = dict[str, Any]
OfRun = Callable[[Path], list[Block]]
OfCurves = Callable[[list[Path]], list[Block]]


def reproduction(document: Described, folder: Path, of_run: OfRun, of_curves: OfCurves) -> list[PageSection]:
    """Sections of a reproduction; ``of_run``, ``of_curves``: blocks of run folders. Raises ConfigError."""
    if sum(len(section["blocks"]) for section in document["sections"]) > _MAX_BLOCKS:
        raise ConfigError(
            f"{folder / 'reproduce.json'}: has more than the {_MAX_BLOCKS:,} blocks that a page has room for"
        )
    return [
        PageSection(
            str(section["title"]),
            [
                block
                for described in section["blocks"]
                for block in _blocks(described, folder, of_run, of_curves)
            ],
        )
        for section in document["sections"]
    ]


def _blocks(described: Described, folder: Path, of_run: OfRun, of_curves: OfCurves) -> list[Block]:
    kind = described["kind"]
    if kind == "run":
        return of_run(_inside(folder, described["path"]))
    if kind == "curves":
        return of_curves([_inside(folder, path) for path in described["paths"]])
    if kind not in _SIMPLE:
        raise ConfigError(
            f"{folder / 'reproduce.json'}: {kind!r} is no kind of block; there are: run, curves, "
            f"{', '.join(_SIMPLE)}"
        )
    return [_SIMPLE[kind](described)]


def _inside(folder: Path, path: str) -> Path:
    """A run folder within this one: a report never reads elsewhere."""
    found = (folder / path).resolve()
    if not found.is_relative_to(folder.resolve()):
        raise ConfigError(
            f"{folder / 'reproduce.json'}: {path!r} lies outside this run folder; name a folder inside it"
        )
    if not found.is_dir():
        raise ConfigError(
            f"{folder / 'reproduce.json'}: {path!r} is no folder here; run 'uuv reproduce' again to make it"
        )
    return found


def _table(described: Described) -> Table:
    rows = [["-" if cell is None else value_name(cell) for cell in row] for row in described["rows"]]
    data = Data(described["columns"], described["rows"])
    columns = heads(*described["columns"], n_left=described.get("n_left", 1))
    return Table(columns, rows, described.get("caption", ""), data=data)


def _verdicts(described: Described) -> Verdicts:
    items = [
        Verdict(str(item["claim"]), str(item["verdict"]), str(item["numbers"])) for item in described["items"]
    ]
    for item in items:
        if item.ruling not in RULINGS:
            raise ConfigError(
                f"reproduce.json: {item.ruling!r} is no verdict; there are: {', '.join(RULINGS)}"
            )
    return Verdicts(items)


_SIMPLE: dict[str, Callable[[Described], Block]] = {
    "prose": lambda described: Paragraph(str(described["text"])),
    "heading": lambda described: Heading(str(described["text"])),
    "notice": lambda described: Notice(str(described["text"])),
    "table": _table,
    "verdicts": _verdicts,
}
