"""A sweep in the terminal: heat maps where two axes vary, else one row per cell."""

from __future__ import annotations

from typing import Any

from uuvtai.outcomes import COLLIDED
from uuvtai.report.alone import is_alone, told
from uuvtai.report.heatmap import varying
from uuvtai.show.screen import Column, Screen
from uuvtai.show.words import number, rate

_SCENE = ("S", "D", "v")


def show_sweep(screen: Screen, result: dict[str, Any]) -> None:
    """Cells of a ``uuv sweep --json`` document."""
    if len(varying(result["axes"])) > 1 and not is_alone(result):
        from uuvtai.report.terminal import print_heat_maps

        print_heat_maps(result, screen.console, is_whole=screen.wide)
        return
    others = ["changed"] if is_alone(result) else [name for name in result["axes"] if name not in _SCENE]
    # what does not vary is told once, by its column being the first to go
    fixed = {name for name in _SCENE if name not in result["axes"] or len(result["axes"][name]) < 2}
    columns = [
        *(Column("v m/s" if name == "v" else name, 2 if name in fixed else 0) for name in _SCENE),
        *(Column(name, left=True) for name in others),
        Column("method", left=True),
        Column("success [95 %]"),
        Column("collision [95 %]"),
        Column("time to\ngoal s", 1),
    ]
    title = f"{result['world']}: {len(result['cells'])} cells x {result['episodes_per_seed']} episodes"
    screen.table(columns, [_cell(row, result, others) for row in result["cells"]], title)


def _cell(row: dict[str, Any], result: dict[str, Any], others: list[str]) -> list[str]:
    o, n = row["outcomes"], row["episodes"]
    return [
        str(row["S"]),
        str(row["D"]),
        number(row["v_m_s"]),
        *([told(row, result)] if is_alone(result) else [str(row.get(name, "")) for name in others]),
        row["method"],
        rate(o["success"], n, row["success_ci95"]),
        rate(sum(o[name] for name in COLLIDED), n, row["collision_ci95"]),
        number(row["time_to_success_mean_s"]),
    ]
