"""What viewers without grids and scans can draw all the same: occupied cells and sonar returns as point
clouds, waypoints as poses."""

from __future__ import annotations

import base64
import itertools
import math
from typing import Any

import numpy as np

from uuvtai.logs.encode import IDENTITY
from uuvtai.logs.schemas import FLOAT32
from uuvtai.logs.topics.map_topics import grid_values

Message = dict[str, Any]

_FIELDS = [{"name": name, "offset": 4 * i, "type": FLOAT32} for i, name in enumerate(("x", "y", "z"))]
_STRIDE = 12


def occupied_cells(grid: Message, _time_ns: int, occupied: float) -> Message:
    """foxglove.PointCloud of the centres of the cells of a foxglove.Grid whose value is at least
    ``occupied``, in the grid's frame."""
    rows, columns = np.nonzero(grid_values(grid) >= occupied)
    origin, cell = grid["pose"]["position"], grid["cell_size"]
    x = origin["x"] + (columns + 0.5) * cell["x"]
    y = origin["y"] + (rows + 0.5) * cell["y"]
    return _cloud(grid, np.column_stack([x, y, np.full(len(x), origin["z"])]))


def sonar_returns(scan: Message, _time_ns: int, _occupied: float) -> Message:
    """foxglove.PointCloud of the returns of a foxglove.LaserScan, in its frame; beams without a return are
    left out."""
    ranges, hit = np.array(scan["ranges"], float), np.array(scan["intensities"], float) > 0
    bearing = np.linspace(scan["start_angle"], scan["end_angle"], len(ranges))
    return _cloud(
        scan,
        np.column_stack([ranges * np.cos(bearing), ranges * np.sin(bearing), np.zeros(len(ranges))])[hit],
    )


def waypoints(plan: Message, time_ns: int, _occupied: float) -> Message:
    """foxglove.PosesInFrame of a uuv.Plan: each waypoint looks to the next one."""
    points = [(point["x"], point["y"], point["z"]) for point in plan["points"]]
    half_yaws = [
        0.5 * math.atan2(ahead[1] - here[1], ahead[0] - here[0]) for here, ahead in itertools.pairwise(points)
    ]
    half_yaws += half_yaws[-1:] or [0.0]  # the last one looks where the one before it did
    poses = [_pose(point, half) for point, half in zip(points, half_yaws, strict=False)]
    sec, nsec = divmod(time_ns, 1_000_000_000)
    return {"timestamp": {"sec": sec, "nsec": nsec}, "frame_id": "world", "poses": poses}


def _cloud(source: Message, points: np.ndarray) -> Message:
    return {
        "timestamp": source["timestamp"],
        "frame_id": source["frame_id"],
        "pose": IDENTITY,
        "point_stride": _STRIDE,
        "fields": _FIELDS,
        "data": _packed(points.astype("<f4")),
    }


def _pose(position: tuple[float, ...], half_yaw: float) -> Message:
    return {
        "position": _xyz(position),
        "orientation": {"x": 0, "y": 0, "z": math.sin(half_yaw), "w": math.cos(half_yaw)},
    }


def _xyz(position: tuple[float, ...]) -> Message:
    return dict(zip("xyz", position, strict=True))


def _packed(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()
