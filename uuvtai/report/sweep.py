"""Table of the cells of a sweep (the document of ``uuv sweep --json``)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from uuvtai.common.colours import agent_colours, ink_on, shade
from uuvtai.common.enums import FINAL_OUTCOMES
from uuvtai.report.blocks import Block, Figure, Notice, Paragraph
from uuvtai.report.evaluation import COLLISION, ENDS, SUCCESS, TIME, TTS
from uuvtai.report.figures import Line, heat_map, hover_text, intervals
from uuvtai.report.tables import (
    PAGE,
    TERMINAL,
    Cell,
    Column,
    Data,
    MapCell,
    Table,
    axes_of,
    axis_name,
    change_name,
    number,
    of_axis,
    pivot,
    place_names,
    place_of,
    places,
    value_name,
    varies_alone,
    varying,
)

_SCENE = {"S": "S", "D": "D", "v": "v_m_s"}


def cell_table(cells: list[MapCell], document: dict[str, Any], title: str, **page: Any) -> Table:
    """One row a cell: where it stands, rates with counts and intervals, how the rest ended, times."""
    agent = Column("agent", left=True, of=agent_of)
    columns = [
        replace(agent, only=PAGE),
        *(axis_column(name) for name in axes_of_cells(cells)),
        *_place(document),
        replace(agent, only=TERMINAL),
        SUCCESS,
        COLLISION,
        replace(ENDS, only=PAGE),
        replace(TIME, priority=1),
        replace(TTS, only=PAGE),
    ]
    return Table(columns, cells, title, **page)


def agent_of(cell: MapCell) -> str:
    return str(cell["agent"])


def axes_of_cells(cells: list[MapCell]) -> list[str]:
    """Every axis that a cell names, in the order in which they come."""
    return list(dict.fromkeys(name for cell in cells for name in place_of(cell)))


def axis_column(name: str) -> Column:
    def value(cell: MapCell) -> str:
        return "-" if cell.get(name) is None else value_name(cell[name])

    return Column(axis_name(name), left=True, only=PAGE, of=value)


def _place(document: dict[str, Any]) -> list[Column]:
    """Where a cell stands, in a terminal: the scene, less what does not vary, and what else varies."""
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


# ---- Blocks of ``uuv sweep --json``: heat maps over two or more axes, curves with intervals over one.

ON_HOVER = "Counts and intervals: on hover and below"  # said of a figure on a page, where it has both
_NUMBERS = ("success_rate", "collision_rate", "time_mean_s", "tts_s", "time_to_success_mean_s")


def sweep(document: dict[str, Any], command: str = "") -> list[Block]:
    cells, axes = document["cells"], document["axes"]
    if not cells:
        return [Notice("No cell of this sweep is finished yet.")]
    spans = "; ".join(
        f"{axis_name(name)} in {{{', '.join(map(value_name, values))}}}" for name, values in axes.items()
    )
    episodes = sum(cell["episodes"] for cell in cells)
    said = f"World {document.get('world', '-')}, {spans}: {len(cells)} cells, {episodes:,} episodes in all."
    if varies_alone(document):
        return [
            Paragraph(f"{said} One axis at a time, all else unchanged."),
            *(
                _axis_figure(
                    of_axis(axis, document),
                    axis,
                    places(axis, document),
                    place_names(axis, document),
                    command,
                )
                for axis in axes_of(document)
            ),
            _cells(cells, document, "Every cell"),
        ]
    drawn = _curves(document, command) if len(varying(axes)) < 2 else _maps(document, command)
    return [Paragraph(said), *drawn]


def _maps(document: dict[str, Any], command: str) -> list[Block]:
    """Two heat maps an agent, like the paper's figure."""
    cells, axes = document["cells"], document["axes"]
    blocks: list[Block] = []
    for agent, own in by_agent(cells).items():
        chosen = pivot(own, axes)
        panels = [heat_map(chosen, f"{key}_rate", f"{agent}: {key}") for key in ("collision", "success")]
        caption = (
            f"{agent}: collision (left) and success (right) in per cent of the episodes, below each the "
            "mean time of the successes. Bright is good in both. A cell that spans the row does not depend "
            f"on the column. {ON_HOVER}"
        )
        blocks += [
            Figure(f"heat_map_{agent}", panels, caption, cells_data(own), command),
            _cells(own, document, f"Every cell of {agent}"),
        ]
    return blocks


