"""The one table: columns that say how they are shown, and rows; its words, and heat maps of a grid."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from uuvtai.common.enums import COLLIDED
from uuvtai.common.errors import SettingError

TERMINAL, PAGE = "terminal", "page"  # where a table is shown; a page is HTML or Markdown


@dataclass(frozen=True)
class Cell:
    """What a text alone does not say."""

    text: str
    short: str = ""  # the same for a terminal, where room is scarce
    style: str = ""  # of a terminal, as Rich names it

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
    priority: int = 0  # 0 = always shown; the highest number goes first
    left: bool = False  # words; numbers stand on the right
    prose: bool = False  # may be wrapped between words
    short: str = ""  # head in a terminal, if another one; may hold line breaks
    only: str = ""  # TERMINAL or PAGE; nothing = both
    of: Callable[[Any], str | Cell] | None = None  # from a row to the cell; without, a row is its cells


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
    sections: Sequence[int] = ()  # rows after which a terminal draws a rule
    data: Data | None = None  # the same as numbers, for download
    folded: bool = False  # long: shown when asked for
    swatches: Sequence[str] = ()
    """colour of each row, '#rrggbb': the one that its agent has in the figures; none = no colours"""

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
    return "\n".join(
        "| " + " | ".join(" ".join(str(cell).split()).replace("|", r"\|") for cell in line) + " |"
        for line in lines
    )


def text_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return markdown(Table(heads(*head), rows))


# ---- Numbers in tables and pages: every rate with its count and its interval, what is not known as a dash.

_NAMES = {"v_m_s": "v m/s"}
_LOCALIZED = {
    "truth": "position known",
    "dead_reckoning": "dead reckoning",
    "estimated": "position estimated",
}


def rate(k: int | None, n: int, interval: Sequence[float] | None) -> Cell:
    """'490/500 = 98.0 % [96.4, 98.9]', in a terminal '490/500 = 98.0 % [96, 99]'."""
    if k is None or not n:
        return Cell("-")
    share = f"{k}/{n} = {100 * k / n:.1f} %"
    if not interval:
        return Cell(share)
    low, high = (100 * bound for bound in interval)
    return Cell(f"{share} [{low:.1f}, {high:.1f}]", f"{share} [{low:.0f}, {high:.0f}]")


def sensing(result: Mapping[str, Any]) -> str:
    """'harsh sensing, position estimated'; results of old versions do not say how the position was found."""
    where = _LOCALIZED.get(str(result.get("localization")))
    return f"{result['sensors']} sensing" + (f", {where}" if where else "")


def obstacles(result: Mapping[str, Any], resting: str = "", moving: str = "") -> str:
    """'S = 11 (3 fixed), D = 6' of a result, or of a world; old versions did not count the fixed ones."""
    told = []
    for name, fixed, kind in (("S", "fixed_static", resting), ("D", "fixed_moving", moving)):
        explicit = f" ({result[fixed]} fixed)" if result.get(fixed) else ""
        told.append(f"{name} = {result[name]}{explicit}{kind}")
    return ", ".join(told)


def vehicle(result: Mapping[str, Any]) -> str:
    """'vehicle bluerov2, ', '' of results of old versions."""
    return f"vehicle {result['vehicle']}, " if result.get("vehicle") else ""


def number(value: float | None, digits: int = 1) -> str:
    """Fixed digits, thousands apart."""
    return "-" if value is None else f"{value:,.{digits}f}"


def percent(share: float | None, digits: int = 1) -> str:
    """A share as per cent."""
    return "-" if share is None else f"{100 * share:.{digits}f} %"


def seconds(value: float | None) -> str:
    """'1.3 s'."""
    return "-" if value is None else f"{value:.1f} s"


def probability(p: float | None, form: str = ".2g") -> str:
    """A p value, of two digits unless ``form`` says otherwise; never a zero that it is not."""
    return "-" if p is None else "< 0.0001" if p < 1e-4 else f"{p:{form}}"


def with_interval(value: float | None, interval: Sequence[float] | None, digits: int = 2) -> str:
    """'-0.15 [-0.28, -0.02]'."""
    bounds = f" [{interval[0]:.{digits}f}, {interval[1]:.{digits}f}]" if interval else ""
    return number(value, digits) + bounds


def value_name(value: object) -> str:
    """A value of an axis as a tick says it: 0.6, 4, nominal."""
    return f"{value:g}" if isinstance(value, int | float) and not isinstance(value, bool) else str(value)


def axis_name(key: str) -> str:
    return _NAMES.get(key, key)


def accidents(outcomes: dict[str, int]) -> int:
    """Contacts, TTC stops and episodes out of the tank."""
    return sum(outcomes.get(name, 0) for name in COLLIDED)


def megabytes(n_bytes: int) -> str:
    """'23.6 MB'."""
    return f"{n_bytes / 1e6:.1f} MB"


# ---- Layout of a heat map: cells of a sweep as rows and columns, for the figure and the terminal alike.

SPEED = "v_m_s"
MapCell = dict[str, Any]


def cell_name(axis: str) -> str:
    """What cells call an axis that a sweep may name shorter."""
    return SPEED if axis == "v" else axis


_RESULTS = {
    "agent", "episodes", "outcomes", "k", "n", "success_rate", "success_ci95", "collision_rate",
    "collision_ci95", "time_mean_s",
    "tts_s", "time_to_success_mean_s", "return_mean", "env_steps", "wall_s", "env_steps_per_s",
    "min_clearance_mean_m",
    "path_length_mean_m", "replans_per_episode", "ends",
}  # fmt: skip


def place_of(cell: MapCell) -> dict[str, Any]:
    """Axes of a cell with their values: every key that is no result (values of config keys may be lists)."""
    plain = {key: value for key, value in cell.items() if "." in key or not isinstance(value, dict | list)}
    return {key: value for key, value in plain.items() if key not in _RESULTS and value is not None}


@dataclass(frozen=True)
class Place:
    """A cell and where it stands; one without a column value (D = 0 has no speed) spans the row."""

    row: int
    first: int
    n_columns: int
    cell: MapCell


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
        return [value_name(value) for value in self.column_values]

    @property
    def row_title(self) -> str:
        """What the rows are: 'S · D'."""
        return " · ".join(map(axis_name, self.row_axes))


def pivot(cells: Iterable[MapCell], axes: dict[str, list[Any]]) -> HeatMap:
    """Lay cells out over ``axes`` (name -> values in order): the speed of the moving obstacles across where
    it varies, else the last axis that does, every other axis down.

    Raises ValueError for a sweep without an axis, and for two cells in one place.
    """
    named = {cell_name(name): list(values) for name, values in axes.items()}
    if not named:
        raise SettingError("this sweep has no axis")
    several = varying(named)
    across = SPEED if SPEED in several else [*named, *several][-1]
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


def _order(row: tuple[Any, ...], down: tuple[str, ...], axes: dict[str, list[Any]]) -> list[int]:
    """Where a row stands: by the axes' own order; values that no axis names come last."""
    return [
        axes[name].index(value) if value in axes[name] else len(axes[name])
        for name, value in zip(down, row, strict=True)
    ]


