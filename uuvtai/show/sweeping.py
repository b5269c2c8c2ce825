"""A sweep in the terminal: heat maps where two axes vary, else one row per cell."""

from __future__ import annotations

from typing import Any

from uuvtai.show.heat_maps import print_heat_maps
from uuvtai.show.screen import Screen
from uuvtai.tables.cell_table import cell_table
from uuvtai.tables.heatmap import varying
from uuvtai.tables.one_at_a_time import varies_alone


def show_sweep(screen: Screen, result: dict[str, Any]) -> None:
    """Cells of a ``uuv sweep --json`` document."""
    if len(varying(result["axes"])) > 1 and not varies_alone(result):
        print_heat_maps(result, screen.console, is_whole=screen.wide)
        return
    title = f"{result['world']}: {len(result['cells'])} cells x {result['episodes_per_seed']} episodes"
    screen.table(cell_table(result["cells"], result, title))
