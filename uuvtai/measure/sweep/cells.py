"""The grid of a sweep: named axes and their values, and the cells they make."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from uuvtai.loader import ConfigError, parsed_yaml, preset_names, read_preset

SCENE_AXES = {"S": "world.n_static", "D": "world.n_dynamic", "v": "world.dynamic_speed_m_s"}
"""axes that vary as data within one simulator, and their config keys"""
PRESET_AXES = ("sensors", "vehicle", "world")
"""axes whose values are names of presets"""
MAX_CELLS = 10_000
DEFAULT = "paper"
"""grid preset of a sweep that names no axes"""
_KEY = re.compile(r"[a-z_][a-z0-9_]*(\.[a-z_][a-z0-9_]*)+")

Value = Any
Cell = dict[str, Value]
"""value of every axis that the cell sets, by the axis's name"""


@dataclass(frozen=True)
class Grid:
    """Axes by name; ``one_at_a_time``: each axis alone around the unchanged condition, instead of all
    combinations."""

    axes: dict[str, tuple[Value, ...]]
    one_at_a_time: bool = False

    def cells(self) -> list[Cell]:
        """Every cell once; where nothing moves (D = 0) the obstacles' speed means nothing and stands for all
        its values."""
        found = self._alone() if self.one_at_a_time else self._combined()
        kept: dict[str, Cell] = {repr(sorted(cell.items())): cell for cell in map(_without_speed, found)}
        return list(kept.values())

    def _combined(self) -> list[Cell]:
        return [
            dict(zip(self.axes, values, strict=True)) for values in itertools.product(*self.axes.values())
        ]

    def _alone(self) -> list[Cell]:
        return [{}, *({name: value} for name, values in self.axes.items() for value in values)]

    def document(self) -> dict[str, Any]:
        """As ``uuv sweep --json`` tells it."""
        return {name: list(values) for name, values in self.axes.items()}


def _without_speed(cell: Cell) -> Cell:
    return {name: value for name, value in cell.items() if name != "v" or cell.get("D") != 0}


def grid_of(texts: Sequence[str]) -> Grid:
    """Grid of ``--grid`` texts: ``AXIS=value,value,..`` (repeatable), or the name or path of one grid preset,
    whose axes they then replace.

    Raises ConfigError.
    """
    named = [text for text in texts if "=" not in text]
    if len(named) > 1:
        raise ConfigError(f"--grid {', '.join(named)}: one preset at most; add axes as --grid D=0,6")
    typed = dict(_axis(text) for text in texts if "=" in text)
    if len(typed) < len(texts) - len(named):
        raise ConfigError("--grid: an axis is given twice; write all its values in one: --grid D=0,3,6")
    start = read_grid(named[0] if named else DEFAULT) if named or not typed else Grid({})
    return checked(Grid(start.axes | typed, start.one_at_a_time))


def read_grid(name: str) -> Grid:
    """Grid of a preset's name or a YAML file's path. Raises ConfigError."""
    tree = read_preset("grid", name)
    unknown = tree.keys() - {"axes", "one_at_a_time"}
    axes = tree.get("axes")
    if unknown or not isinstance(axes, dict) or not all(isinstance(values, list) for values in axes.values()):
        raise ConfigError(
            f"grid {name}: needs 'axes:', each a list of values, and may have 'one_at_a_time: true'"
            + (f"; {', '.join(sorted(unknown))} is not known" if unknown else "")
        )
    return Grid(
        {str(axis): tuple(values) for axis, values in axes.items()}, bool(tree.get("one_at_a_time", False))
    )


def _axis(text: str) -> tuple[str, tuple[Value, ...]]:
    name, _equals, values = text.partition("=")
    parsed = parsed_yaml(f"[{values}]", f"--grid {name}")
    if not isinstance(parsed, list):
        raise ConfigError(
            f"--grid {text!r}: write AXIS=value,value,.. for example --grid S=4,8 --grid "
            "teacher.caution=0.5,1,2"
        )
    return name.strip(), tuple(parsed)


def checked(grid: Grid) -> Grid:
    """The grid itself. Raises ConfigError where an axis is unknown, empty, has a value twice, or the cells
    are too many."""
    if not grid.axes:
        raise ConfigError("the grid has no axes; for example --grid S=4,8,12 --grid D=0,6")
    for name, values in grid.axes.items():
        if name not in SCENE_AXES and name not in PRESET_AXES and not _KEY.fullmatch(name):
            raise ConfigError(
                f"--grid {name}: no such axis; it is S, D, v, {', '.join(PRESET_AXES)} or a dotted config "
                "key such as teacher.caution"
            )
        if not values:
            raise ConfigError(f"--grid {name}: has no values; for example --grid {name}=1,2")
        if len({repr(value) for value in values}) < len(values):
            raise ConfigError(f"--grid {name}: a value is given twice: {', '.join(map(str, values))}")
        _check_values(name, values)
    count = 1
    for values in grid.axes.values():
        count *= len(values)
    if not grid.one_at_a_time and count > MAX_CELLS:
        raise ConfigError(
            f"the grid has {count:,} cells, more than {MAX_CELLS:,}: split it into several sweeps"
        )
    return grid


def _check_values(name: str, values: Sequence[Value]) -> None:
    for value in values:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if name in ("S", "D") and (not isinstance(value, int) or isinstance(value, bool) or value < 0):
            raise ConfigError(
                f"--grid {name}: {value!r} is no number of obstacles; give whole numbers from 0"
            )
        if name == "v" and (not number or not 0 <= value < float("inf")):
            raise ConfigError(
                f"--grid v: {value!r} is no speed; give numbers in m/s, for example --grid v=0.2,0.6"
            )
        if name in PRESET_AXES and not (
            isinstance(value, str) and (value in preset_names(name) or Path(value).suffix)
        ):
            raise ConfigError(
                f"--grid {name}: {value!r} is no {name} preset; there are {', '.join(preset_names(name))}"
            )