def _place(
    cell: MapCell, down: tuple[str, ...], across: str, rows: tuple[tuple[Any, ...], ...], columns: list[Any]
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
            raise SettingError(f"two cells of one agent stand in the same place: {place.cell}")
        taken |= spots


# ---- A sweep of one axis at a time: which cells change which axis, around the cell that changes nothing.

_SCENE = ("S", "D", "v_m_s")  # every cell states these, changed or not
_TICK = 14  # characters that fit under a tick


def varies_alone(document: dict[str, Any]) -> bool:
    """Whether a ``uuv sweep --json`` document is of this kind."""
    return bool(document.get("one_at_a_time"))


def changed(cell: MapCell, document: dict[str, Any]) -> dict[str, Any]:
    """What the cell changes, by the axis's name in cells: nothing or one axis."""
    own = _unchanged(document)
    return {
        name: cell[name]
        for name in own
        if cell.get(name) is not None and (name not in _SCENE or cell[name] != own[name])
    }


def _unchanged(document: dict[str, Any]) -> dict[str, Any]:
    return {cell_name(name): value for name, value in document["unchanged"].items()}


def of_axis(axis: str, document: dict[str, Any]) -> list[MapCell]:
    """The cells of one axis, by its name in cells, and those that change nothing."""
    return [cell for cell in document["cells"] if changed(cell, document).keys() <= {axis}]


def axes_of(document: dict[str, Any]) -> dict[str, list[Any]]:
    """Values of every axis in order, by its name in cells."""
    return {cell_name(name): list(values) for name, values in document["axes"].items()}


def places(axis: str, document: dict[str, Any]) -> list[Any]:
    """What cells say of an axis: first where it is unchanged, then its values."""
    return [_unchanged(document)[axis] if axis in _SCENE else None, *axes_of(document)[axis]]


def place_names(axis: str, document: dict[str, Any]) -> list[str]:
    """What stands under the unchanged condition and under each value."""
    own = _unchanged(document)[axis]
    return ["unchanged" if own is None else f"{_tick(own)}\n(own)", *map(_tick, axes_of(document)[axis])]


def _tick(value: Any) -> str:
    """Long names in lines, so that neighbours do not touch."""
    name = value_name(value)
    return name if len(name) <= _TICK else name.replace("_", "\n")


def change_name(cell: MapCell, document: dict[str, Any]) -> str:
    """'sensors = harsh', or 'nothing'."""
    changes = changed(cell, document).items()
    return ", ".join(f"{axis_name(name)} = {value_name(value)}" for name, value in changes) or "nothing"
