"""The one table: columns that say how they are shown, and rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

TERMINAL, PAGE = "terminal", "page"
"""where a table is shown; a page is HTML or Markdown"""


@dataclass(frozen=True)
class Cell:
    """What a text alone does not say."""

    text: str
    short: str = ""
    """the same for a terminal, where room is scarce"""
    style: str = ""
    """of a terminal, as Rich names it"""

    def __str__(self) -> str:
        return self.text

    @property
    def brief(self) -> str:
        """For a terminal."""
        return self.short or self.text


@dataclass(frozen=True)
class Column:
    """A column of a table: its head with the unit, and how gladly a narrow terminal leaves it out."""

    head: str
    priority: int = 0
    """0 = always shown; the highest number goes first"""
    left: bool = False
    """words; numbers stand on the right"""
    prose: bool = False
    """may be wrapped between words"""
    short: str = ""
    """head in a terminal, if another one; may hold line breaks"""
    only: str = ""
    """TERMINAL or PAGE; nothing = both"""
    of: Callable[[Any], str | Cell] | None = None
    """from a row to the cell; without, a row is the list of its cells"""


@dataclass(frozen=True)
class Data:
    """Numbers behind a figure or a table, as a spreadsheet would take them."""

    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]

    def csv(self) -> str:
        """The numbers as CSV (RFC 4180) with a header line; None is an empty field."""
        import csv
        import io

        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows(self.rows)
        return text.getvalue()


@dataclass(frozen=True)
class Table:
    """Columns, rows and a title; the last three are a page's."""

    columns: Sequence[Column]
    rows: Sequence[Any]
    title: str = ""
    sections: Sequence[int] = ()
    """rows after which a terminal draws a rule"""
    data: Data | None = None
    """the same as numbers, for download"""
    folded: bool = False
    """long: shown when asked for"""
    swatches: Sequence[str] = ()
    """colour of each row, '#rrggbb': the one that its method has in the figures; none = no colours"""

    def on(self, medium: str) -> tuple[list[Column], list[list[str | Cell]]]:
        """Columns that TERMINAL or PAGE shows, and the cells of each row in them."""
        kept = [(i, column) for i, column in enumerate(self.columns) if column.only in ("", medium)]
        cells = [[column.of(row) if column.of else row[i] for i, column in kept] for row in self.rows]
        return [column for _, column in kept], cells

    def filled(self, medium: str) -> Table:
        """The same with cells in place of rows, for one medium."""
        columns, cells = self.on(medium)
        return replace(self, columns=[replace(column, of=None) for column in columns], rows=cells)


def heads(*names: str, n_left: int = 1) -> list[Column]:
    """Columns of which the first ``n_left`` hold words."""
    return [Column(name, left=i < n_left) for i, name in enumerate(names)]


def markdown(table: Table) -> str:
    """The table in Markdown; what would break its cells is escaped."""
    columns, cells = table.on(PAGE)
    lines = [[column.head for column in columns], ["---"] * len(columns), *cells]
    return "\n".join("| " + " | ".join(_escaped(str(cell)) for cell in line) + " |" for line in lines)


def text_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Texts below their heads in Markdown."""
    return markdown(Table(heads(*head), rows))


def _escaped(text: str) -> str:
    return " ".join(text.split()).replace("|", r"\|")
