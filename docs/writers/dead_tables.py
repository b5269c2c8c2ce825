"""The table of dead vertical thrusters in ``docs/robustness.md``: with and without the watch that notices
them, from the sweeps ``dead_*``."""

from __future__ import annotations

from docs.writers.figure_sources import Sources, pooled
from docs.writers.markdown import command_block
from uuvtai.tables.table import text_table

_SWEEPS = ("dead_sensing", "dead_frames", "dead_hold", "dead_actuators")
_AWAY = ("dead_away", "dead_away_hold")
"""thruster 4 dead, the tree told to keep away from floor and surface"""
_WATCH, _DEAD = "actuation.watch_s", "disturbance.dead_thruster"
_COUNTED = ("method", "episodes", "success", "contact", "ttc_stop", "out_of_tank", "timeout")


def dead_thrusters(sources: Sources) -> str:
    """Successes: a row for what else was changed, without / with the watch for each dead thruster."""
    found: dict[str, dict[tuple[str, str], str]] = {}
    for sweep in (*_SWEEPS, *_AWAY):
        for cell in sources.cells(sweep):
            watch, dead = cell.get(_WATCH, "2"), "away" if sweep in _AWAY else cell[_DEAD]
            counts = pooled([cell])
            found.setdefault(_beside(cell), {})[dead, watch] = f"{counts.count('success')}/{counts.episodes}"
    rows = [
        [caption, *(_off_and_on(cells, dead) for dead in ("", "4", "5")), cells.get(("away", "2"), "-")]
        for caption, cells in found.items()
    ]
    head = ["changed beside", "no thruster dead", "thruster 4 dead", "thruster 5 dead"]
    return text_table([*head, "thruster 4 dead, watched, kept away"], rows)


def _beside(cell: dict[str, str]) -> str:
    """What a cell changes besides the watch and the thruster."""
    held = {
        name: value
        for name, value in cell.items()
        if name not in (*_COUNTED, _WATCH, _DEAD, "time_to_success_mean_s")
    }
    shown = [
        f"`{name}={value}`" for name, value in held.items() if value not in ("", "0", "paper", "bluerov2")
    ]
    return ", ".join(shown) or "nothing"


def _off_and_on(cells: dict[tuple[str, str], str], dead: str) -> str:
    shown = [cells.get((dead, watch)) for watch in ("0", "2")]
    return f"{shown[0]}, {shown[1]}" if all(shown) else "-"


def dead_commands(sources: Sources) -> str:
    """What made the sweeps."""
    about = sources.json("docs/data/sweeps.json")
    return command_block(about[name]["command"] for name in (*_SWEEPS, *_AWAY))
