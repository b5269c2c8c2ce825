"""The terminal: one kind of table for every command, which leaves out columns before it would cut a cell."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table as RichTable
from rich.text import Text

from uuvtai.endings import plain
from uuvtai.tables.table import TERMINAL, Cell, Column, Table

_PIPE_WIDTH = 160
"""[columns] of text that goes into a file: nobody's terminal limits it"""
_WRAPPED_MIN = 16
"""[columns] a column of prose gets at least before others are left out for it"""
_ENDLESS = 100_000


class Screen:
    """Where results are shown. ``wide`` shows every column, however narrow the terminal; a file is wide in
    any case."""

    def __init__(self, wide: bool = False, console: Console | None = None) -> None:
        """``console``: stdout, unless it is given."""
        is_terminal = console is not None or (sys.stdout is not None and sys.stdout.isatty())
        self.console = console or Console(width=None if is_terminal else _PIPE_WIDTH)
        self.wide = wide or not is_terminal

    def line(self, text: str | Text, style: str = "") -> None:
        """A line of prose, wrapped between words; no markup."""
        self.console.print(_text(text, style), highlight=False, soft_wrap=False, overflow="fold")

    def table(self, table: Table) -> None:
        """A table with its title; a rule is drawn after each row of its ``sections``.

        Where it is wider than the terminal, the columns of highest ``priority`` are left out and named in a
        line below.
        """
        if table.title:
            self.line(table.title, "italic")
        layout = _Layout(self.console, *table.on(TERMINAL))
        shown, left_out = list(range(len(layout.columns))), []
        while not self.wide and (found := layout.dispensable(shown)) is not None and not layout.fits(shown):
            shown.remove(found)
            left_out.append(found)
        drawn = layout.drawn(shown, "" if self.wide else layout.foldable(shown), table.sections)
        with roomy(self.console, needed(self.console, drawn) if self.wide else 0):
            self.console.print(drawn)
        if left_out:
            names = ", ".join(_head(layout.columns[i]).replace("\n", " ") for i in sorted(left_out))
            self.line(f"left out, for want of room: {names}; --wide shows all", "dim")


@dataclass(frozen=True)
class _Layout:
    """Columns and rows of cells of which some may be shown."""

    console: Console
    columns: list[Column]
    rows: list[list[str | Cell]]

    def dispensable(self, shown: Sequence[int]) -> int | None:
        """The column to leave out next: of highest priority, the rightmost of equals; None = all are
        essential."""
        priority, index = max((self.columns[i].priority, i) for i in shown)
        return index if priority > 0 else None

    def fits(self, shown: Sequence[int], folded: str = "") -> bool:
        """Whether these columns have room where prose, and what else is ``folded``, is as narrow as it may
        become."""
        return needed(self.console, self.drawn(shown, "", (), folded)) <= self.console.width

    def foldable(self, shown: Sequence[int]) -> str:
        """What goes on in the next line where it has no room, beside prose: nothing, names, or everything."""
        if self.fits(shown):
            return ""
        return "names" if self.fits(shown, "names") else "all"

    def drawn(
        self, shown: Sequence[int], folded: str, sections: Sequence[int] = (), narrowed: str | None = None
    ) -> RichTable:
        """A cell of a column that folds goes on in the next line, whole; the others keep their width.
        ``narrowed``: to measure, cells of columns that would fold are as narrow as they may become."""
        columns = [self.columns[i] for i in shown]
        has_head = any(column.head for column in columns)
        found = RichTable(box=SIMPLE_HEAD, pad_edge=False, show_edge=False, show_header=has_head)
        for column in columns:
            found.add_column(
                Text(_head(column)),
                justify="left" if column.left or column.prose else "right",
                no_wrap=not _folds(column, folded),
                overflow="fold",
                vertical="top",
            )
        for number, row in enumerate(self.rows):
            cells = [_text(row[i]) for i in shown]
            if narrowed is not None:
                cells = [
                    Text(str(cell)[:_WRAPPED_MIN]) if _folds(column, narrowed) else cell
                    for column, cell in zip(columns, cells, strict=True)
                ]
            found.add_row(*cells, end_section=number in sections)
        return found


@contextlib.contextmanager
def roomy(console: Console, width: int) -> Iterator[None]:
    """Whatever is printed inside has ``width`` columns, though the terminal may have fewer."""
    before = console.width
    console.width = max(before, width)
    try:
        yield
    finally:
        console.width = before


def _folds(column: Column, folded: str) -> bool:
    return column.prose or folded == "all" or (folded == "names" and column.left)


def _head(column: Column) -> str:
    return column.short or column.head


def needed(console: Console, table: RichTable) -> int:
    """[columns] that a table takes where nothing is wrapped."""
    return Measurement.get(console, console.options.update(width=_ENDLESS), table).maximum


def _text(cell: str | Cell | Text, style: str = "") -> Text:
    """As it is: brackets in a file's name are no markup, and nothing in it steers the terminal."""
    if isinstance(cell, Text):
        return cell
    if isinstance(cell, Cell):
        return Text(plain(cell.brief), style=cell.style)
    return Text(plain(cell), style=style)
