"""One picture per episode: what the vehicle mapped, every agent's trajectory, goal and truth."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from uuvtai.common.enums import COLLIDED
from uuvtai.common.files import refusing
from uuvtai.logs import drawing
from uuvtai.logs.encode import LogError, checked_suffix
from uuvtai.logs.run_folder import write_atomic

_LEFT, _RIGHT, _TOP, _BOTTOM = 62, 44, 96, 62
_ROW = 30  # [px] per line of the legend


def picture(
    paths: Path | Sequence[Path],
    out: Path,
    clearance: bool = False,
    obstacles: bool = True,
    width_px: int = 1600,
    remark: str = "",
    agents: Sequence[str] = (),
) -> Path:
    """Draw logs of the same episode into one PNG: trajectories overlaid, a colour per agent.

    ``clearance`` shows the distance to mapped obstacles as colours; ``obstacles`` the true obstacles and
    their paths as thin lines; ``remark`` stands beside the title; ``agents``: all that are compared with each
    other, in order, so that each keeps its colour. Raises LogError; the file appears whole or not at all.
    """
    out = Path(out)
    checked_suffix(out, (".png",), "picture")
    if not 320 <= width_px <= 3840:
        raise LogError(f"--width {width_px}: must be from 320 to 3840")
    found = [Path(paths)] if isinstance(paths, str | Path) else [Path(path) for path in paths]
    if not found:
        raise LogError("uuv log render: give at least one log")
    recordings = [drawing.load_recording(path, drawing.PICTURE_TOPICS) for path in found]
    check_same_episode(recordings)
    with drawing.drawing(found[0]):
        image = paint_picture(recordings, clearance, obstacles, width_px, remark, agents).image
    return save_image(image, out)


def check_same_episode(recordings: list[drawing.Recording]) -> None:
    """Raises LogError where trajectories would be overlaid that do not belong together."""
    names = ("world", "seed", "episode")
    first = recordings[0]
    for other in recordings[1:]:
        if any(first.scenario.get(name) != other.scenario.get(name) for name in names):
            raise LogError(
                f"{other.path}: is another episode than {first.path}; give logs of one episode, or draw one "
                "picture each"
            )


def save_image(image: np.ndarray, out: Path) -> Path:
    """Write an image (height, width, 3), blue green red, as PNG, atomically. Raises LogError."""
    with refusing(LogError, f"{out}: cannot write the picture", "choose another place with --out FILE"):
        write_atomic(out, cv2.imencode(".png", image)[1].tobytes())
    return out


def paint_picture(
    recordings: list[drawing.Recording],
    clearance: bool = False,
    obstacles: bool = True,
    width_px: int = 1600,
    remark: str = "",
    agents: Sequence[str] = (),
) -> drawing.Canvas:
    """The picture on a canvas; the other arguments as of ``picture``."""
    tank = recordings[0].scenario["tank"]
    side, legend = 92 if clearance else 0, _BOTTOM + _ROW * max(len(recordings), 3)
    canvas = drawing.map_canvas(tank, width_px, (_LEFT, _RIGHT + side, _TOP, legend))
    inks = _inks(recordings, agents)
    drawing.paint_water(canvas, tank)
    if clearance:
        _paint_clearance(canvas, recordings, side)
    _paint_occupancy(canvas, recordings[0], trace=not clearance)
    if obstacles:
        drawing.paint_truth(canvas, recordings[0].scenario, recordings[0].duration_s)  # as old as the map
    drawing.paint_walls(canvas, tank)
    _paint_trajectories(canvas, recordings, inks)
    _paint_ends(canvas, recordings, inks)
    _paint_frame(canvas, recordings, inks, not clearance, remark)
    return canvas


def _inks(recordings: list[drawing.Recording], agents: Sequence[str]) -> list[drawing.Color]:
    """Colour of each recording: its agent's; several logs of one agent are told apart by their place."""
    names = [recording.agent for recording in recordings]
    if len(set(names)) < len(names):
        names = [f"{i} {name}" for i, name in enumerate(names)]
    found = drawing.agent_inks([*agents, *names])
    return [found[name] for name in names]


# ------------------------------------------------------------------------------------------------------ parts


def _paint_occupancy(canvas: drawing.Canvas, recording: drawing.Recording, trace: bool) -> None:
    """The last map; ``trace`` adds in pink where anything moving was ever mapped."""
    static, dynamic = recording["/map/static"], recording["/map/dynamic"]
    if static.values and dynamic.values:
        ever = functools.reduce(np.maximum, (layer.values for layer in dynamic.values)) if trace else None
        drawing.paint_layers(canvas, static.values[-1], dynamic.values[-1], ever)


def _paint_clearance(canvas: drawing.Canvas, recordings: list[drawing.Recording], side: int) -> None:
    series = recordings[0]["/map/clearance"]
    if not series.values:
        return
    layer = series.values[-1]
    top = max(float(layer.values.max()), 1e-6)
    colors = cv2.applyColorMap(
        (np.clip(layer.values / top, 0, 1) * 255).astype(np.uint8), cv2.COLORMAP_VIRIDIS
    )
    canvas.cells(colors, np.full(layer.values.shape, 0.85), layer.origin_m, layer.cell_m)
    _paint_color_bar(canvas, top)


