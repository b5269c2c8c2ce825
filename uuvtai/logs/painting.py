"""What pictures and videos have in common: the tank, maps, true bodies, ruler, all on a canvas in world
coordinates."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from uuvtai.closed_form import body_positions
from uuvtai.logs.canvas import DYNAMIC, FAINT, GREY, INK, MOVER, PAPER, STATIC, WATER, Canvas, Color
from uuvtai.logs.topics.map_topics import Layer

_MAX_MAP = 1000
"""[px] greatest height of the map"""
_HULL_RADIUS_M = 0.17
"""half the height of the hull that ``Canvas.vehicle`` draws"""


def map_canvas(tank: dict[str, Any], width_px: int, margins: tuple[int, int, int, int]) -> Canvas:
    """A canvas that fits the tank between margins (left, right, top, bottom), with even sizes."""
    left, right, top, bottom = margins
    across, along = tank["x_m"][1] - tank["x_m"][0], tank["y_m"][1] - tank["y_m"][0]
    scale = min((width_px - left - right) / across, _MAX_MAP / along)
    height = top + math.ceil(along * scale) + bottom
    shift = 0.5 * (width_px - left - right - across * scale)
    return Canvas(
        (width_px, height + height % 2), (round(left + shift), top), scale, tank["x_m"], tank["y_m"]
    )


def tank_outline(tank: dict[str, Any]) -> np.ndarray:
    """(n, 2) corners of the tank."""
    (x0, x1), (y0, y1) = tank["x_m"], tank["y_m"]
    if tank["shape"] == "circle":
        angles = np.linspace(0, 2 * np.pi, 180, endpoint=False)
        middle = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)])
        return middle + tank["radius_m"] * np.column_stack([np.cos(angles), np.sin(angles)])
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])


def paint_water(canvas: Canvas, tank: dict[str, Any]) -> None:
    """The tank's inside."""
    canvas.area(tank_outline(tank), WATER)


def paint_walls(canvas: Canvas, tank: dict[str, Any]) -> None:
    """The tank's rim; of a round tank also the paper around it, which cells may have covered."""
    if tank["shape"] == "circle":
        (x0, x1), (y0, y1) = tank["x_m"], tank["y_m"]
        box = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
        canvas.area_between(box, tank_outline(tank), PAPER)
    canvas.line(tank_outline(tank), INK, 3, closed=True)


def paint_layers(canvas: Canvas, static: Layer, dynamic: Layer, faint: np.ndarray | None = None) -> None:
    """Occupancy of two layers: grey to black, and red; ``faint`` pink below."""
    canvas.cells(np.array(STATIC), np.clip(static.values, 0, 1) ** 0.8 * 0.92, static.origin_m, static.cell_m)
    if faint is not None:
        canvas.cells(np.array(DYNAMIC), np.clip(faint, 0, 1) * 0.22, dynamic.origin_m, dynamic.cell_m)
    canvas.cells(
        np.array(DYNAMIC), np.clip(dynamic.values, 0, 1) ** 0.8 * 0.95, dynamic.origin_m, dynamic.cell_m
    )


def paint_truth(
    canvas: Canvas, scenario: dict[str, Any], time_s: float, own_z_m: float | None = None
) -> None:
    """True bodies as thin outlines where they are at this time, and the paths of those that move.

    With the vehicle's height, bodies that pass wholly above or below its hull are dashed: from above they
    seem to be in its way.
    """
    for body in scenario["bodies"]:
        at = body_positions(body, np.array([time_s]))[0]
        color = GREY
        if body["path"] is not None:
            color = MOVER
            period = body["path"]["length_m"] / max(body["path"]["speed_m_s"], 1e-6)
            canvas.dashes(
                body_positions(body, np.linspace(0, period, 181))[:, :2], mixed(MOVER, WATER, 0.45), 1
            )
        outline = body_outline(body, at)
        if own_z_m is not None and abs(at[2] - own_z_m) > body["size"][2] + _HULL_RADIUS_M:
            canvas.dashes(np.vstack([outline, outline[:1]]), color, 1)
        else:
            canvas.line(outline, color, 1, closed=True)


def body_outline(body: dict[str, Any], at: np.ndarray) -> np.ndarray:
    """(n, 2) horizontal outline of a body at a place."""
    if body["kind"] == "box":
        a, b, _ = body["size"]
        c, s = math.cos(body["yaw"]), math.sin(body["yaw"])
        return np.array([(a, b), (-a, b), (-a, -b), (a, -b)]) @ np.array([[c, s], [-s, c]]) + at[:2]
    angles = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    return at[:2] + body["size"][0] * np.column_stack([np.cos(angles), np.sin(angles)])


def mixed(color: Color, other: Color, share: float) -> Color:
    """``share`` of the first colour with the rest of the other."""
    blue, green, red = (round(share * a + (1 - share) * b) for a, b in zip(color, other, strict=True))
    return blue, green, red


def paint_ruler(canvas: Canvas) -> None:
    """Ticks along the lower and left edge and a scale bar."""
    across = canvas.x_m[1] - canvas.x_m[0]
    gap = next(step for step in (1, 2, 5, 10, 20, 50, 100, 1000) if across / step <= 14)
    for x in np.arange(math.ceil(canvas.x_m[0] / gap) * gap, canvas.x_m[1] + 1e-6, gap):
        at = canvas.pixels([(x, canvas.y_m[0])])[0]
        canvas.strip(np.round(at) + np.array([(0, 3), (0, 8)]) + 0.5, FAINT, 1)
        canvas.text((at[0], at[1] + 24), f"{x:g}", 14, GREY, align="center")
    for y in np.arange(math.ceil(canvas.y_m[0] / gap) * gap, canvas.y_m[1] + 1e-6, gap):
        at = canvas.pixels([(canvas.x_m[0], y)])[0]
        canvas.strip(np.round(at) + np.array([(-8, 0), (-3, 0)]) + 0.5, FAINT, 1)
        canvas.text((at[0] - 12, at[1] + 5), f"{y:g}", 14, GREY, align="right")
    right = canvas.pixels([(canvas.x_m[1], canvas.y_m[1])])[0]
    begin, y = (round(right[0] - gap * canvas.scale), round(right[1] - 14))
    canvas.strip(np.array([(begin, y), (round(right[0]), y)]) + 0.5, INK, 3)
    for x in (begin, round(right[0])):
        canvas.strip(np.array([(x, y - 5), (x, y + 5)]) + 0.5, INK, 2)
    canvas.text((begin - 10, y + 5), f"{gap} m", 16, INK, align="right")
