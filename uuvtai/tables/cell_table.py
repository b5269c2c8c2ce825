"""Table of the cells of a sweep (the document of ``uuv sweep --json``)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from uuvtai.tables.heatmap import Cell, place_of
from uuvtai.tables.method_tables import COLLISION, ENDS, SUCCESS, TIME, TTS
from uuvtai.tables.one_at_a_time import change_name, varies_alone
from uuvtai.tables.table import PAGE, TERMINAL, Column, Table
from uuvtai.tables.wording import axis_name, number, value_name

_SCENE = {"S": "S", "D": "D", "v": "v_m_s"}


def cell_table(cells: list[Cell], document: dict[str, Any], title: str, **page: Any) -> Table:
    """One row a cell: where it stands, rates with counts and intervals, how the rest ended, times."""
    method = Column("method", left=True, of=method_of)
    columns = [
        replace(method, only=PAGE),
        *(_axis(name) for name in axes_of_cells(cells)),
        *_place(document),
        replace(method, only=TERMINAL),
        SUCCESS,
        COLLISION,
        replace(ENDS, only=PAGE),
        replace(TIME, priority=1),
        replace(TTS, only=PAGE),
    ]
    return Table(columns, cells, title, **page)


def method_of(cell: Cell) -> str:
    """The method that played the cell."""
    return str(cell.get("method", "policy"))


def axes_of_cells(cells: list[Cell]) -> list[str]:
    """Every axis that a cell names, in the order in which they come."""
    return list(dict.fromkeys(name for cell in cells for name in place_of(cell)))


def _axis(name: str) -> Column:
    def value(cell: Cell) -> str:
        return "-" if cell.get(name) is None else value_name(cell[name])

    return Column(axis_name(name), left=True, only=PAGE, of=value)


def _place(document: dict[str, Any]) -> list[Column]:
    """Where a cell stands, in a terminal: the scene, of which what does not vary is the first to be left out,
    and what else varies."""
    axes = document["axes"]
    fixed = {name for name in _SCENE if len(axes.get(name, ())) < 2}
    scene = [
        Column("S", 2 * ("S" in fixed), only=TERMINAL, of=lambda cell: str(cell["S"])),
        Column("D", 2 * ("D" in fixed), only=TERMINAL, of=lambda cell: str(cell["D"])),
        Column("v m/s", 2 * ("v" in fixed), only=TERMINAL, of=lambda cell: number(cell["v_m_s"])),
    ]
    if varies_alone(document):
        changed = Column("changed", left=True, only=TERMINAL, of=lambda cell: change_name(cell, document))
        return [*scene, changed]
    return [*scene, *(_other(name) for name in axes if name not in _SCENE)]


def _other(name: str) -> Column:
    return Column(name, left=True, only=TERMINAL, of=lambda cell: str(cell.get(name, "")))
