"""The table of ``docs/vehicle.md``: the tree with every vehicle, and with weaker packs, from the sweeps
``vehicles`` and ``packs``."""

from __future__ import annotations

from docs.writers.figure_sources import Sources, pooled, rated, share
from docs.writers.markdown import command_block
from uuvtai.tables.table import text_table


def vehicles(sources: Sources) -> str:
    """A row a vehicle: rates with intervals and time, the same episodes in all of them."""
    rows = []
    for cell in (*sources.cells("vehicles"), *sources.cells("packs")):
        counts, volts = pooled([cell]), cell.get("vehicle.battery_v", "")
        rows.append(
            [
                f"`{cell['vehicle']}`",
                f"{volts} V" if volts else "as stated",
                share(counts, "success"),
                rated(counts, "collision"),
                f"{counts.time_s:.1f} s",
            ]
        )
    return text_table(["vehicle", "pack", "success", "collision", "time to goal"], rows)


def vehicle_commands(sources: Sources) -> str:
    """What made the table."""
    about = sources.json("docs/data/sweeps.json")
    return command_block(about[name]["command"] for name in ("vehicles", "packs"))