def _paint_color_bar(canvas: drawing.Canvas, top_m: float) -> None:
    (x, y0), (_, y1) = (
        canvas.pixels([(canvas.x_m[1], canvas.y_m[1]), (canvas.x_m[1], canvas.y_m[0])]).round().astype(int)
    )
    ramp = cv2.applyColorMap(np.linspace(255, 0, y1 - y0).astype(np.uint8)[:, None], cv2.COLORMAP_VIRIDIS)
    canvas.paste((x + 26, y0), np.repeat(ramp, 18, axis=1))
    canvas.strip(
        np.array([(x + 26, y0), (x + 44, y0), (x + 44, y1), (x + 26, y1)]), drawing.GREY, 1, closed=True
    )
    for share in (0.0, 0.5, 1.0):
        place = x + 50, y1 - share * (y1 - y0) + (4 if share < 1 else 14)
        canvas.text(place, f"{share * top_m:.1f} m", 15, drawing.GREY)
    canvas.text((x + 26, y0 - 12), "clearance", 15, drawing.GREY)


def _paint_trajectories(
    canvas: drawing.Canvas, recordings: list[drawing.Recording], inks: list[drawing.Color]
) -> None:
    """The first agent on top; those below a little wider each, so that all show where they go one way."""
    wide = [3 + 3 * min(i, 3) for i in range(len(recordings))]
    for recording, width in zip(recordings, wide, strict=True):
        canvas.line(recording.positions[:, :2], drawing.PAPER, width + 3)
    for i in reversed(range(len(recordings))):
        canvas.line(recordings[i].positions[:, :2], inks[i], wide[i])


def _paint_ends(
    canvas: drawing.Canvas, recordings: list[drawing.Recording], inks: list[drawing.Color]
) -> None:
    scenario = recordings[0].scenario
    goal, start = scenario["goal"], scenario["start"]
    canvas.dashes(np.array(goal[:2]) + scenario["goal_radius_m"] * drawing.ring(90), drawing.INK, 1)
    canvas.disc(start, 8, drawing.PAPER)
    canvas.disc(start, 7, drawing.INK, 2)
    for i in reversed(range(len(recordings))):
        canvas.vehicle(recordings[i].positions[-1], inks[i])
    canvas.star(goal, 17)
    for i, recording in enumerate(recordings):
        if recording.outcome in COLLIDED:
            canvas.cross(recording.positions[-1][:2], 9, inks[i])


def _paint_frame(
    canvas: drawing.Canvas,
    recordings: list[drawing.Recording],
    inks: list[drawing.Color],
    trace: bool,
    remark: str,
) -> None:
    scenario = recordings[0].scenario
    title = f"{scenario['world']} · seed {scenario['seed']} · episode {scenario['episode']}"
    width = canvas.text((_LEFT - 2, 40), title, 27, drawing.INK, bold=True)
    canvas.text((_LEFT - 2 + width + 24, 40), remark, 19, drawing.FAILED)
    moving = f", {scenario['D']} dynamic at {scenario['v_m_s']:g} m/s" if scenario["D"] else ""
    canvas.text(
        (_LEFT - 2, 70),
        f"{scenario['S']} static obstacles{moving}; map and obstacles when {recordings[0].agent} ends",
        18,
        drawing.GREY,
    )
    drawing.paint_ruler(canvas)
    base = canvas.pixels([(canvas.x_m[0], canvas.y_m[0])])[0][1] + 62
    for i, recording in enumerate(recordings):
        _legend_row(canvas, base + i * _ROW, recording, inks[i])
    _legend_symbols(canvas, base, trace)


def _legend_row(canvas: drawing.Canvas, y: float, recording: drawing.Recording, color: drawing.Color) -> None:
    canvas.filled(np.array([(_LEFT, y - 8), (_LEFT + 34, y - 8), (_LEFT + 34, y - 3), (_LEFT, y - 3)]), color)
    width = canvas.text((_LEFT + 46, y), recording.agent, 19, drawing.INK, bold=True)
    closest = "" if recording.min_clearance_m is None else f", closest {recording.min_clearance_m:.2f} m"
    summary = f"{recording.outcome_text} after {recording.duration_s:.1f} s{closest}"
    canvas.text((_LEFT + 46 + max(width, 90) + 14, y), summary, 18, drawing.GREY)


def _legend_symbols(canvas: drawing.Canvas, base: float, trace: bool) -> None:
    x, width = canvas.size[0] - _RIGHT - 430, 15
    swatches = [(drawing.STATIC, "static occupancy"), (drawing.DYNAMIC, "dynamic occupancy")]
    if trace:
        swatches.append((drawing.mixed(drawing.DYNAMIC, drawing.WATER, 0.22), "dynamic earlier"))
    for row, (color, label) in enumerate(swatches):
        y = base + row * _ROW
        canvas.filled(np.array([(x, y - 13), (x + width, y - 13), (x + width, y + 2), (x, y + 2)]), color)
        canvas.text((x + 26, y), label, 17, drawing.GREY)
    left = x + 210
    world = (np.array([left + 8, base - 6]) - np.array(canvas.corner)) / canvas.scale
    goal = (canvas.x_m[0] + world[0], canvas.y_m[1] - world[1])
    canvas.star(goal, 11)
    canvas.text((left + 26, base), "goal", 17, drawing.GREY)
    down = _ROW / canvas.scale
    canvas.disc((goal[0], goal[1] - down), 6, drawing.INK, 2)
    canvas.text((left + 26, base + _ROW), "start", 17, drawing.GREY)
    ring = np.array([goal[0], goal[1] - 2 * down]) + 7 / canvas.scale * drawing.ring(32)
    canvas.line(ring, drawing.GREY, 1, closed=True)
    canvas.line(ring + np.array([18 / canvas.scale, 0]), drawing.MOVER, 1, closed=True)
    canvas.text((left + 44, base + 2 * _ROW), "true, static / dynamic", 17, drawing.GREY)
