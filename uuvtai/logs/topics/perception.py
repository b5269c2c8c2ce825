"""Topics of perception: goal and tank, true and tracked obstacles, the map."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from uuvtai.common.enums import clearance_m, occupancy
from uuvtai.common.obstacle_motion import KIND_NAMES
from uuvtai.config import Config
from uuvtai.logs.encode import (
    EVADING,
    IDENTITY,
    MAPS,
    NEW_SCAN,
    OBSTACLES,
    Moment,
    Topic,
    checked,
    color,
    dumped,
    line,
    number,
    number_or_null,
    numbers,
    scene_entity,
    scene_update,
    upright_pose,
    vector,
)
from uuvtai.logs.schemas import (
    FLOAT32,
    GRID,
    LINE_LOOP,
    NUMBER,
    SCENE_UPDATE,
    THREE,
    UINT,
    UINT8,
    Schema,
    array_of,
    described,
    record,
)

_GOAL_COLOR, _TANK_COLOR = (0.98, 0.75, 0.14, 1.0), (0.3, 0.38, 0.46, 1.0)
_RESTING, _MOVING = (0.44, 0.5, 0.58, 0.9), (0.95, 0.45, 0.2, 0.9)

_OBSTACLE: Schema = {
    "title": "uuv.Obstacle",
    "type": "object",
    "properties": {
        "kind": {"type": "string", "enum": ["sphere", "cylinder", "box"]},
        "x": NUMBER,
        "y": NUMBER,
        "z": described(NUMBER, "[m] centre"),
        "radius": described(NUMBER, "[m] of a sphere or a vertical cylinder"),
        "half_height": described(NUMBER, "[m] of a cylinder"),
        "half_extents": described(THREE, "[m] of a box, before it is turned by yaw"),
        "yaw": described(NUMBER, "[rad]"),
        "vx": NUMBER,
        "vy": NUMBER,
        "vz": described(NUMBER, "[m/s]"),
    },
    "required": ["kind", "x", "y", "z", "yaw", "vx", "vy", "vz"],
    "oneOf": [{"required": ["radius"]}, {"required": ["half_extents"]}],
}
_OBSTACLES = record("uuv.Obstacles", "Truth. In the order of scenario.json.", obstacles=array_of(_OBSTACLE))
_BOUNDS = {
    "above": described(NUMBER, "[m] world z of the lowest edge of what may be above; null = free"),
    "below": described(NUMBER, "[m] world z of the highest edge of what may be below; null = free"),
}
_TRACK = record(
    "uuv.Track",
    "State at the newest tracked scan.",
    _BOUNDS,
    x=NUMBER,
    y=NUMBER,
    z=NUMBER,
    vx=NUMBER,
    vy=NUMBER,
    radius=NUMBER,
    covariance=described(array_of(NUMBER), "of x, y, vx, vy: upper triangle, row by row"),
    turn_rate=described(NUMBER, "[rad/s], 0 = unknown"),
    turn_variance=described(NUMBER, "[rad^2/s^2], 0 = not estimated"),
    present=described(NUMBER, "probability that it is where it is expected"),
    futures=described(array_of(NUMBER), "probability of each future beside the forecast"),
)
_TRACKS = record(
    "uuv.Tracks",
    "Moving obstacles that the vehicle believes in.",
    tracks=array_of(_TRACK),
    beams=described(array_of(UINT), "beams of the newest scan that a moving obstacle explains"),
)
_HYPOTHESIS = record(
    "uuv.Hypothesis",
    weight=described(
        NUMBER, "probability; the last hypothesis is the forecast and has what the others leave"
    ),
    x=described(array_of(NUMBER), "[m] every tracking.forecast_dt_s from now on"),
    y=described(array_of(NUMBER), "[m]"),
)
_EXPECTED = record(
    "uuv.ExpectedTrack",
    "Of a moving track.",
    _BOUNDS,
    radius=described(array_of(NUMBER), "[m] at the same times: the body's and what is unsure"),
    hypotheses=array_of(_HYPOTHESIS),
)
_FUTURES = record(
    "uuv.Futures",
    "Where each moving track may be, as the decision of this time sees it; in the order of /tracks.",
    tracks=array_of(_EXPECTED),
)

_MOTION = '"yaw":%.9g,"vx":%.9g,"vy":%.9g,"vz":%.9g}'
_TRUTH = {
    "sphere": '{"kind":"sphere","x":%.9g,"y":%.9g,"z":%.9g,"radius":%.9g,' + _MOTION,
    "cylinder": '{"kind":"cylinder","x":%.9g,"y":%.9g,"z":%.9g,"radius":%.9g,"half_height":%.9g,' + _MOTION,
    "box": '{"kind":"box","x":%.9g,"y":%.9g,"z":%.9g,"half_extents":[%.9g,%.9g,%.9g],' + _MOTION,
}
_SIZES = {"sphere": [0], "cylinder": [0, 2], "box": [0, 1, 2]}
_SHAPES = {"sphere": "spheres", "cylinder": "cylinders", "box": "cubes"}
_TRACK_TEXT = '{"x":%.9g,"y":%.9g,"z":%.9g,"vx":%.9g,"vy":%.9g,"radius":%.9g,'
_BELIEF_TEXT = '"turn_rate":%.9g,"turn_variance":%.9g,"present":%.9g,"above":%s,"below":%s,'
_FREE_M = 1e5  # Bounds beyond are no bounds.


def _goal(moment: Moment) -> bytes:
    scenario = moment.header.scenario
    spheres = [
        {
            "pose": upright_pose(scenario["goal"]),
            "size": {"x": size, "y": size, "z": size},
            "color": color(rgba),
        }
        for size, rgba in ((0.25, _GOAL_COLOR), (2 * scenario["goal_radius_m"], (*_GOAL_COLOR[:3], 0.15)))
    ]
    return scene_update(
        scene_entity(moment.time_ns, "goal", spheres=spheres),
        scene_entity(moment.time_ns, "tank", lines=_tank_lines(scenario["tank"])),
    )


def _tank_lines(tank: dict[str, Any]) -> list[dict[str, Any]]:
    (x0, x1), (y0, y1) = tank["x_m"], tank["y_m"]
    flat = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    if tank["shape"] == "circle":
        angles = np.linspace(0, 2 * np.pi, 64, endpoint=False)
        flat = [
            (0.5 * (x0 + x1) + tank["radius_m"] * np.cos(a), 0.5 * (y0 + y1) + tank["radius_m"] * np.sin(a))
            for a in angles
        ]
    return [line([(x, y, z) for x, y in flat], _TANK_COLOR, 0.03, LINE_LOOP) for z in tank["z_m"]]


def _kinds(moment: Moment) -> list[tuple[int, str]]:
    """(slot, kind) of the obstacles, in the order of scenario.json."""
    codes = moment["world.kind"].tolist()
    return [(slot, KIND_NAMES[code]) for slot, code in enumerate(codes) if code in KIND_NAMES]


def _scene(moment: Moment) -> bytes:
    """The true obstacles; those that never move come first."""
    shapes: dict[str, list] = {"spheres": [], "cylinders": [], "cubes": []}
    n_rest = sum(obstacle["path"] is None for obstacle in moment.header.scenario["obstacles"])
    for i, (slot, kind) in enumerate(_kinds(moment)):
        yaw = float(moment["world.yaw"][slot]) if kind == "box" else 0.0
        shape = {
            "pose": upright_pose(moment["world.pos_w"][slot], yaw),
            "size": vector(2 * moment["world.size"][slot]),
            "color": color(_RESTING if i < n_rest else _MOVING),
        }
        if kind == "cylinder":
            shape |= {"bottom_scale": 1, "top_scale": 1}
        shapes[_SHAPES[kind]].append(shape)
    return scene_update(scene_entity(moment.time_ns, "obstacles", **shapes))


def _truth(moment: Moment) -> bytes:
    obstacles = []
    for slot, kind in _kinds(moment):
        size = moment["world.size"][slot][_SIZES[kind]].tolist()
        place, motion = moment["world.pos_w"][slot].tolist(), moment["world.vel_w"][slot].tolist()
        obstacles.append(_TRUTH[kind] % (*place, *size, float(moment["world.yaw"][slot]), *motion))
    return f'{{"obstacles":[{checked(",".join(obstacles))}]}}'.encode()


def _tracks(moment: Moment) -> bytes:
    moving = (moment["tracks.alive"] == 1) & (moment["tracks.moving"] == 1)
    state, explained = moment["tracks.state"][moving], moment["tracks.beam_track"]
    z_m, radius_m = moment["tracks.z_m"][moving], moment["tracks.radius_m"][moving]
    rows = np.column_stack([state[:, :2], z_m, state[:, 2:], radius_m]).tolist()
    beliefs = [
        moment[name][moving]
        for name in (
            *("tracks.turn_rate", "tracks.turn_cov", "tracks.present"),
            *("forecast.above_w", "forecast.below_w"),
        )
    ]
    lists = moment["tracks.cov"][moving], moment["futures.share"][moving]
    beams = np.flatnonzero((explained >= 0) & moving[np.maximum(explained, 0)])
    text = ",".join(
        _TRACK_TEXT % tuple(row)
        + _belief(*belief)
        + f'"covariance":{numbers(cov)},"futures":{numbers(futures)}}}'
        for row, belief, cov, futures in zip(rows, zip(*beliefs, strict=True), *lists, strict=True)
    )
    return f'{{"tracks":[{checked(text)}],"beams":[{",".join(map(str, beams.tolist()))}]}}'.encode()


def _futures(moment: Moment) -> bytes:
    """Tracks that have a forecast, each with its futures that are possible and then the forecast itself."""
    radius_m = moment["forecast.radius_m"]
    rows = np.flatnonzero(radius_m[:, 0] >= 0)
    bounds = moment["forecast.above_w"], moment["forecast.below_w"]
    texts = []
    for row in rows.tolist():
        above, below = (_bound(found[row]) for found in bounds)
        share = moment["futures.share"][row]
        paths = [(weight, moment["futures.pos_w"][row, i]) for i, weight in enumerate(share) if weight > 0]
        paths.append((1.0 - float(share.sum(dtype=float)), moment["forecast.pos_w"][row]))
        texts.append(
            f'{{"above":{above},"below":{below},"radius":{numbers(radius_m[row])},'
            f'"hypotheses":[{",".join(_hypothesis(*path) for path in paths)}]}}'
        )
    return f'{{"tracks":[{",".join(texts)}]}}'.encode()


def _hypothesis(weight: float, pos_w: np.ndarray) -> str:
    return f'{{"weight":{number(weight)},"x":{numbers(pos_w[:, 0])},"y":{numbers(pos_w[:, 1])}}}'


def _bound(z: float) -> str:
    return number_or_null(None if abs(z) > _FREE_M else float(z))


def _belief(rate: float, rate_cov: np.ndarray, present: float, above: float, below: float) -> str:
    bounds = [_bound(z) for z in (above, below)]
    return _BELIEF_TEXT % (rate, rate_cov[4], present, *bounds)


def _read_tracks(data: dict[str, Any]) -> np.ndarray:
    """(n, 9) x, y, radius, z, vx, vy and the covariance xx, xy, yy of the place [m, m/s, m^2]."""
    rows = [
        (
            *(t[name] for name in ("x", "y", "radius", "z", "vx", "vy")),
            *(t["covariance"][i] for i in (0, 1, 4)),
        )
        for t in data["tracks"]
    ]
    return np.array(rows, float).reshape(-1, 9)


def _read_futures(data: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """(weight (n,) of every hypothesis of every track, their points (n, k, 2) [m])."""
    paths = [path for track in data["tracks"] for path in track["hypotheses"]]
    points = [np.column_stack([path["x"], path["y"]]) for path in paths]
    return np.array([path["weight"] for path in paths], float), np.array(points, float).reshape(
        len(paths), -1, 2
    )


_PLACED = ("world.kind", "world.pos_w", "world.size", "world.yaw")

OBSTACLE_ROWS = (
    Topic("/goal", OBSTACLES, SCENE_UPDATE, _goal),
    Topic("/obstacles", OBSTACLES, SCENE_UPDATE, _scene, _PLACED, note="; truth"),
    Topic("/obstacles/truth", OBSTACLES, _OBSTACLES, _truth, (*_PLACED, "world.vel_w"), note="; truth"),
    Topic(
        "/tracks",
        NEW_SCAN,
        _TRACKS,
        _tracks,
        (
            *(f"tracks.{name}" for name in ("alive", "moving", "state", "z_m", "radius_m", "beam_track")),
            *(f"tracks.{name}" for name in ("cov", "turn_rate", "turn_cov", "present")),
            *("forecast.above_w", "forecast.below_w", "futures.share"),
        ),
        _read_tracks,
    ),
    Topic(
        "/futures",
        EVADING,
        _FUTURES,
        _futures,
        (
            *(f"forecast.{name}" for name in ("pos_w", "radius_m", "above_w", "below_w")),
            *("futures.share", "futures.pos_w"),
        ),
        _read_futures,
    ),
)


# ---- The map: occupancy, clearance and risk. Colours are for viewers, ``value`` is what the vehicle has.

Paint = Callable[[np.ndarray], tuple[Any, Any, Any, Any]]  # red, green, blue, alpha of a layer's values

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
    kind: str  # NumPy's name of the type of the values
    origin_m: tuple[float, float]  # world x, y of the outer corner of cell [0, 0]
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
        return len(self.packed)


def _occupied(layer: str, ink: tuple[int, int, int]) -> Callable[[Moment], bytes]:
    """The fuller a cell, the less transparent."""

    def paint(values: np.ndarray) -> tuple[Any, Any, Any, Any]:
        return *ink, _byte(values)

    return lambda moment: _grid(moment, moment.stamp, occupancy(moment[layer]), paint)


def _room(moment: Moment) -> np.ndarray:
    return clearance_m(moment["clearance.site"], moment.header.config)


def _clearance(moment: Moment) -> bytes:
    return _grid(moment, _computed(moment), _room(moment), _clearance_colors)


def _risk(moment: Moment) -> bytes:
    c = moment.header.config.clearance
    risk = (
        c.risk_static * occupancy(moment["grid_map.static_occ"])
        + c.risk_dynamic * occupancy(moment["grid_map.dynamic_occ"])
        + c.risk_clearance / (_room(moment) + c.risk_epsilon_m)
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
    """foxglove.Grid of ``values`` (row, col), its outer corner at ``pose``. ValueError unless finite."""
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
    """World (x, y) [m] of the outer corner of cell [0, 0] of a map (n_row, n_col) around the tank."""
    cell_m = config.mapping.cell_m
    first_x, first_y = (
        low - (count - round((high - low) / cell_m)) // 2 * cell_m
        for (low, high), count in zip(
            (config.world.tank.x_m, config.world.tank.y_m), shape[::-1], strict=True
        )
    )
    return first_x, first_y


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


_LAYERS = ("grid_map.static_occ", "grid_map.dynamic_occ", "clearance.site")
_static, _dynamic = _occupied(_LAYERS[0], (38, 44, 56)), _occupied(_LAYERS[1], (229, 57, 70))

MAP_ROWS = (
    Topic("/map/static", MAPS, GRID, _static, _LAYERS[:1], _read_layer, in_picture=True),
    Topic("/map/dynamic", MAPS, GRID, _dynamic, _LAYERS[1:2], _read_layer, in_picture=True),
    Topic("/map/clearance", MAPS, GRID, _clearance, _LAYERS[2:], _read_layer, in_picture=True),
    Topic("/map/risk", MAPS, GRID, _risk, _LAYERS),
)
