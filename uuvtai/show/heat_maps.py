"""Heat maps in the terminal: coloured unicode with rich, collision left, success right; the numbers are there
without colour too."""

from __future__ import annotations

from typing import Any

from rich.cells import cell_len
from rich.columns import Columns
from rich.console import Console
from rich.table import Table
from rich.text import Text

from uuvtai.report.colours import ink_on, shade
from uuvtai.show.screen import roomy
from uuvtai.tables.heatmap import HeatMap, pivot
from uuvtai.tables.wording import axis_name, number

_LEGEND = (
    "per cent of the episodes, below it the mean time to success in s; bright is good. One cell across "
    "= it does not depend on the column"
)

_WIDTH = 7
"""of a cell at least: with it both maps of the paper's grid stand side by side in 120 columns"""


def print_heat_maps(document: dict[str, Any], console: Console, is_whole: bool = False) -> None:
    """Print both heat maps of every method of a ``uuv sweep --json`` document. Raises ValueError like
    ``heatmap.pivot``.

    A map that is wider than the console comes in pieces, one below the other, unless it shall be
    ``is_whole``.
    """
    cells = document["cells"]
    for method in dict.fromkeys(cell.get("method", "") for cell in cells):
        chosen = pivot([cell for cell in cells if cell.get("method", "") == method], document["axes"])
        n = len(chosen.column_names)
        step = n if is_whole else max(1, (console.width - _row_width(chosen)) // _cell_width(chosen))
        for first in range(0, n, step):
            piece = range(first, min(n, first + step))
            tables = [
                heat_table(chosen, key, f"{method}: {key.removesuffix('_rate')}", piece)
                for key in ("collision_rate", "success_rate")
            ]
            if is_whole:
                with roomy(console, _row_width(chosen) + n * _cell_width(chosen)):
                    console.print(*tables, sep="\n")
            else:
                console.print(Columns(tables, padding=(0, 4)))
    console.print(Text(_LEGEND, style="dim"))


def _row_width(chosen: HeatMap) -> int:
    """[columns] of the terminal that the rows' names take."""
    return max(map(cell_len, [_corner(chosen), *(f"{name} " for name in chosen.row_names)]))


def _cell_width(chosen: HeatMap) -> int:
    """[columns] of the terminal for a cell: no value of the axis is cut, and long ones do not touch."""
    longest = max(map(cell_len, chosen.column_names), default=0)
    return max(_WIDTH, longest + (longest >= _WIDTH))


def _corner(chosen: HeatMap) -> str:
    return f"{chosen.row_title} \\ {axis_name(chosen.column_axis)} ".removeprefix(" \\ ")


def heat_table(chosen: HeatMap, key: str, title: str, piece: range) -> Table:
    """One heat map of the rate ``key``, of the columns in ``piece``."""
    table = Table(title=Text(title), title_justify="left", box=None, padding=0)
    table.add_column(Text(_corner(chosen)), no_wrap=True)
    for column in piece:
        table.add_column(
            Text(chosen.column_names[column]), justify="center", no_wrap=True, width=_cell_width(chosen)
        )
    for row, name in enumerate(chosen.row_names):
        table.add_row(Text(f"{name} "), *_row(chosen, row, key)[piece.start : piece.stop])
    return table


def _row(chosen: HeatMap, row: int, key: str) -> list[Text]:
    texts = [Text("·", style="dim") for _ in chosen.column_values]
    for place in chosen.places:
        if place.row == row:
            said, empty = _texts(place.cell, key, _cell_width(chosen))
            middle = place.first + (place.n_columns - 1) // 2
            for column in range(place.first, place.first + place.n_columns):
                texts[column] = said if column == middle else empty
    return texts


def _texts(cell: dict[str, Any], key: str, width: int) -> tuple[Text, Text]:
    """The cell's two lines, and the same place without words for the columns that it also spans."""
    rate = cell.get(key)
    if rate is None:
        return Text("-", style="dim"), Text("")
    ground = shade(rate if key == "success_rate" else 1.0 - rate)
    style = f"{ink_on(ground)} on {ground}"
    lines = (f"{100 * rate:.0f} %", number(cell.get("time_to_success_mean_s")))
    return Text("\n".join(f"{line:^{width}}" for line in lines), style=style), Text(
        "\n".join(" " * width for _ in lines), style=style
    )
