"""Outlines and pictures of obstacles as the boxes that kernels know: a rectangle is one box, what is made of
a few rectangles is these, any other outline has a thin box along each edge and boxes that fill it."""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from uuvtai.common.files import read_bytes, refusing

MAX_BOXES = 256
"""of all outlines and pictures of a world: each beam of a sonar looks at each of them"""
MAX_CORNERS = 500
"""of an outline with its holes"""
_MAX_IMAGE_BYTES, _MAX_PIXELS = 16 << 20, 4_000_000
_MODES = ("1", "L", "LA", "P", "RGB", "RGBA")
_MOST_CELLS = 400  # along a side of the raster in which an outline is filled
_HOLLOW_M = 0.4  # half the width of what may stay empty inside an outline: neither start nor goal fits in

Box = tuple[float, float, float, float, float]
"""x, y of the centre, half extents along and across [m], yaw [deg]"""
Rectangle = tuple[np.ndarray, np.ndarray]


def boxes_of(what: str, rings: Sequence[np.ndarray], tolerance_m: float) -> list[Box]:
    """Boxes for an outline (n, 2) [m] and its holes. ValueError, naming ``what``, for one without an area or
    with too many corners."""
    import cv2

    if sum(map(len, rings)) > MAX_CORNERS:
        raise ValueError(f"{what}: has more than {MAX_CORNERS} corners: straighten it")
    middle = rings[0].sum(axis=0) / max(1, len(rings[0]))
    center, size, degrees = cv2.minAreaRect((rings[0] - middle).astype(np.float32).reshape(-1, 2))
    if min(size) < 1e-3:
        raise ValueError(f"{what}: has no area; give three corners or more that are not on one line")
    yaw = math.radians(round(degrees, 3))
    turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
    corner = np.array(center) @ turn.T - 0.5 * np.array(size)
    own = [(ring - middle) @ turn.T - corner for ring in rings]
    shape = [max(1, min(_MOST_CELLS, round(side / tolerance_m))) for side in size]
    cell = np.array(size) / shape
    inside = _inside(own, (np.arange(shape[0]) + 0.5) * cell[0], (np.arange(shape[1]) + 0.5) * cell[1])
    rest = inside.copy()
    for ring in own:  # what is thinner than a cell holds the centre of none
        for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            steps = np.linspace(a, b, 2 + int(2 * np.abs((b - a) / cell).max()))
            rest[tuple(np.clip((steps / cell).astype(int), 0, np.array(shape) - 1).T[::-1])] = True
    filled, is_whole = _rectangles(inside, rest, sum(map(len, rings)), round(_HOLLOW_M / float(cell.min())))
    boxes = [(0.5 * (low + high) * cell, 0.5 * (high - low) * cell, 0.0) for low, high in filled]
    boxes += [] if is_whole else _edges(own, 2 * tolerance_m)
    found = []
    for at, half, angle in boxes:
        x, y, along, across = (round(float(v), 4) for v in (*((at + corner) @ turn + middle), *half))
        found.append((x, y, along, across, round(math.degrees(angle + yaw) % 180.0, 3)))
    return found


