"""What a person at the wheel sees on the terminal: the map that the vehicle has made, from above, and its
instruments. Characters alone, so that it reads without colours too."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.text import Text

_ARROWS = "→↗↑↖←↙↓↘"
_INK = {"#": "yellow", "%": "red", "o": "bold red", "G": "bold green"}
_LEGEND = "# standing   % moving   o followed by the sonar   G goal"


@contextmanager
def steering_view(note: str) -> Iterator[Callable[[Any], None]]:
    """A function that shows a ``live.hand_driver.DriverView`` in the place of the one before; ``note`` stands
    below."""
    console = Console(stderr=True)
    with Live(console=console, auto_refresh=False, transient=True) as live:
        yield lambda view: live.update(screenful(view, console.width, console.height, note), refresh=True)


def screenful(view: Any, width: int, height: int, note: str = "") -> Text:
    """The map at most ``width`` columns wide, a line per row of characters twice as high as wide, with what
    the instruments say; at most ``height`` lines."""
    lines = [*_instruments(view), "", _LEGEND, *note.splitlines()]
    chart = _chart(view, width - 2, max(4, height - len(lines) - 3))
    border = "+" + "-" * chart.shape[1] + "+"
    found = Text(no_wrap=True, overflow="crop")
    found.append(border + "\n")
    for row in chart[::-1]:  # y upwards
        found.append("|")
        for character in row:
            found.append(character, style=_INK.get(character, "bold" if character in _ARROWS else ""))
        found.append("|\n")
    found.append("\n".join([border, *lines]))
    return found


def _chart(view: Any, columns: int, rows: int) -> np.ndarray:
    """(rows, columns) characters, the first row at the lowest y."""
    height_m, width_m = (count * view.cell_m for count in view.static.shape)
    scale = min(columns / width_m, 2.0 * rows / height_m)
    shape = max(1, int(height_m * scale / 2.0)), max(1, int(width_m * scale))
    chart = np.full(shape, " ")
    for cells, character in ((view.static, "#"), (view.dynamic, "%")):
        y, x = np.nonzero(cells)
        chart[y * shape[0] // cells.shape[0], x * shape[1] // cells.shape[1]] = character

    def mark(x_m: float, y_m: float, character: str) -> None:
        column = int((x_m - view.origin_m[0]) / width_m * shape[1])
        row = int((y_m - view.origin_m[1]) / height_m * shape[0])
        if 0 <= row < shape[0] and 0 <= column < shape[1]:
            chart[row, column] = character

    mark(view.goal[0], view.goal[1], "G")
    for x, y in view.bodies:
        mark(x, y, "o")
    mark(view.position[0], view.position[1], _ARROWS[round(view.yaw_rad / (math.pi / 4)) % 8])
    return chart


def _instruments(view: Any) -> list[str]:
    way = [goal - own for goal, own in zip(view.goal, view.position, strict=True)]
    bearing = math.degrees(math.atan2(way[1], way[0]) - view.yaw_rad)
    bearing = (bearing + 180.0) % 360.0 - 180.0
    side = "left" if bearing >= 0 else "right"
    ahead, left, up = view.velocity
    return [
        f"time {view.time_s:5.1f} s, {view.left_s:.0f} s left   speed {ahead:+.2f} ahead {left:+.2f} left "
        f"{up:+.2f} up m/s   keys {view.share:.0%}",
        f"goal {math.hypot(way[0], way[1]):4.1f} m, {abs(bearing):3.0f} deg to the {side}, "
        f"{abs(way[2]):.1f} m {'higher' if way[2] >= 0 else 'lower'}   nearest return {view.near_m:.2f} m",
    ]
