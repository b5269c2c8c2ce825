"""A sweep of one axis at a time: which cells change which axis, around the cell that changes nothing.
Pure."""

from __future__ import annotations

from typing import Any

from uuvtai.tables.heatmap import Cell, cell_name
from uuvtai.tables.wording import axis_name, value_name

_SCENE = ("S", "D", "v_m_s")
"""every cell states these, changed or not"""
_TICK = 14
"""characters that fit under a tick"""


def varies_alone(document: dict[str, Any]) -> bool:
    """Whether a ``uuv sweep --json`` document is of this kind."""
    return bool(document.get("one_at_a_time"))


def changed(cell: Cell, document: dict[str, Any]) -> dict[str, Any]:
    """What the cell changes, by the axis's name in cells: nothing or one axis."""
    own = _unchanged(document)
    return {
        name: cell[name]
        for name in own
        if cell.get(name) is not None and (name not in _SCENE or cell[name] != own[name])
    }


def _unchanged(document: dict[str, Any]) -> dict[str, Any]:
    return {cell_name(name): value for name, value in document["unchanged"].items()}


def of_axis(axis: str, document: dict[str, Any]) -> list[Cell]:
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


def change_name(cell: Cell, document: dict[str, Any]) -> str:
    """'sensors = harsh', or 'nothing'."""
    changes = changed(cell, document).items()
    return ", ".join(f"{axis_name(name)} = {value_name(value)}" for name, value in changes) or "nothing"
