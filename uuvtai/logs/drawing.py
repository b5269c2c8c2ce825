"""Drawing in world coordinates with OpenCV: anti-aliased, sub-pixel places, text in a real font if any."""

from __future__ import annotations

import bisect
import contextlib
import functools
import itertools
import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from uuvtai.common.colours import agent_colours
from uuvtai.common.obstacle_motion import obstacle_positions
from uuvtai.logs.encode import LogError, unlike_schema
from uuvtai.logs.reader import LogHead, read_head, read_messages
from uuvtai.logs.topics import TOPICS
from uuvtai.logs.topics.perception import Layer

Color = tuple[int, int, int]  # blue, green, red

_HULL_M, _HULL_RADIUS_M = (0.54, 0.34), 0.17  # of the vehicle from above: length, width; half its height
_SHIFT = 4  # bits of sub-pixel precision


def bgr(code: str) -> Color:
    red, green, blue = (int(code[i : i + 2], 16) for i in (1, 3, 5))
    return blue, green, red


PAPER, WATER, INK, GREY, FAINT = map(bgr, ("#ffffff", "#eef5f9", "#1d2733", "#66727f", "#c9d2da"))
STATIC, DYNAMIC, GOAL, ROUTE, MOVER = map(bgr, ("#262c38", "#e53946", "#f7b801", "#1f8fff", "#d9480f"))
FAILED, ECHO = bgr("#c92a2a"), bgr("#0b7a75")
TRIGGER_COLORS = {
    "initial": GREY,
    "stuck": bgr("#ae3ec9"),
    "safety": bgr("#e8590c"),
    "intersection": bgr("#1971c2"),
}


def agent_inks(names: Sequence[str]) -> dict[str, Color]:
    """Colour of every agent, the same as in the charts."""
    return {name: bgr(code) for name, code in agent_colours(names).items()}


