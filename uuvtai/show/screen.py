"""The terminal: one kind of table for every command, which leaves out columns before it would cut a cell."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from uuvtai.endings import plain

_PIPE_WIDTH = 160
"""[columns] of text that goes into a file: nobody's terminal limits it"""
_WRAPPED_MIN = 16
"""[columns] a column of prose gets at least before others are left out for it"""
_ENDLESS = 100_000

Cell = str | Text


@dataclass(frozen=True)
class Column:
    """A column of a table: its head, and how gladly it is left out where the terminal is narrow."""

    head: str
    """may hold line breaks"""
    priority: int = 0
    """0 = always shown; the highest number goes first"""
    left: bool = False
    """words; numbers stand on the right"""
    prose: bool = False
    """may be wrapped between words"""


class Screen:
    """Where results are shown. ``wide`` shows every column, however narrow the terminal; a file is wide in
    any case."""

    def __init__(self, wide: bool = False, console: Console | None = None) -> None:
        """``console``: stdout, unless it is given."""
        is_terminal = console is not None or (sys.stdout is not None and sys.stdout.isatty())
        self.console = console or Console(width=None if is_terminal else _PIPE_WIDTH)
        self.wide = wide or not is_terminal

    def line(self, text: Cell, style: str = "") -> None:
        """A line of prose, wrapped between words; no markup."""
        self.console.print(_text(text, style), highlight=False, soft_wrap=False, overflow="fold")

    def table(
        self,
        columns: Sequence[Column],
        rows: Sequence[Sequence[Cell]],
        title: str = "",
        sections: Sequence[int] = (),
    ) -> None:
        """A table with a title; a rule is drawn after each row named in ``sections``.

        Where it is wider than the terminal, the columns of highest ``priority`` are left out and named in a
        line below.
        """
        if title:
            self.line(title, "italic")
        shown, left_out = list(range(len(columns))), []
        while (
            not self.wide
            and (found := _dispensable(columns, shown)) is not None
            and not self._fits(columns, rows, shown)
        ):
            shown.remove(found)
            left_out.append(found)
        kept, cells = [columns[i] for i in shown], [[row[i] for i in shown] for row in rows]
        table = _table(kept, cells, self._foldable(columns, rows, shown), sections)
        with roomy(self.console, table if self.wide else None):
            self.console.print(table)
        if left_out:
            names = ", ".join(columns[i].head.replace("\n", " ") for i in sorted(left_out))
            self.line(f"left out, for want of room: {names}; --wide shows all", "dim")

    def _fits(
        self,
        columns: Sequence[Column],
        rows: Sequence[Sequence[Cell]],
        shown: Sequence[int],
        folded: str = "",
    ) -> bool:
        """Whether these columns have room where prose, and what else is ``folded``, is as narrow as it may
        become."""
        kept = [columns[i] for i in shown]
        narrowed = [
            [_narrowed(column, row[i], folded) for column, i in zip(kept, shown, strict=True)] for row in rows
        ]
        return needed(self.console, _table(kept, narrowed)) <= self.console.width

    def _foldable(
        self, columns: Sequence[Column], rows: Sequence[Sequence[Cell]], shown: Sequence[int]
    ) -> str:
        """What goes on in the next line where it has no room, beside prose: nothing, names, or everything."""
        if self.wide or self._fits(columns, rows, shown):
            return ""
        return "names" if self._fits(columns, rows, shown, "names") else "all"


@contextlib.contextmanager
def roomy(console: Console, table: Table | None) -> Iterator[None]:
    """Whatever is printed inside has as many columns as ``table`` needs, though the terminal may have fewer;
    None changes nothing."""
    before = console.width
    if table is not None:
        console.width = max(before, needed(console, table))
    try:
        yield
    finally:
        console.width = before


def _dispensable(columns: Sequence[Column], shown: Sequence[int]) -> int | None:
    """The column to leave out next: of highest priority, the rightmost of equals; None = all are
    essential."""
    priority, index = max((columns[i].priority, i) for i in shown)
    return index if priority > 0 else None


def _narrowed(column: Column, cell: Cell, folded: str) -> Cell:
    """The least of a cell that there must be room for."""
    return str(cell)[:_WRAPPED_MIN] if _folds(column, folded) else cell


def _folds(column: Column, folded: str) -> bool:
    return column.prose or folded == "all" or (folded == "names" and column.left)


def _table(
    columns: Sequence[Column], rows: Sequence[Sequence[Cell]], folded: str = "", sections: Sequence[int] = ()
) -> Table:
    """A cell of a column that folds goes on in the next line, whole; the others keep their width."""
    table = Table(
        box=SIMPLE_HEAD, pad_edge=False, show_edge=False, show_header=any(column.head for column in columns)
    )
    for column in columns:
        justify = "left" if column.left or column.prose else "right"
        table.add_column(
            Text(column.head),
            justify=justify,
            no_wrap=not _folds(column, folded),
            overflow="fold",
            vertical="top",
        )
    for number, row in enumerate(rows):
        table.add_row(*[_text(cell) for cell in row], end_section=number in sections)
    return table


def needed(console: Console, table: Table) -> int:
    """[columns] that a table takes where nothing is wrapped."""
    return Measurement.get(console, console.options.update(width=_ENDLESS), table).maximum


def _text(cell: Cell, style: str = "") -> Text:
    """As it is: brackets in a file's name are no markup, and nothing in it steers the terminal."""
    return cell if isinstance(cell, Text) else Text(plain(cell), style=style)
