"""Many episodes at once: a grid of tanks, one vehicle in each, for a first page."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from uuvtai.closed_form import body_positions
from uuvtai.logs.canvas import FAILED, GOAL, INK, MOVER, PAPER, STATIC, Canvas, Color, bgr, method_inks
from uuvtai.logs.log_errors import LogError, checked_suffix
from uuvtai.logs.painting import body_outline, map_canvas, mixed, paint_walls, paint_water
from uuvtai.logs.recording import Recording, drawing, load_recording
from uuvtai.logs.video import FORMATS, HOLD_S, MOST_FRAMES, Progress, check_film, filmed

_MOST_LOGS = 144
_LEAST_PX = 60
"""of a tank's width: below it nothing can be seen"""
_GAP = 4
"""[px] around a tank"""
_SHAPE = 9 / 16
"""height by width that the film comes near to"""
_ARRIVED = bgr("#2b8a3e")


def overview(
    paths: Sequence[Path],
    out: Path,
    width_px: int | None = None,
    fps: float | None = None,
    speed: float = 1.0,
    progress: Progress | None = None,
) -> Path:
    """Render several logs as one film, each in a tank of its own; the other arguments as of ``video.video``.

    A tank whose episode is over stands still, framed green where the vehicle has arrived, else red. Raises
    LogError; the file appears whole or not at all.
    """
    out = Path(out)
    suffix = checked_suffix(out, tuple(FORMATS), "video")
    width_px, fps = width_px or FORMATS[suffix][0], fps or FORMATS[suffix][1]
    check_film(width_px, fps, speed)
    if len(paths) > _MOST_LOGS:
        raise LogError(f"uuv log video: {len(paths)} logs; give {_MOST_LOGS} at most")
    found = [load_recording(path, ("/pose",)) for path in paths]
    with drawing(Path(paths[0])):
        grid = _Grid(found, width_px)
    end = max(recording.duration_s for recording in found)
    if end * fps / speed > MOST_FRAMES:
        raise LogError(f"{paths[0]}: more than {MOST_FRAMES:,} frames; raise --speed or lower --fps")
    times = np.concatenate([np.arange(0.0, end, speed / fps), np.full(1 + round(HOLD_S * fps), end)])
    samples = [grid.frame(end * share) for share in (0.0, 0.5, 1.0)]
    return filmed(out, _frames(grid, times, progress), fps, samples, grid.inks)


def _frames(grid: _Grid, times: np.ndarray, progress: Progress | None) -> Iterator[np.ndarray]:
    for i, time_s in enumerate(times):
        yield grid.frame(float(time_s))
        if progress:
            progress(i + 1, len(times))


class _Grid:
    """Tanks beside and above each other."""

    def __init__(self, found: Sequence[Recording], width_px: int) -> None:
        """Raises LogError where a tank would be too small to be seen."""
        ratio = max(_ratio(recording.scenario["tank"]) for recording in found)
        across = max(1, min(len(found), round(math.sqrt(len(found) * ratio / _SHAPE))))
        tile = width_px // across
        if tile < _LEAST_PX:
            raise LogError(
                f"uuv log video: {across} tanks side by side in {width_px} pixels; give --width "
                f"{_LEAST_PX * across} or fewer logs"
            )
        inks = method_inks([recording.method for recording in found])
        self.inks: list[Color] = [*inks.values(), MOVER, GOAL, _ARRIVED, FAILED]
        self._tiles = [_Tank(recording, tile, inks[recording.method]) for recording in found]
        self._across, self._tile = across, tile
        self._height = max(tank.height_px for tank in self._tiles)
        rows = -(-len(found) // across)
        self._size = (width_px - width_px % 2, rows * self._height + (rows * self._height) % 2)

    def frame(self, time_s: float) -> np.ndarray:
        """Image (height, width, 3), blue green red."""
        image = np.full((self._size[1], self._size[0], 3), PAPER, np.uint8)
        for i, tank in enumerate(self._tiles):
            with drawing(tank.recording.path):
                drawn = tank.frame(time_s)
            row, column = divmod(i, self._across)
            top, left = row * self._height, column * self._tile
            part = image[top : top + drawn.shape[0], left : left + drawn.shape[1]]
            part[:] = drawn[: part.shape[0], : part.shape[1]]
        return image


def _ratio(tank: dict[str, Any]) -> float:
    return (tank["y_m"][1] - tank["y_m"][0]) / (tank["x_m"][1] - tank["x_m"][0])


class _Tank:
    """One episode; what rests is drawn once."""

    def __init__(self, recording: Recording, width_px: int, ink: Color) -> None:
        self.recording, self._ink = recording, ink
        tank = recording.scenario["tank"]
        self._canvas = map_canvas(tank, width_px, (_GAP, _GAP, _GAP, _GAP), Canvas)
        paint_water(self._canvas, tank)
        for body in recording.scenario["bodies"]:
            if body["path"] is None:
                self._canvas.area(body_outline(body, np.array(body["position"])), STATIC)
        paint_walls(self._canvas, tank)
        self._still = self._canvas.image.copy()
        self._track, self._times = recording.positions, np.array(recording["/pose"].times)

    @property
    def height_px(self) -> int:
        return self._canvas.size[1]

    def frame(self, time_s: float) -> np.ndarray:
        """The tank at a moment, or as it was left."""
        canvas, recording = self._canvas, self.recording
        at_s = min(time_s, recording.duration_s)
        canvas.image = self._still.copy()
        for body in recording.scenario["bodies"]:
            if body["path"] is not None:
                place = body_positions(body, np.array([at_s]))[0]
                canvas.area(body_outline(body, place), mixed(MOVER, PAPER, 0.75))
        i = max(int(np.searchsorted(self._times, at_s + 1e-9)) - 1, 0)
        canvas.line(self._track[: i + 1, :2], self._ink, 1)
        canvas.star(recording.scenario["goal"], max(4.0, 0.3 * canvas.scale), edge=INK)
        canvas.vehicle(self._track[i], self._ink)
        if time_s >= recording.duration_s:
            colour = _ARRIVED if recording.outcome == "success" else FAILED
            (left, top), (right, bottom) = canvas.area_pixels()
            cv2.rectangle(canvas.image, (left - 2, top - 2), (right + 1, bottom + 1), colour, 2)
        return canvas.image