class Canvas:
    """An image with a map area in which one metre is ``scale`` pixels, y up."""

    def __init__(
        self,
        size: tuple[int, int],
        corner: tuple[float, float],
        scale: float,
        x_m: Sequence[float],
        y_m: Sequence[float],
    ) -> None:
        """``size`` = (width, height); ``corner``: pixel of the map's corner that shows (x_m[0], y_m[1])."""
        self.size = size
        self.corner, self.scale, self.x_m, self.y_m = corner, scale, tuple(x_m), tuple(y_m)
        self.image = np.full((size[1], size[0], 3), PAPER, np.uint8)

    def pixels(self, points: Any) -> np.ndarray:
        """World (n, 2 or more) to pixels (n, 2), float; only x and y count."""
        flat = np.atleast_2d(np.asarray(points, float))
        return np.column_stack(
            [
                self.corner[0] + (flat[:, 0] - self.x_m[0]) * self.scale,
                self.corner[1] + (self.y_m[1] - flat[:, 1]) * self.scale,
            ]
        )

    def strip(self, pixels: Any, color: Color, width: int = 2, closed: bool = False) -> None:
        cv2.polylines(self.image, [_fixed(pixels)], closed, color, width, cv2.LINE_AA, _SHIFT)

    def dot(
        self, pixel: Sequence[float] | np.ndarray, radius_px: float, color: Color, width: int = -1
    ) -> None:
        """Circle in pixels; width -1 fills it."""
        x, y = _fixed(np.asarray([pixel]))[0].tolist()
        radius = round(radius_px * (1 << _SHIFT))
        cv2.circle(self.image, (x, y), radius, color, width, cv2.LINE_AA, _SHIFT)

    def filled(self, pixels: np.ndarray, color: Color, hole: np.ndarray | None = None) -> None:
        """Filled polygon in pixels, but for the polygon ``hole`` within."""
        rings = [_fixed(ring) for ring in (pixels, hole) if ring is not None]
        cv2.fillPoly(self.image, rings, color, cv2.LINE_AA, _SHIFT)

    def paste(self, corner: tuple[int, int], colors: np.ndarray) -> None:
        """An image (height, width, 3), blue green red, with its upper left corner at a pixel."""
        height, width = colors.shape[:2]
        self.image[corner[1] : corner[1] + height, corner[0] : corner[0] + width] = colors

    def cells(
        self, colors: np.ndarray, opacity: np.ndarray, origin_m: Sequence[float], cell_m: float
    ) -> None:
        """Lay a grid of cells (row, col[, 3]) over the map area; only what lies inside the area is drawn."""
        rows, cols = opacity.shape
        corners = self.pixels([(self.x_m[0], self.y_m[1]), (self.x_m[1], self.y_m[0])])
        left, top, right, bottom = corners.round().astype(int).ravel().tolist()
        x = self.x_m[0] + (np.arange(left, right) + 0.5 - self.corner[0]) / self.scale
        y = self.y_m[1] - (np.arange(top, bottom) + 0.5 - self.corner[1]) / self.scale
        col = np.clip(np.floor((x - origin_m[0]) / cell_m).astype(int), 0, cols - 1)
        row = np.clip(np.floor((y - origin_m[1]) / cell_m).astype(int), 0, rows - 1)
        share = opacity[row][:, col][..., None].astype(np.float32)
        ink = np.broadcast_to(np.asarray(colors, np.float32), (rows, cols, 3))[row][:, col]
        part = self.image[top:bottom, left:right]
        part[:] = (part * (1 - share) + ink * share + 0.5).astype(np.uint8)

    def text(
        self,
        place: tuple[float, float],
        text: str,
        size: int = 16,
        color: Color = INK,
        bold: bool = False,
        align: str = "left",
    ) -> int:
        """Text with its baseline at a pixel; gives its width [px]."""
        ink: tuple[Any, ...]
        if hasattr(cv2, "FontFace"):
            face, weight = _face(), 650 if bold else 420
            width = cv2.getTextSize(self.size, text, (0, 0), face, size, weight)[2]
            ink = (color, face, size, weight)
        else:  # OpenCV 4 has stroke fonts only, with ASCII only
            text = text.replace("·", "-").replace("–", "-").encode("ascii", "replace").decode()
            font, scale, thickness = cv2.FONT_HERSHEY_DUPLEX, size / 28.0, 2 if bold and size >= 20 else 1
            (width, _), _ = cv2.getTextSize(text, font, scale, thickness)
            ink = (font, scale, color, thickness, cv2.LINE_AA)
        x = place[0] - {"left": 0, "center": width / 2, "right": width}[align]
        cv2.putText(self.image, text, (round(x), round(place[1])), *ink)
        return int(width)

    # ------------------------------------------------------------------------------------ what is drawn of it

    def line(self, points: Any, color: Color, width: int = 2, closed: bool = False) -> None:
        if len(points) > 1:
            self.strip(self.pixels(points), color, width, closed)

    def dashes(self, points: Any, color: Color, width: int = 1, period_px: float = 9.0) -> None:
        path = self.pixels(points)
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
        for begin in np.arange(0.0, along[-1], period_px):
            at = np.linspace(begin, min(begin + 0.55 * period_px, along[-1]), 4)
            self.strip(
                np.column_stack([np.interp(at, along, path[:, axis]) for axis in (0, 1)]), color, width
            )

    def area(self, points: Any, color: Color) -> None:
        self.filled(self.pixels(points), color)

    def disc(self, center: Sequence[float], radius_px: float, color: Color, width: int = -1) -> None:
        """Circle around a world point; width -1 fills it."""
        self.dot(self.pixels([center])[0], radius_px, color, width)

    def star(self, center: Sequence[float], radius_px: float) -> None:
        angles = -math.pi / 2 + np.arange(10) * math.pi / 5  # one point up
        reach = np.where(np.arange(10) % 2 == 0, radius_px, 0.42 * radius_px)
        pixels = self.pixels([center])[0] + reach[:, None] * towards(angles)
        self.filled(pixels, GOAL)
        self.strip(pixels, INK, 1, closed=True)

    def cross(self, center: Sequence[float], radius_px: float, color: Color) -> None:
        """An X with a white rim."""
        at = self.pixels([center])[0]
        for ink, width in ((PAPER, 7), (color, 4)):
            for sign in (-1, 1):
                self.strip(at + radius_px * np.array([[-1, -sign], [1, sign]]), ink, width)

    def vehicle(self, pose: Sequence[float], color: Color) -> None:
        """The hull from above with its bow: at least 14 pixels long, so that it can be seen."""
        grow = max(1.0, 14.0 / (_HULL_M[0] * self.scale))
        outline = np.array(
            [[0.5, 0.0], [0.22, 0.5], [-0.42, 0.5], [-0.5, 0.36], [-0.5, -0.36], [-0.42, -0.5], [0.22, -0.5]]
        )
        shape = outline * np.array(_HULL_M) * grow
        c, s = math.cos(pose[3]), math.sin(pose[3])
        world = shape @ np.array([[c, s], [-s, c]]) + np.array(pose[:2])
        self.area(world, color)
        self.line(world, PAPER, 1, closed=True)


@functools.cache
def _face() -> Any:
    return cv2.FontFace("sans")  # type: ignore[attr-defined]


def _fixed(pixels: np.ndarray) -> np.ndarray:
    return np.round((np.asarray(pixels) - 0.5) * (1 << _SHIFT)).astype(np.int32)


