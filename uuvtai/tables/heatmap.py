"""Layout of a heat map: cells of a sweep as rows and columns, for the figure and the terminal alike. Pure."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from uuvtai.errors import SettingError
from uuvtai.tables.wording import axis_name, value_name

SPEED = "v_m_s"
Cell = dict[str, Any]


def cell_name(axis: str) -> str:
    """What cells call an axis that a sweep may name shorter."""
    return SPEED if axis == "v" else axis


_RESULTS = {
    "method", "episodes", "outcomes", "k", "n", "success_rate", "success_ci95", "collision_rate",
    "collision_ci95", "time_mean_s",
    "tts_s", "time_to_success_mean_s", "return_mean", "env_steps", "wall_s", "env_steps_per_s",
    "min_clearance_mean_m",
    "path_length_mean_m", "replans_per_episode",
}  # fmt: skip


def place_of(cell: Cell) -> dict[str, Any]:
    """Axes of a cell with their values: every key that is no result (values of config keys may be lists)."""
    plain = {key: value for key, value in cell.items() if "." in key or not isinstance(value, dict | list)}
    return {key: value for key, value in plain.items() if key not in _RESULTS and value is not None}


@dataclass(frozen=True)
class Place:
    """A cell and where it stands; one without a column value (D = 0 has no speed) spans the row."""

    row: int
    first: int
    n_columns: int
    cell: Cell


@dataclass(frozen=True)
class HeatMap:
    """Rows and columns with their values, and the cells in them. Places without a cell are not run yet."""

    row_axes: tuple[str, ...]
    column_axis: str
    row_values: tuple[tuple[Any, ...], ...]
    column_values: tuple[Any, ...]
    places: tuple[Place, ...]

    @property
    def row_names(self) -> list[str]:
        """What stands beside each row: '4 · 6'."""
        return [" · ".join(map(value_name, values)) for values in self.row_values]

    @property
    def column_names(self) -> list[str]:
        """What stands under each column."""
        return [value_name(value) for value in self.column_values]

    @property
    def row_title(self) -> str:
        """What the rows are: 'S · D'."""
        return " · ".join(map(axis_name, self.row_axes))


def pivot(cells: Iterable[Cell], axes: dict[str, list[Any]]) -> HeatMap:
    """Lay cells out over ``axes`` (name -> values in order): the speed of the moving obstacles across where
    it varies, else the last axis that does, every other axis down.

    Raises ValueError for a sweep without an axis, and for two cells in one place.
    """
    named = {cell_name(name): list(values) for name, values in axes.items()}
    if not named:
        raise SettingError("this sweep has no axis")
    across = _across(named)
    down = tuple(name for name in named if name != across)
    found = list(cells)
    rows = [tuple(cell.get(name) for name in down) for cell in found]
    row_values = tuple(
        sorted({repr(row): row for row in rows}.values(), key=lambda row: _order(row, down, named))
    )  # values may be lists
    places = tuple(_place(cell, down, across, row_values, named[across]) for cell in found)
    _refuse_doubles(places)
    return HeatMap(down, across, row_values, tuple(named[across]), places)


def varying(axes: dict[str, list[Any]]) -> list[str]:
    """Axes with more than one value, under the names that cells use."""
    return [cell_name(name) for name, values in axes.items() if len(values) > 1]


def _across(axes: dict[str, list[Any]]) -> str:
    several = varying(axes)
    if SPEED in several:
        return SPEED
    return several[-1] if several else next(reversed(axes))


def _order(row: tuple[Any, ...], down: tuple[str, ...], axes: dict[str, list[Any]]) -> list[int]:
    """Where a row stands: by the axes' own order; values that no axis names come last."""
    return [
        axes[name].index(value) if value in axes[name] else len(axes[name])
        for name, value in zip(down, row, strict=True)
    ]


def _place(
    cell: Cell, down: tuple[str, ...], across: str, rows: tuple[tuple[Any, ...], ...], columns: list[Any]
) -> Place:
    row = rows.index(tuple(cell.get(name) for name in down))
    value = cell.get(across)
    if value is None:
        return Place(row, 0, len(columns), cell)
    if value not in columns:
        raise SettingError(f"a cell has {across} = {value}, which is not among the axis' values {columns}")
    return Place(row, columns.index(value), 1, cell)


def _refuse_doubles(places: tuple[Place, ...]) -> None:
    taken: set[tuple[int, int]] = set()
    for place in places:
        spots = {(place.row, column) for column in range(place.first, place.first + place.n_columns)}
        if spots & taken:
            raise SettingError(f"two cells of one method stand in the same place: {place.cell}")
        taken |= spots
