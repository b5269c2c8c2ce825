"""Snapshots as JSON text of Foxglove and uuv messages.

Numbers are printed with nine significant digits, which is exact for float32: an outsider recomputes from the
very values that the simulator had. Messages at control rate are printed from templates, several times faster
than ``json.dumps``; the rest are dicts. Whatever is not finite is refused with a ValueError.
"""

from __future__ import annotations

import base64
import functools
import json
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import cv2
import numpy as np

from uuvtai.logs import schemas
from uuvtai.snapshot import KINDS, DepthLine, EpisodeSnapshot, MapLayers

Vector = Sequence[float] | np.ndarray

FAR_M = 1e5
"""Anything beyond stands for "nothing there" in the simulator."""

IDENTITY = {"position": {"x": 0, "y": 0, "z": 0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
CAMERA_OPTICAL = (0.5, -0.5, 0.5, -0.5)
"""Quaternion (w, x, y, z) from optical axes (x right, y down, z ahead) to the body's."""

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


def time_text(time_ns: int) -> str:
    """foxglove time."""
    return '{"sec":%d,"nsec":%d}' % divmod(time_ns, 1_000_000_000)  # noqa: UP031


def dumped(message: dict[str, Any]) -> bytes:
    """A message given as a dict."""
    try:
        return json.dumps(message, separators=(",", ":"), allow_nan=False).encode()
    except ValueError:
        raise ValueError(f"a number that is not finite: {str(message)[:200]}") from None


# ------------------------------------------------------------------------------------------------------ poses


def level_rotation(quat_wb: Vector) -> tuple[float, float, float, float]:
    """Quaternion (w, x, y, z) that turns a level frame with the vehicle's yaw into the body frame: undoes
    roll and pitch."""
    w, x, y, z = (float(v) for v in quat_wb)
    half = 0.5 * math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    c, s = math.cos(half), math.sin(half)
    return w * c + z * s, -x * c - y * s, x * s - y * c, w * s - z * c


def quaternion_of(rpy: Vector) -> tuple[float, float, float, float]:
    """Quaternion (w, x, y, z) of roll, pitch, yaw (Z-Y-X)."""
    cr, cp, cy = (math.cos(0.5 * v) for v in rpy)
    sr, sp, sy = (math.sin(0.5 * v) for v in rpy)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def frame_transforms(stamp: str, snapshot: EpisodeSnapshot, camera_offset_b_m: Vector) -> bytes:
    """world -> base -> sonar, camera."""
    base = _TRANSFORM % (stamp, "world", "base", *snapshot.pos_w.tolist(), *snapshot.quat_wb.tolist())
    sonar = _TRANSFORM % (stamp, "base", "sonar", 0, 0, 0, *level_rotation(snapshot.quat_wb))
    camera = _TRANSFORM % (stamp, "base", "camera", *camera_offset_b_m, *CAMERA_OPTICAL)
    return f'{{"transforms":[{base},{sonar},{camera}]}}'.encode()


def pose_in_frame(stamp: str, position: Vector, quat: Vector) -> bytes:
    """A pose in the world."""
    return f'{{"timestamp":{stamp},"frame_id":"world","pose":{finite_pose(position, quat)}}}'.encode()


def finite_pose(position: Vector, quat: Vector) -> str:
    """foxglove.Pose."""
    return _checked(_POSE % (*map(float, position), *map(float, quat)))


# ---------------------------------------------------------------------------------------------------- sensing


def laser_scan(stamp: str, snapshot: EpisodeSnapshot, max_range_m: float) -> bytes:
    """Ranges as sensed; where nothing returned: maximum range with intensity 0, which no return has."""
    hit = snapshot.sonar_hit != 0
    ranges = np.where(hit, snapshot.sonar_range_m, np.float32(max_range_m))
    thousandths = np.where(hit, np.clip(np.rint(snapshot.sonar_intensity * 1000), 1, 1000), 0).astype(
        np.int32
    )
    intensities = ",".join(map(_THOUSANDTHS.__getitem__, thousandths.tolist()))
    end_angle = 2 * math.pi * (len(hit) - 1) / len(hit)
    return (
        f'{{"timestamp":{stamp},"frame_id":"sonar","pose":{_IDENTITY_TEXT},"start_angle":0,'
        f'"end_angle":{end_angle!r},'
        f'"ranges":{numbers(ranges)},"intensities":[{intensities}]}}'
    ).encode()


_THOUSANDTHS = [f"{i / 1000:g}" for i in range(1001)]
"""Intensities are printed to three digits; nothing is computed from them."""

_IDENTITY_TEXT = json.dumps(IDENTITY, separators=(",", ":"))


def sonar_doppler(stamp: str, snapshot: EpisodeSnapshot) -> bytes:
    """Doppler of every beam and the own velocity it has to be compensated with."""
    velocity = np.where(snapshot.sonar_hit != 0, snapshot.sonar_doppler_m_s, np.float32(0))
    own = numbers(snapshot.sonar_ping_vel_b)
    return f'{{"timestamp":{stamp},"velocity":{numbers(velocity)},"own_velocity":{own}}}'.encode()


def depth_line(stamp: str, line: DepthLine) -> bytes:
    """The part of a depth image that the map takes."""
    columns, rows = (",".join(map(str, indices.tolist())) for indices in (line.column, line.row))
    depth = numbers(line.depth_m)
    return f'{{"timestamp":{stamp},"column":[{columns}],"row":[{rows}],"depth":{depth}}}'.encode()


def depth_png(stamp: str, depth_m: np.ndarray) -> bytes:
    """16-bit PNG in millimetres."""
    millimetres = np.clip(np.rint(np.asarray(depth_m, np.float64) * 1000.0), 0, 65535).astype(np.uint16)
    png = base64.b64encode(cv2.imencode(".png", millimetres)[1].tobytes()).decode()
    return f'{{"timestamp":{stamp},"frame_id":"camera","data":"{png}","format":"png"}}'.encode()


# ------------------------------------------------------------------------------------------------------- maps

Paint = Callable[[np.ndarray], tuple[Any, Any, Any, Any]]
"""red, green, blue, alpha of a layer's values"""

_CELL = np.dtype([("red", "u1"), ("green", "u1"), ("blue", "u1"), ("alpha", "u1"), ("value", "<f4")])
_FIELDS = [
    {"name": name, "offset": i, "type": schemas.UINT8}
    for i, name in enumerate(("red", "green", "blue", "alpha"))
]
_FIELDS.append({"name": "value", "offset": 4, "type": schemas.FLOAT32})


def grids(stamp: str, clearance_stamp: str, maps: MapLayers) -> dict[str, bytes]:
    """Messages by topic. Colours are for viewers, ``value`` is what the vehicle has; ``clearance_stamp`` =
    time of the map that clearance and risk were computed from."""
    layers: dict[str, tuple[np.ndarray, Paint]] = {
        "/map/static": (maps.static, _static_colors),
        "/map/dynamic": (maps.dynamic, _dynamic_colors),
    }
    layers["/map/clearance"] = (maps.clearance_m, _clearance_colors)
    if maps.risk is not None:
        layers["/map/risk"] = (maps.risk, _risk_colors)
    stamps = {"/map/static": stamp, "/map/dynamic": stamp}
    return {
        topic: _grid(stamps.get(topic, clearance_stamp), maps, np.asarray(values, np.float32), paint)
        for topic, (values, paint) in layers.items()
    }


def _grid(stamp: str, maps: MapLayers, values: np.ndarray, paint: Paint) -> bytes:
    if not np.isfinite(values).all():
        raise ValueError("a map with values that are not finite")
    cells = np.empty(values.shape, _CELL)
    for name, channel in zip(("red", "green", "blue", "alpha"), paint(values), strict=True):
        cells[name] = channel
    cells["value"] = values
    head = {
        "frame_id": "world",
        "pose": {**IDENTITY, "position": {"x": maps.origin_m[0], "y": maps.origin_m[1], "z": 0}},
        "column_count": values.shape[1],
        "cell_size": {"x": maps.cell_m, "y": maps.cell_m},
        "row_stride": values.shape[1] * _CELL.itemsize,
        "cell_stride": _CELL.itemsize,
        "fields": _FIELDS,
    }
    return (
        f'{{"timestamp":{stamp},'.encode()
        + dumped(head)[1:-1]
        + b',"data":"'
        + base64.b64encode(cells.tobytes())
        + b'"}'
    )


def _static_colors(values: np.ndarray):
    return 38, 44, 56, _byte(values)


def _dynamic_colors(values: np.ndarray):
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


# ------------------------------------------------------------------------------------------ truth for viewers


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


def line(
    points: Iterable[Vector], rgba: Sequence[float], thickness: float, kind: int = schemas.LINE_STRIP
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


_RESTING, _MOVING = (0.44, 0.5, 0.58, 0.9), (0.95, 0.45, 0.2, 0.9)


def obstacle_scene(time_ns: int, snapshot: EpisodeSnapshot, n_rest: int) -> bytes:
    """The true bodies; the first ``n_rest`` of them never move."""
    shapes: dict[str, list] = {"spheres": [], "cylinders": [], "cubes": []}
    for i, slot in enumerate(body_slots(snapshot)):
        kind, size = KINDS[int(snapshot.obstacle_kind[slot])], snapshot.obstacle_size[slot]
        shape = {
            "pose": upright_pose(
                snapshot.obstacle_pos_w[slot], float(snapshot.obstacle_yaw[slot]) if kind == "box" else 0.0
            ),
            "size": vector(2 * size),
            "color": color(_RESTING if i < n_rest else _MOVING),
        }
        if kind == "cylinder":
            shape |= {"bottom_scale": 1, "top_scale": 1}
        shapes[{"sphere": "spheres", "cylinder": "cylinders", "box": "cubes"}[kind]].append(shape)
    return dumped({"deletions": [], "entities": [scene_entity(time_ns, "obstacles", **shapes)]})


_MOTION = '"yaw":%.9g,"vx":%.9g,"vy":%.9g,"vz":%.9g}'
_TRUTH = {
    "sphere": '{"kind":"sphere","x":%.9g,"y":%.9g,"z":%.9g,"radius":%.9g,' + _MOTION,
    "cylinder": '{"kind":"cylinder","x":%.9g,"y":%.9g,"z":%.9g,"radius":%.9g,"half_height":%.9g,' + _MOTION,
    "box": '{"kind":"box","x":%.9g,"y":%.9g,"z":%.9g,"half_extents":[%.9g,%.9g,%.9g],' + _MOTION,
}
_SIZES = {"sphere": [0], "cylinder": [0, 2], "box": [0, 1, 2]}


def obstacle_truth(snapshot: EpisodeSnapshot) -> bytes:
    """The true bodies as numbers, in the order of scenario.json."""
    bodies = []
    for slot in body_slots(snapshot):
        kind = KINDS[int(snapshot.obstacle_kind[slot])]
        size = snapshot.obstacle_size[slot][_SIZES[kind]].tolist()
        place, motion = snapshot.obstacle_pos_w[slot].tolist(), snapshot.obstacle_vel_w[slot].tolist()
        bodies.append(_TRUTH[kind] % (*place, *size, float(snapshot.obstacle_yaw[slot]), *motion))
    return f'{{"obstacles":[{_checked(",".join(bodies))}]}}'.encode()


def body_slots(snapshot: EpisodeSnapshot) -> list[int]:
    """Slots in use."""
    return [slot for slot, kind in enumerate(snapshot.obstacle_kind.tolist()) if kind in KINDS]


_TRACK = '{"x":%.9g,"y":%.9g,"z":%.9g,"vx":%.9g,"vy":%.9g,"radius":%.9g}'


def tracks_message(snapshot: EpisodeSnapshot) -> bytes:
    """The moving bodies that the vehicle believes in."""
    rows = [] if snapshot.tracks is None else snapshot.tracks.tolist()
    beams = [] if snapshot.track_beams is None else snapshot.track_beams.tolist()
    text = ",".join(_TRACK % tuple(row) for row in rows)
    return f'{{"tracks":[{_checked(text)}],"beams":[{",".join(map(str, beams))}]}}'.encode()


def _checked(text: str) -> str:
    """Printed objects without numbers that are not finite."""
    if "nan" in text or "inf" in text:
        raise ValueError(f"a number that is not finite: {text[:200]}")
    return text
