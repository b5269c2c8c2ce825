"""The canvas of PDF and SVG: the shapes of ``Canvas`` as paths and text, maps as embedded images. Imports
matplotlib."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.patches import Circle, PathPatch, Rectangle
from matplotlib.path import Path as Shape
from matplotlib.textpath import TextToPath

from uuvtai.logs.canvas import INK, PAPER, Canvas, Color

_DPI = 100
_POINTS = 72 / _DPI
"""points per pixel"""
_TEXT = 0.86
"""DejaVu Sans beside the font of OpenCV at the same size: as wide at this share"""
_WIDER = 1.7
"""[px]"""
_STYLE: dict[str, Any] = {
    "text.parse_math": False,  # a name with dollars is a name
    "text.usetex": False,
    "font.family": "DejaVu Sans",  # comes with matplotlib
    "svg.fonttype": "path",  # looks the same where that font is missing
    "pdf.fonttype": 42,  # text that can be searched and edited
    "svg.hashsalt": "uuvtai",  # the same picture is the same file
    "image.composite_image": False,  # each layer in its own cells
    "path.simplify": False,
}


class VectorCanvas(Canvas):
    """A canvas whose sheet is a matplotlib figure, a pixel a unit."""

    def begin(self) -> None:
        with _style():
            self._figure = Figure(
                figsize=(self.size[0] / _DPI, self.size[1] / _DPI), dpi=_DPI, facecolor=_code(PAPER)
            )
            self._axes = self._figure.add_axes((0.0, 0.0, 1.0, 1.0))
            self._axes.set_axis_off()
            self._axes.set(xlim=(0, self.size[0]), ylim=(self.size[1], 0))
        self._layer = 0

    def document(self, kind: str) -> bytes:
        """What was drawn as 'pdf' or 'svg'."""
        file = io.BytesIO()
        dates = {"CreationDate": None} if kind == "pdf" else {"Date": None}
        with _style():
            self._figure.savefig(file, format=kind, metadata={"Creator": "uuvtai", **dates})
        return file.getvalue()

    def strip(self, pixels: Any, color: Color, width: int = 2, closed: bool = False) -> None:
        at = np.asarray(pixels, float)
        self._add(
            Shape(np.vstack([at, at[:1]]) if closed else at, closed=closed),
            edgecolor=_code(color),
            fill=False,
            **_pen(width),
        )

    def dot(
        self, pixel: Sequence[float] | np.ndarray, radius_px: float, color: Color, width: int = -1
    ) -> None:
        look: dict[str, Any] = (
            {"facecolor": _code(color), "edgecolor": "none"}
            if width < 0
            else {"edgecolor": _code(color), "fill": False, **_pen(width)}
        )
        self._axes.add_patch(
            Circle((float(pixel[0]), float(pixel[1])), radius_px, zorder=self._above(), **look)
        )

    def filled(self, pixels: np.ndarray, color: Color, hole: np.ndarray | None = None) -> None:
        rings = [pixels] if hole is None else [_turning(pixels, 1), _turning(hole, -1)]
        shape = Shape.make_compound_path(*(Shape(np.vstack([ring, ring[:1]]), closed=True) for ring in rings))
        self._add(shape, facecolor=_code(color), edgecolor="none")

    def paste(self, corner: tuple[int, int], colors: np.ndarray) -> None:
        height, width = colors.shape[:2]
        extent = (corner[0], corner[0] + width, corner[1] + height, corner[1])
        self._axes.imshow(
            colors[..., ::-1], extent=extent, interpolation="none", aspect="auto", zorder=self._above()
        )
        self._keep_view()

    def cells(
        self, colors: np.ndarray, opacity: np.ndarray, origin_m: Sequence[float], cell_m: float
    ) -> None:
        rows, cols = opacity.shape
        end = (origin_m[0] + cols * cell_m, origin_m[1] + rows * cell_m)
        (left, bottom), (right, top) = self.pixels([origin_m[:2], end])
        ink = np.broadcast_to(np.asarray(colors, float), (rows, cols, 3))[..., ::-1] / 255.0
        image = self._axes.imshow(
            np.dstack([ink, np.clip(opacity, 0.0, 1.0)]), extent=(left, right, bottom, top), origin="lower",
            interpolation="none",
            aspect="auto", zorder=self._above(),
        )  # fmt: skip
        (x0, y0), (x1, y1) = self.area_pixels()
        image.set_clip_path(Rectangle((x0, y0), x1 - x0, y1 - y0, transform=self._axes.transData))
        self._keep_view()

    def text(
        self,
        place: tuple[float, float],
        text: str,
        size: int = 16,
        color: Color = INK,
        bold: bool = False,
        align: str = "left",
    ) -> int:
        with _style():
            font = FontProperties(
                family="DejaVu Sans", weight="bold" if bold else "normal", size=_TEXT * size * _POINTS
            )
            self._axes.text(
                place[0],
                place[1],
                text,
                color=_code(color),
                fontproperties=font,
                ha=align,
                va="baseline",
                zorder=self._above(),
            )
            width, _, _ = TextToPath().get_text_width_height_descent(text, font, ismath=False)
        return round(width / _POINTS)

    def _add(self, shape: Shape, **look: Any) -> None:
        self._axes.add_patch(PathPatch(shape, zorder=self._above(), **look))

    def _above(self) -> int:
        """Each thing lies on all that was drawn before."""
        self._layer += 1
        return self._layer

    def _keep_view(self) -> None:
        """An image moves the limits of its axes."""
        self._axes.set(xlim=(0, self.size[0]), ylim=(self.size[1], 0))


def _style() -> Any:
    # the defaults first: a reader's own matplotlibrc does not change a picture
    settings: Any = {**matplotlib.rcParamsDefault, "backend": "agg", **_STYLE}
    return matplotlib.rc_context(settings)


def _pen(width: int) -> dict[str, Any]:
    """OpenCV draws smooth lines wider than it is told, but for the thinnest."""
    shown = width if width == 1 else width + _WIDER
    return {"linewidth": shown * _POINTS, "capstyle": "round", "joinstyle": "round"}


def _code(color: Color) -> str:
    blue, green, red = color
    return f"#{red:02x}{green:02x}{blue:02x}"


def _turning(ring: np.ndarray, sense: int) -> np.ndarray:
    """The ring in this sense of rotation: one inside another is a hole where the two differ."""
    x, y = np.asarray(ring, float).T
    area = float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))
    return ring if area * sense > 0 else ring[::-1]
