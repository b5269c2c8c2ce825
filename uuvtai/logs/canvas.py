"""Drawing in world coordinates with OpenCV: anti-aliased, with sub-pixel places, and text in a real font
where OpenCV has one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from uuvtai.report.colours import method_colours

Color = tuple[int, int, int]
"""blue, green, red"""

_SHIFT = 4
"""bits of sub-pixel precision"""


def bgr(code: str) -> Color:
    """A colour from '#rrggbb'."""
    red, green, blue = (int(code[i : i + 2], 16) for i in (1, 3, 5))
    return blue, green, red


PAPER, WATER, INK, GREY, FAINT = (
    bgr("#ffffff"),
    bgr("#eef5f9"),
    bgr("#1d2733"),
    bgr("#66727f"),
    bgr("#c9d2da"),
)
STATIC, DYNAMIC, GOAL, ROUTE, MOVER = (
    bgr("#262c38"),
    bgr("#e53946"),
    bgr("#f7b801"),
    bgr("#1f8fff"),
    bgr("#d9480f"),
)
FAILED = bgr("#c92a2a")


def method_inks(names: Sequence[str]) -> dict[str, Color]:
    """Colour of every method, the same as in the charts."""
    return {name: bgr(code) for name, code in method_colours(names).items()}


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
        """``size`` = (width, height); ``corner`` = pixel of the map area's upper left corner, which shows
        (x_m[0], y_m[1])."""
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
        """Polyline in pixels."""
        cv2.polylines(self.image, [_fixed(pixels)], closed, color, width, cv2.LINE_AA, _SHIFT)

    def dot(
        self, pixel: Sequence[float] | np.ndarray, radius_px: float, color: Color, width: int = -1
    ) -> None:
        """Circle in pixels; width -1 fills it."""
        at = _fixed(np.asarray([pixel]))[0]
        cv2.circle(
            self.image,
            (int(at[0]), int(at[1])),
            round(radius_px * (1 << _SHIFT)),
            color,
            width,
            cv2.LINE_AA,
            _SHIFT,
        )

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
        (left, top), (right, bottom) = self.area_pixels()
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
        return draw_text(self.image, place, text, size, color, bold, align)

    # ------------------------------------------------------------------------------------ what is drawn of it

    def area_pixels(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """((left, top), (right, bottom)) of the map area."""
        (left, top), (right, bottom) = (
            self.pixels([(self.x_m[0], self.y_m[1]), (self.x_m[1], self.y_m[0])]).round().astype(int)
        )
        return (int(left), int(top)), (int(right), int(bottom))

    def line(self, points: Any, color: Color, width: int = 2, closed: bool = False) -> None:
        """Polyline in the world."""
        if len(points) > 1:
            self.strip(self.pixels(points), color, width, closed)

    def dashes(self, points: Any, color: Color, width: int = 1, period_px: float = 9.0) -> None:
        """Dashed polyline in the world."""
        path = self.pixels(points)
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
        for begin in np.arange(0.0, along[-1], period_px):
            at = np.linspace(begin, min(begin + 0.55 * period_px, along[-1]), 4)
            self.strip(
                np.column_stack([np.interp(at, along, path[:, axis]) for axis in (0, 1)]), color, width
            )

    def area(self, points: Any, color: Color) -> None:
        """Filled polygon in the world."""
        self.filled(self.pixels(points), color)

    def area_between(self, outer: Any, inner: Any, color: Color) -> None:
        """What lies inside one polygon and outside another."""
        self.filled(self.pixels(outer), color, self.pixels(inner))

    def disc(self, center: Sequence[float], radius_px: float, color: Color, width: int = -1) -> None:
        """Circle around a world point; width -1 fills it."""
        self.dot(self.pixels([center])[0], radius_px, color, width)

    def star(self, center: Sequence[float], radius_px: float, fill: Color = GOAL, edge: Color = INK) -> None:
        """Five-pointed star."""
        pixels = self.pixels([center])[0] + star_shape(radius_px)
        self.filled(pixels, fill)
        self.strip(pixels, edge, 1, closed=True)

    def cross(self, center: Sequence[float], radius_px: float, color: Color) -> None:
        """An X with a white rim."""
        at = self.pixels([center])[0]
        for ink, width in ((PAPER, 7), (color, 4)):
            for sign in (-1, 1):
                self.strip(at + radius_px * np.array([[-1, -sign], [1, sign]]), ink, width)

    def vehicle(
        self, pose: Sequence[float], color: Color, length_m: float = 0.54, width_m: float = 0.34
    ) -> None:
        """The hull from above with its bow: at least 14 pixels long, so that it can be seen."""
        grow = max(1.0, 14.0 / (length_m * self.scale))
        outline = np.array(
            [[0.5, 0.0], [0.22, 0.5], [-0.42, 0.5], [-0.5, 0.36], [-0.5, -0.36], [-0.42, -0.5], [0.22, -0.5]]
        )
        shape = outline * np.array([length_m, width_m]) * grow
        c, s = math.cos(pose[3]), math.sin(pose[3])
        world = shape @ np.array([[c, s], [-s, c]]) + np.array(pose[:2])
        self.area(world, color)
        self.line(world, PAPER, 1, closed=True)


def draw_text(
    image: np.ndarray,
    place: tuple[float, float],
    text: str,
    size: int,
    color: Color,
    bold: bool,
    align: str = "left",
) -> int:
    """Text with its baseline at a pixel; gives its width [px]."""
    if not hasattr(cv2, "FontFace"):
        return _hershey_text(image, place, text, size, color, bold, align)
    face, weight = _face(), 650 if bold else 420
    frame = (image.shape[1], image.shape[0])
    width = cv2.getTextSize(frame, text, (0, 0), face, size, weight)[2]  # type: ignore[call-overload]
    x = place[0] - {"left": 0, "center": width / 2, "right": width}[align]
    corner = (round(x), round(place[1]))
    cv2.putText(image, text, corner, color, face, size, weight)  # type: ignore[call-overload]
    return int(width)


_faces: list[Any] = []


def _face() -> Any:
    if not _faces:
        _faces.append(cv2.FontFace("sans"))  # type: ignore[attr-defined]
    return _faces[0]


def _hershey_text(
    image: np.ndarray, place: tuple[float, float], text: str, size: int, color: Color, bold: bool, align: str
) -> int:
    """OpenCV 4 has stroke fonts only, with ASCII only."""
    plain = text.replace("·", "-").replace("–", "-").encode("ascii", "replace").decode()
    scale, thickness = size / 28.0, 2 if bold and size >= 20 else 1
    (width, _), _ = cv2.getTextSize(plain, cv2.FONT_HERSHEY_DUPLEX, scale, thickness)
    x = place[0] - {"left": 0, "center": width / 2, "right": width}[align]
    cv2.putText(
        image,
        plain,
        (round(x), round(place[1])),
        cv2.FONT_HERSHEY_DUPLEX,
        scale,
        color,
        thickness,
        cv2.LINE_AA,
    )
    return int(width)


def star_shape(radius: float) -> np.ndarray:
    """(10, 2) corners of a star around the origin, one point up (in pixels)."""
    angles = -math.pi / 2 + np.arange(10) * math.pi / 5
    reach = np.where(np.arange(10) % 2 == 0, radius, 0.42 * radius)
    return np.column_stack([reach * np.cos(angles), reach * np.sin(angles)])


def _fixed(pixels: np.ndarray) -> np.ndarray:
    return np.round((np.asarray(pixels) - 0.5) * (1 << _SHIFT)).astype(np.int32)