# ---- What pictures and videos have in common: the tank, maps, true obstacles, ruler, in world coordinates.

_MAX_MAP = 1000  # [px] greatest height of the map


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
    (x0, x1), (y0, y1) = tank["x_m"], tank["y_m"]
    if tank["shape"] == "circle":
        return np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)]) + tank["radius_m"] * ring(181)[:-1]
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])


def paint_water(canvas: Canvas, tank: dict[str, Any]) -> None:
    canvas.area(tank_outline(tank), WATER)


def paint_walls(canvas: Canvas, tank: dict[str, Any]) -> None:
    """The tank's rim; of a round tank also the paper around it, which cells may have covered."""
    if tank["shape"] == "circle":
        (x0, x1), (y0, y1) = tank["x_m"], tank["y_m"]
        box = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
        canvas.filled(canvas.pixels(box), PAPER, canvas.pixels(tank_outline(tank)))
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
    """True obstacles as thin outlines where they are at this time, and the paths of those that move.

    With the vehicle's height, obstacles that pass wholly above or below its hull are dashed: from above they
    seem to be in its way.
    """
    for obstacle in scenario["obstacles"]:
        at = obstacle_positions(obstacle, np.array([time_s]))[0]
        color = GREY
        if obstacle["path"] is not None:
            color = MOVER
            period = obstacle["path"]["length_m"] / max(obstacle["path"]["speed_m_s"], 1e-6)
            canvas.dashes(
                obstacle_positions(obstacle, np.linspace(0, period, 181))[:, :2], mixed(MOVER, WATER, 0.45), 1
            )
        outline = obstacle_outline(obstacle, at)
        if own_z_m is not None and abs(at[2] - own_z_m) > obstacle["size"][2] + _HULL_RADIUS_M:
            canvas.dashes(np.vstack([outline, outline[:1]]), color, 1)
        else:
            canvas.line(outline, color, 1, closed=True)


def obstacle_outline(obstacle: dict[str, Any], at: np.ndarray) -> np.ndarray:
    """(n, 2) horizontal outline of an obstacle at a place."""
    if obstacle["kind"] == "box":
        a, b, _ = obstacle["size"]
        c, s = math.cos(obstacle["yaw"]), math.sin(obstacle["yaw"])
        return np.array([(a, b), (-a, b), (-a, -b), (a, -b)]) @ np.array([[c, s], [-s, c]]) + at[:2]
    return at[:2] + obstacle["size"][0] * ring(49)[:-1]


def ring(corners: int) -> np.ndarray:
    """(corners, 2) unit circle, closed."""
    return towards(np.linspace(0, 2 * np.pi, corners))


def towards(angles: np.ndarray) -> np.ndarray:
    """(n, 2) unit vectors."""
    return np.column_stack([np.cos(angles), np.sin(angles)])


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


# ---- A log as arrays, ready to be drawn.


@dataclass
class Series:
    """Values by time, looked up as of a moment."""

    times: list[float] = field(default_factory=list)
    values: list[Any] = field(default_factory=list)

    def add(self, time_s: float, value: Any) -> None:
        self.times.append(time_s)
        self.values.append(value)

    def at(self, time_s: float) -> Any | None:
        """Newest value at this time, None before the first."""
        i = bisect.bisect_right(self.times, time_s + 1e-9)
        return self.values[i - 1] if i else None

    def until(self, time_s: float) -> Iterator[Any]:
        """Values up to this time, the newest first."""
        for i in reversed(range(bisect.bisect_right(self.times, time_s + 1e-9))):
            yield self.values[i]


@dataclass
class Recording:
    """What is drawn of an episode."""

    path: Path
    head: LogHead
    scenario: dict[str, Any]
    series: dict[str, Series] = field(default_factory=lambda: defaultdict(Series))
    """what the table of topics reads of each topic's messages"""

    def __getitem__(self, topic: str) -> Series:
        return self.series[topic]

    @property
    def agent(self) -> str:
        return self.head.metadata.get("uuv.run", {}).get("agent", "?")

    @property
    def outcome(self) -> str:
        return self.head.metadata.get("uuv.result", {}).get("outcome", "cut off")

    @property
    def outcome_text(self) -> str:
        return OUTCOME_NAMES.get(self.outcome, self.outcome.replace("_", " "))

    @property
    def duration_s(self) -> float:
        return self["/pose"].times[-1]

    @property
    def positions(self) -> np.ndarray:
        """(n, 4) x, y, z, yaw at every control step."""
        return np.array(self["/pose"].values)

    def echoes(self, time_s: float) -> np.ndarray:
        """(n, 2) [m] returns of the newest scan, from where it was taken; of a mechanical sonar those of
        ``_ECHO_BEAMS`` beams."""
        found, beams = [np.empty((0, 2))], 0
        for ranges, away, hit, ping_s in self["/sonar/scan"].until(time_s):
            x, y, _, yaw = self["/pose"].at(ping_s) or self["/pose"].values[0]
            found.append((x, y) + ranges[hit, None] * towards(yaw + away[hit]))
            beams += len(ranges)
            if beams >= _ECHO_BEAMS:
                break
        return np.concatenate(found)

    @property
    def min_clearance_m(self) -> float | None:
        values = [] if self.outcome_text == REPLAYED else self["/safety"].values  # nobody knows the truth
        return min((value[0] for value in values), default=None)


