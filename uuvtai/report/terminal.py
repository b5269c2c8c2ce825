"""Heat maps in the terminal: coloured unicode with rich, collision left, success right; the numbers are there without colour too."""

from __future__ import annotations

from typing import Any

from rich.columns import Columns
from rich.console import Console
from rich.table import Table
from rich.text import Text

from uuvtai.report.colours import ink_on, shade
from uuvtai.report.heatmap import HeatMap, pivot
from uuvtai.report.wording import axis_name, number

_LEGEND = (
    "per cent of the episodes, below it the mean time to success in s; bright is good. One cell across = it does not depend on the column"
)

_WIDTH = 7
"""of a cell: with it both maps of the paper's grid stand side by side in 120 columns"""


def print_heat_maps(document: dict[str, Any], console: Console, columns: str | None = None) -> None:
    """Print both heat maps of every method of a ``uuv sweep --json`` document. Raises ValueError like ``heatmap.pivot``."""
    cells = document["cells"]
    for method in dict.fromkeys(cell.get("method", "") for cell in cells):
        chosen = pivot([cell for cell in cells if cell.get("method", "") == method], document["axes"], columns)
        tables = [heat_table(chosen, key, f"{method}: {key.removesuffix('_rate')}") for key in ("collision_rate", "success_rate")]
        console.print(Columns(tables, padding=(0, 4)))
    console.print(Text(_LEGEND, style="dim"))


def heat_table(chosen: HeatMap, key: str, title: str) -> Table:
    """One heat map of the rate ``key``."""
    table = Table(title=Text(title), title_justify="left", box=None, padding=0)
    table.add_column(Text(f"{chosen.row_title} \\ {axis_name(chosen.column_axis)} ".removeprefix(" \\ ")), no_wrap=True)
    for name in chosen.column_names:
        table.add_column(Text(name), justify="center", no_wrap=True, width=_WIDTH)
    for row, name in enumerate(chosen.row_names):
        table.add_row(Text(f"{name} "), *_row(chosen, row, key))
    return table


def _row(chosen: HeatMap, row: int, key: str) -> list[Text]:
    texts = [Text("·", style="dim") for _ in chosen.column_values]
    for place in chosen.places:
        if place.row == row:
            said, empty = _texts(place.cell, key)
            middle = place.first + (place.n_columns - 1) // 2
            for column in range(place.first, place.first + place.n_columns):
                texts[column] = said if column == middle else empty
    return texts


def _texts(cell: dict[str, Any], key: str) -> tuple[Text, Text]:
    """The cell's two lines, and the same place without words for the columns that it also spans."""
    rate = cell.get(key)
    if rate is None:
        return Text("-", style="dim"), Text("")
    ground = shade(rate if key == "success_rate" else 1.0 - rate)
    style = f"{ink_on(ground)} on {ground}"
    lines = (f"{100 * rate:.0f} %", number(cell.get("time_to_success_mean_s")))
    return Text("\n".join(f"{line:^{_WIDTH}}" for line in lines), style=style), Text("\n".join(" " * _WIDTH for _ in lines), style=style)