def _curves(document: dict[str, Any], command: str) -> list[Block]:
    """Success and collision along the one axis that varies, every agent a line."""
    cells, axes = document["cells"], document["axes"]
    named = varying(axes)
    axis = named[0] if named else next(iter(axes), "")
    values = list({repr(cell.get(axis)): cell.get(axis) for cell in cells}.values())  # they may be lists
    return [
        _axis_figure(cells, axis, values, list(map(value_name, values)), command),
        _cells(cells, document, "Every cell"),
    ]


def _axis_figure(
    cells: list[MapCell], axis: str, places: list[Any], names: list[str], command: str
) -> Figure:
    own = by_agent(cells)
    colours = agent_colours(list(own))
    panels = [
        intervals(
            [_line(agent, own[agent], key, axis, places, colours[agent]) for agent in own],
            names,
            key,
            axis_name(axis),
        )
        for key in ("success", "collision")
    ]
    caption = f"Success and collision over {axis_name(axis)}, with 95 % Wilson intervals"
    return Figure(f"sweep_{axis}", panels, caption, cells_data(cells), command)


def _line(agent: str, own: list[MapCell], key: str, axis: str, places: list[Any], colour: str) -> Line:
    known = [cell for cell in own if cell.get(f"{key}_rate") is not None]
    bounds = [cell.get(f"{key}_ci95") or [cell[f"{key}_rate"]] * 2 for cell in known]
    x = [places.index(cell.get(axis)) for cell in known]
    said = [f"{agent}, {hover_text(cell)}" for cell in known]
    return Line(
        agent,
        x,
        [cell[f"{key}_rate"] for cell in known],
        [low for low, _ in bounds],
        [high for _, high in bounds],
        said,
        colour,
    )


def grid_table(own: list[MapCell], document: dict[str, Any]) -> tuple[Table, str]:
    """Success and collision [%] of one agent, rows and columns as in the heat map, and what has to be said of
    cells that span a row. A terminal shows the time, too, and the heat map's colour."""
    chosen = pivot(own, document["axes"])
    rows: list[list[str | Cell]] = [[name, *[""] * len(chosen.column_values)] for name in chosen.row_names]
    for place in chosen.places:
        rates = [place.cell.get(f"{key}_rate") for key in ("success", "collision")]
        shares, ground = [None if rate is None else 100 * rate for rate in rates], shade(rates[0] or 0.0)
        said, brief = (" / ".join(number(share, digits) for share in shares) for digits in (1, 0))
        brief += f"\n{number(place.cell.get('time_to_success_mean_s'))}"
        rows[place.row][1 + place.first] = Cell(said, brief, f"{ink_on(ground)} on {ground}")
    across = axis_name(chosen.column_axis)
    columns = [Column(name, priority=i) for i, name in enumerate(chosen.column_names)]
    spans = any(place.n_columns > 1 for place in chosen.places)
    note = f" A row with one entry does not depend on {across}." if spans else ""
    return Table([Column(f"{chosen.row_title} / {across}", left=True), *columns], rows), note


def by_agent(cells: list[MapCell]) -> dict[str, list[MapCell]]:
    """Cells of each agent, in the order in which they come."""
    found: dict[str, list[MapCell]] = {}
    for cell in cells:
        found.setdefault(agent_of(cell), []).append(cell)
    return found


def _cells(cells: list[MapCell], document: dict[str, Any], caption: str) -> Table:
    colours = agent_colours(list(by_agent(cells)))
    swatches = [colours[agent_of(cell)] for cell in cells]
    return cell_table(cells, document, caption, folded=True, swatches=swatches)


def cells_data(cells: list[MapCell]) -> Data:
    axes = axes_of_cells(cells)
    bounds = [f"{key}_ci95_{end}" for key in ("success", "collision") for end in ("low", "high")]
    return Data(
        ["agent", *axes, "episodes", *FINAL_OUTCOMES, *bounds, *_NUMBERS],
        [_numbers(cell, axes) for cell in cells],
    )


def _numbers(cell: MapCell, axes: list[str]) -> list[Any]:
    outcomes = cell.get("outcomes") or {}
    bounds = [
        bound for key in ("success", "collision") for bound in (cell.get(f"{key}_ci95") or (None, None))
    ]
    head = [cell.get("agent"), *map(cell.get, axes), cell["episodes"]]
    return [*head, *map(outcomes.get, FINAL_OUTCOMES), *bounds, *map(cell.get, _NUMBERS)]