_ECHO_BEAMS = 64  # A scan of fewer beams is shown together with those before it.
OUTCOME_NAMES = {"ttc": "TTC stop", "out_of_tank": "out of the tank"}
REPLAYED = "replayed"  # outcome of a recording: there is none
_MAX_DURATION_S, _MAX_EXTENT_M, _FARTHEST_M, _MAX_OBSTACLES = 3600.0, 1000.0, 1e4, 1000
"""what is drawn must fit a picture and a video that somebody waits for"""
_MAX_NUMBERS = 100_000  # of a scenario: corners of paths are drawn in every frame
_MAX_ARRAYS, _OVERHEAD = 384 << 20, 200  # [bytes] drawn together, and what a message takes beyond its arrays
_READERS = {topic.name: topic.read for topic in TOPICS if topic.read is not None}
VIDEO_TOPICS = tuple(_READERS)
PICTURE_TOPICS = tuple(topic.name for topic in TOPICS if topic.in_picture)


def load_recording(path: Path, topics: tuple[str, ...] = VIDEO_TOPICS) -> Recording:
    """Read a log. Raises LogError, also for a log without poses."""
    path = Path(path)
    head = read_head(path)
    found = Recording(path, head, head.scenario)
    _check_scenario(path, found.scenario)
    size = 0
    with unlike_schema(path):
        for message in read_messages(path, topics):
            value = _READERS[message.topic](message.data)
            found[message.topic].add(message.time_s, value)
            size += _taken(value) + _OVERHEAD
            if size > _MAX_ARRAYS:
                raise LogError(
                    f"{path}: holds more than {_MAX_ARRAYS >> 20} MiB to draw; no episode of ours does"
                )
    if not found["/pose"].times:
        raise LogError(
            f"{path}: the log has no messages on /pose, so there is nothing to draw; see uuv log info {path}"
        )
    if not found.duration_s <= _MAX_DURATION_S:
        raise LogError(
            f"{path}: claims to last {found.duration_s:g} s; no episode is longer than {_MAX_DURATION_S:g} s"
        )
    return found


@contextlib.contextmanager
def drawing(path: Path) -> Iterator[None]:
    """Turn all that a scenario or a message unlike ours can raise while it is drawn into a LogError."""
    try:
        yield
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, ArithmeticError, cv2.error) as error:
        raise LogError(
            f"{path}: cannot be drawn ({error!r}); give a log that uuv eval --record wrote"
        ) from None


def _check_scenario(path: Path, scenario: Any) -> None:
    """Raise LogError for a tank or obstacles that cannot be drawn: what is drawn grows with their extent."""
    try:
        tank, obstacles = scenario["tank"], scenario["obstacles"]
        extents = [float(tank[axis][1]) - float(tank[axis][0]) for axis in ("x_m", "y_m")]
        if not all(0 < extent <= _MAX_EXTENT_M for extent in extents):
            raise ValueError(f"a tank of {extents[0]:g} x {extents[1]:g} m")
        all_numbers = _numbers([tank, obstacles, scenario["goal"], scenario["start"]])
        numbers = list(itertools.islice(all_numbers, _MAX_NUMBERS + 1))
        is_near = all(abs(number) <= _FARTHEST_M for number in numbers)
        if not is_near or len(numbers) > _MAX_NUMBERS or len(obstacles) > _MAX_OBSTACLES:
            raise ValueError("obstacles beyond all bounds")
    except (KeyError, TypeError, ValueError, IndexError, OverflowError, RecursionError) as error:
        raise LogError(
            f"{path}: its scenario.json cannot be drawn ({error!r}); give a log that uuv eval --record wrote"
        ) from None


def _numbers(value: Any) -> Iterator[float]:
    """Every number within."""
    if isinstance(value, int | float):
        yield value
    elif isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from _numbers(inner)


def _taken(value: Any) -> int:
    """Bytes of the arrays that a message's value holds."""
    parts = value if isinstance(value, tuple) else (value,)
    return sum(part.nbytes for part in parts if isinstance(part, np.ndarray | Layer))