def _inside(rings: Sequence[np.ndarray], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(len(y), len(x)) bool: an odd number of edges lies to the right of the place."""
    found = np.zeros((len(y), len(x)), bool)
    for ring in rings:
        for (ax, ay), (bx, by) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            rows = (ay > y) != (by > y)
            if rows.any():
                found[rows] ^= x < (ax + (y[rows] - ay) * (bx - ax) / (by - ay))[:, None]
    return found


def _rectangles(
    inside: np.ndarray, rest: np.ndarray, enough: int, hollow: int
) -> tuple[list[Rectangle], bool]:
    """Corners (column, row) of rectangles within a raster, the thickest first, and whether they fill ``rest``
    to a cell. If ``enough`` do not, these are only the ones without which a hollow of so many cells to all
    sides would be left."""
    import cv2

    found, needed = [], 0
    while len(found) <= MAX_BOXES:
        left = np.pad(rest & inside, 1).astype(np.uint8)
        depth = cv2.distanceTransform(left, cv2.DIST_C, 3)[1:-1, 1:-1]
        row, column = np.unravel_index(int(depth.argmax()), depth.shape)
        reach = int(depth[row, column]) - 1
        if reach < 0 and not rest.any():
            return found, True
        needed += reach >= hollow
        if reach < 0 or (len(found) >= enough and reach < hollow):
            break
        low, high = np.array([column, row]) - reach, np.array([column, row]) + reach + 1
        _, (low, high) = max((_grown(inside, low, high, axis) for axis in (0, 1)), key=lambda one: one[0])
        rest[max(0, low[1] - 1) : high[1] + 1, max(0, low[0] - 1) : high[0] + 1] = False
        found.append((low, high))
    return found[:needed], False


def _grown(inside: np.ndarray, low: np.ndarray, high: np.ndarray, first: int) -> tuple[int, Rectangle]:
    """(area, corners) of a rectangle made as long as it can be along one axis, then along the other."""
    low, high = low.copy(), high.copy()
    for axis in (first, 1 - first):
        lines = inside if axis == 0 else inside.T
        free = np.logical_and.reduce(lines[low[1 - axis] : high[1 - axis]])
        while low[axis] > 0 and free[low[axis] - 1]:
            low[axis] -= 1
        while high[axis] < len(free) and free[high[axis]]:
            high[axis] += 1
    return int(np.prod(high - low)), (low, high)


def _edges(rings: Sequence[np.ndarray], thick_m: float) -> Iterator[tuple[np.ndarray, np.ndarray, float]]:
    """(centre, half extents, yaw) of a thin box inside along every edge."""
    for ring in rings:
        for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            along, length = b - a, float(np.hypot(*(b - a)))
            if length < 1e-6:
                continue
            inwards = np.array([-along[1], along[0]]) / length
            probe = 0.5 * (a + b) + 1e-3 * inwards
            sign = 1.0 if _inside(rings, probe[:1], probe[1:])[0, 0] else -1.0
            center = 0.5 * (a + b) + sign * 0.5 * thick_m * inwards
            yield center, np.array([0.5 * length, 0.5 * thick_m]), math.atan2(along[1], along[0])


def read_picture(image: str) -> np.ndarray:
    """Brightness (rows, columns), uint8, of a PNG or PGM; transparent is white. ValueError for any other
    file, and for one too large."""
    from PIL import Image

    with refusing(ValueError, f"occupancy.image: {image} cannot be read"):
        content = read_bytes(Path(image), _MAX_IMAGE_BYTES)
    try:
        with warnings.catch_warnings(), Image.open(io.BytesIO(content), formats=("PNG", "PPM")) as found:
            warnings.simplefilter("error")
            (width, height), mode = found.size, found.mode
            if width * height <= _MAX_PIXELS and mode in _MODES:
                drawn = found.convert("RGBA")
                return np.asarray(
                    Image.alpha_composite(Image.new("RGBA", drawn.size, "white"), drawn).convert("L")
                )
    except Exception as error:  # of a damaged file Pillow raises what its parts raise
        reason = " ".join(str(error).split())[:100]
        raise ValueError(f"occupancy.image: {image} is no PNG or PGM that can be read ({reason})") from None
    raise ValueError(
        f"occupancy.image: {image} has {width} x {height} pixels of mode {mode}; a map has at most "
        f"{_MAX_PIXELS:,}, and is black and white, grey, RGB or with a palette: save it anew"
    )


def outlines_of(dark: np.ndarray) -> Iterator[list[np.ndarray]]:
    """Rings (n, 2) [pixels from the lower left corner] of every obstacle in a picture, to a pixel: outline,
    holes. ValueError for more obstacles than may be."""
    import cv2

    count, names, places, _ = cv2.connectedComponentsWithStats(dark.astype(np.uint8), connectivity=8)
    if count - 1 > MAX_BOXES:
        raise ValueError(
            f"occupancy.image: shows {count - 1:,} obstacles, and {MAX_BOXES} may be: remove specks"
        )
    for name in range(1, count):
        left, top, width, height = (int(value) for value in places[name, :4])
        fine = np.zeros(
            (2 * height + 1, 2 * width + 1), np.uint8
        )  # each second line is an edge between pixels
        fine[1::2, 1::2] = names[top : top + height, left : left + width] == name
        fine = cv2.dilate(fine, np.ones((3, 3), np.uint8))
        rings, tree = cv2.findContours(fine, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
        order = sorted(range(len(rings)), key=lambda i: bool(tree[0][i][3] >= 0))  # its holes last
        pixels = [0.5 * _straightened(rings[i])[:, 0] + (left, top) for i in order]
        yield [np.column_stack([p[:, 0], len(dark) - p[:, 1]]) for p in pixels]


def _straightened(ring: np.ndarray) -> np.ndarray:
    """The ring with fewer corners, none farther off than a pixel, unless that takes its area away."""
    import cv2

    found = cv2.approxPolyDP(ring, 2.0, True)
    return found if cv2.contourArea(found) > 0.8 * cv2.contourArea(ring) else ring
