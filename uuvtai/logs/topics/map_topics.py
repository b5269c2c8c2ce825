"""The vehicle's map: occupancy, clearance and risk as grids. Colours are for viewers, ``value`` is what the
vehicle has."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from uuvtai.config import Config
from uuvtai.logs.encode import IDENTITY, dumped
from uuvtai.logs.moment import Moment
from uuvtai.logs.schemas import FLOAT32, GRID, UINT8
from uuvtai.logs.topic import MAPS, Topic

Paint = Callable[[np.ndarray], tuple[Any, Any, Any, Any]]
"""red, green, blue, alpha of a layer's values"""

_CELL = np.dtype([("red", "u1"), ("green", "u1"), ("blue", "u1"), ("alpha", "u1"), ("value", "<f4")])
_FIELDS = [
    {"name": name, "offset": i, "type": UINT8} for i, name in enumerate(("red", "green", "blue", "alpha"))
]
_FIELDS.append({"name": "value", "offset": 4, "type": FLOAT32})


@dataclass(frozen=True)
class Layer:
    """One map of the vehicle, packed: a recording holds hundreds, and most of their cells are alike."""

    packed: bytes
    shape: tuple[int, int]
    kind: str
    """NumPy's name of the type of the values"""
    origin_m: tuple[float, float]
    """world x, y of the outer corner of cell [0, 0]"""
    cell_m: float

    @classmethod
    def of(cls, values: np.ndarray, origin_m: tuple[float, float], cell_m: float) -> Layer:
        """``values``: (n_row, n_col), row along y, column along x."""
        n_row, n_col = values.shape
        return cls(zlib.compress(values.tobytes(), 1), (n_row, n_col), values.dtype.str, origin_m, cell_m)

    @property
    def values(self) -> np.ndarray:
        """(n_row, n_col), row along y, column along x."""
        return np.frombuffer(zlib.decompress(self.packed), self.kind).reshape(self.shape)

    @property
    def nbytes(self) -> int:
        """Bytes that it takes."""
        return len(self.packed)


def _static(moment: Moment) -> bytes:
    return _grid(moment, moment.stamp, moment["grid_map.static_occ"], static_colors)


def _dynamic(moment: Moment) -> bytes:
    return _grid(moment, moment.stamp, moment["grid_map.dynamic_occ"], dynamic_colors)


def _clearance(moment: Moment) -> bytes:
    return _grid(moment, _computed(moment), moment["clearance.clearance_m"], _clearance_colors)


def _risk(moment: Moment) -> bytes:
    c, clearance_m = moment.header.config.clearance, moment["clearance.clearance_m"]
    risk = (
        c.risk_static * moment["grid_map.static_occ"]
        + c.risk_dynamic * moment["grid_map.dynamic_occ"]
        + c.risk_clearance / (clearance_m + c.risk_epsilon_m)
    )
    return _grid(moment, _computed(moment), risk, _risk_colors)


def _computed(moment: Moment) -> str:
    """Time of the map that clearance and risk were computed from."""
    return moment.stamp_of(moment.step - moment.step % moment.header.config.clearance.period_steps)


def _grid(moment: Moment, stamp: str, values: np.ndarray, paint: Paint) -> bytes:
    config = moment.header.config
    x, y = map_origin(config, values.shape)
    pose = {**IDENTITY, "position": {"x": x, "y": y, "z": 0}}
    return grid_text(stamp, "world", pose, config.mapping.cell_m, values, paint)


def grid_text(
    stamp: str, frame: str, pose: dict[str, Any], cell_m: float, values: np.ndarray, paint: Paint
) -> bytes:
    """foxglove.Grid of ``values`` (row, col); ``pose``: of the outer corner of cell [0, 0]. Raises ValueError
    for values that are not finite."""
    if not np.isfinite(values).all():
        raise ValueError("a map with values that are not finite")
    cells = np.empty(values.shape, _CELL)
    for name, channel in zip(("red", "green", "blue", "alpha"), paint(values), strict=True):
        cells[name] = channel
    cells["value"] = values
    head = {
        "frame_id": frame,
        "pose": pose,
        "column_count": values.shape[1],
        "cell_size": {"x": cell_m, "y": cell_m},
        "row_stride": values.shape[1] * _CELL.itemsize,
        "cell_stride": _CELL.itemsize,
        "fields": _FIELDS,
    }
    packed = base64.b64encode(cells.tobytes())
    return f'{{"timestamp":{stamp},'.encode() + dumped(head)[1:-1] + b',"data":"' + packed + b'"}'


def map_origin(config: Config, shape: tuple[int, ...]) -> tuple[float, float]:
    """World (x, y) [m] of the outer corner of cell [0, 0] of a map of this shape (n_row, n_col), in whose
    middle the tank lies."""
    cell_m = config.mapping.cell_m
    first_x, first_y = (
        low - (count - round((high - low) / cell_m)) // 2 * cell_m
        for (low, high), count in zip(
            (config.world.tank.x_m, config.world.tank.y_m), shape[::-1], strict=True
        )
    )
    return first_x, first_y


def static_colors(values: np.ndarray) -> tuple[int, int, int, np.ndarray]:
    """Paint of what rests."""
    return 38, 44, 56, _byte(values)


def dynamic_colors(values: np.ndarray) -> tuple[int, int, int, np.ndarray]:
    """Paint of what moves."""
    return 229, 57, 70, _byte(values)


def _clearance_colors(values: np.ndarray):
    blue, green, red = _color_mapped(values / max(float(values.max()), 1e-6), cv2.COLORMAP_VIRIDIS)
    return red, green, blue, 150


def _risk_colors(values: np.ndarray):
    share = values / max(float(values.max()), 1e-6)
    blue, green, red = _color_mapped(share, cv2.COLORMAP_INFERNO)
    return red, green, blue, _byte(np.sqrt(np.clip(share, 0, 1)))


def _byte(share: np.ndarray) -> np.ndarray:
    return (np.clip(share, 0, 1) * 255).astype(np.uint8)


def _color_mapped(share: np.ndarray, color_map: int) -> tuple[np.ndarray, ...]:
    image = cv2.applyColorMap(_byte(share), color_map)
    return image[..., 0], image[..., 1], image[..., 2]


def grid_values(data: dict[str, Any]) -> np.ndarray:
    """``value`` of a foxglove.Grid as an array (row, col)."""
    cells = base64.b64decode(data["data"])
    offset = next((entry["offset"] for entry in data["fields"] if entry["name"] == "value"), None)
    if offset is None:
        raise ValueError("a grid without a field named value")
    packed = np.frombuffer(cells, np.uint8).reshape(-1, data["column_count"], data["cell_stride"])
    return packed[..., offset : offset + 4].copy().view("<f4")[..., 0]


def _read_layer(data: dict[str, Any]) -> Layer:
    origin = data["pose"]["position"]
    return Layer.of(grid_values(data), (origin["x"], origin["y"]), data["cell_size"]["x"])


_LAYERS = ("grid_map.static_occ", "grid_map.dynamic_occ", "clearance.clearance_m")

ROWS = (
    Topic("/map/static", MAPS, GRID, _static, _LAYERS[:1], _read_layer, in_picture=True),
    Topic("/map/dynamic", MAPS, GRID, _dynamic, _LAYERS[1:2], _read_layer, in_picture=True),
    Topic("/map/clearance", MAPS, GRID, _clearance, _LAYERS[2:], _read_layer, in_picture=True),
    Topic("/map/risk", MAPS, GRID, _risk, _LAYERS),
)
