"""How values become JSON text: what the encoders of the topics have in common.

Numbers are printed with nine significant digits, which is exact for float32: an outsider recomputes from the
very values that the simulator had. Messages at control rate are printed from templates, several times faster
than ``json.dumps``; the rest are dicts. Whatever is not finite is refused with a ValueError.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from uuvtai.logs.schemas import LINE_STRIP

Vector = Sequence[float] | np.ndarray

IDENTITY = {"position": {"x": 0, "y": 0, "z": 0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}

_XYZ = '{"x":%.9g,"y":%.9g,"z":%.9g}'
_WXYZ = '{"w":%.9g,"x":%.9g,"y":%.9g,"z":%.9g}'
_POSE = '{"position":' + _XYZ + ',"orientation":' + _WXYZ + "}"
_TRANSFORM = (
    '{"timestamp":%s,"parent_frame_id":"%s","child_frame_id":"%s","translation":'
    + _XYZ
    + ',"rotation":'
    + _WXYZ
    + "}"
)


@functools.cache
def _list_template(length: int) -> str:
    return "[" + ",".join(["%.9g"] * length) + "]"


def numbers(values: Any) -> str:
    """A JSON list."""
    flat = np.asarray(values).ravel()
    return finite(_list_template(len(flat)) % tuple(flat.tolist()))


def number(value: float) -> str:
    """A JSON number."""
    return finite("%.9g" % value)  # noqa: UP031 - the one way of printing numbers here


def number_or_null(value: float | None) -> str:
    """A JSON number, or null."""
    return "null" if value is None else number(value)


def numbers_or_null(values: Any | None) -> str:
    """A JSON list, or null."""
    return "null" if values is None else numbers(values)


def finite(text: str) -> str:
    """Printed numbers without 'nan' and 'inf': the only ones that contain an n."""
    if "n" in text:
        raise ValueError(f"a number that is not finite: {text[:200]}")
    return text


def dumped(message: dict[str, Any]) -> bytes:
    """A message given as a dict."""
    try:
        return json.dumps(message, separators=(",", ":"), allow_nan=False).encode()
    except ValueError:
        raise ValueError(f"a number that is not finite: {str(message)[:200]}") from None


# ------------------------------------------------------------------------------------------------------ poses


def transform(stamp: str, parent: str, child: str, translation: Vector, rotation: Vector) -> str:
    """foxglove.FrameTransform."""
    return _TRANSFORM % (stamp, parent, child, *translation, *rotation)


def pose_in_frame(stamp: str, position: Vector, quat: Vector) -> bytes:
    """foxglove.PoseInFrame in the world."""
    pose = checked(_POSE % (*map(float, position), *map(float, quat)))
    return f'{{"timestamp":{stamp},"frame_id":"world","pose":{pose}}}'.encode()


# --------------------------------------------------------------------------------------------------- scenes


def scene_entity(time_ns: int, name: str, **primitives: list) -> dict[str, Any]:
    """foxglove.SceneEntity in the world; replaces the one of the same name."""
    sec, nsec = divmod(time_ns, 1_000_000_000)
    kinds = ("arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")
    return {
        "timestamp": {"sec": sec, "nsec": nsec},
        "frame_id": "world",
        "id": name,
        "lifetime": {"sec": 0, "nsec": 0},
        "frame_locked": False,
        "metadata": [],
        **{kind: primitives.get(kind, []) for kind in kinds},
    }


def scene_update(*entities: dict[str, Any]) -> bytes:
    """foxglove.SceneUpdate."""
    return dumped({"deletions": [], "entities": entities})


def line(
    points: Iterable[Vector], rgba: Sequence[float], thickness: float, kind: int = LINE_STRIP
) -> dict[str, Any]:
    """foxglove.LinePrimitive, thickness in metres."""
    return {
        "type": kind,
        "pose": IDENTITY,
        "thickness": thickness,
        "scale_invariant": False,
        "points": [vector(point) for point in points],
        "color": color(rgba),
        "colors": [],
        "indices": [],
    }


def vector(values: Vector) -> dict[str, float]:
    """foxglove.Vector3 or Point3."""
    x, y, z = (short(v) for v in values)
    return {"x": x, "y": y, "z": z}


def short(value: float) -> float:
    """The float with the fewest digits that gives back this float32."""
    return float("%.9g" % value)  # noqa: UP031


def color(rgba: Sequence[float]) -> dict[str, float]:
    """foxglove.Color."""
    return dict(zip("rgba", rgba, strict=True))


def upright_pose(position: Vector, yaw: float = 0.0) -> dict[str, Any]:
    """foxglove.Pose turned about z."""
    return {
        "position": vector(position),
        "orientation": {"x": 0, "y": 0, "z": math.sin(0.5 * yaw), "w": math.cos(0.5 * yaw)},
    }


def checked(text: str) -> str:
    """Printed objects without numbers that are not finite."""
    if "nan" in text or "inf" in text:
        raise ValueError(f"a number that is not finite: {text[:200]}")
    return text
