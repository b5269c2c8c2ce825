"""Bodies in the water: goal and tank, the true ones, and those that the vehicle believes in."""

from __future__ import annotations

from typing import Any

import numpy as np

from uuvtai.closed_form import KIND_NAMES
from uuvtai.logs.encode import (
    checked,
    color,
    line,
    number,
    number_or_null,
    numbers,
    scene_entity,
    scene_update,
    upright_pose,
    vector,
)
from uuvtai.logs.moment import Moment
from uuvtai.logs.schemas import (
    LINE_LOOP,
    NUMBER,
    SCENE_UPDATE,
    THREE,
    UINT,
    Schema,
    array_of,
    described,
    record,
)
from uuvtai.logs.topic import EVADING, NEW_SCAN, OBSTACLES, Topic

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
    "Moving bodies that the vehicle believes in.",
    tracks=array_of(_TRACK),
    beams=described(array_of(UINT), "beams of the newest scan that a moving body explains"),
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
_FREE_M = 1e5
"""Bounds beyond are no bounds."""


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
    """Outline of floor and surface."""
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
    """(slot, kind) of the bodies, in the order of scenario.json."""
    codes = moment["world.kind"].tolist()
    return [(slot, KIND_NAMES[code]) for slot, code in enumerate(codes) if code in KIND_NAMES]


def _scene(moment: Moment) -> bytes:
    """The true bodies; those that never move come first."""
    shapes: dict[str, list] = {"spheres": [], "cylinders": [], "cubes": []}
    n_rest = sum(body["path"] is None for body in moment.header.scenario["bodies"])
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
    """The true bodies as numbers."""
    bodies = []
    for slot, kind in _kinds(moment):
        size = moment["world.size"][slot][_SIZES[kind]].tolist()
        place, motion = moment["world.pos_w"][slot].tolist(), moment["world.vel_w"][slot].tolist()
        bodies.append(_TRUTH[kind] % (*place, *size, float(moment["world.yaw"][slot]), *motion))
    return f'{{"obstacles":[{checked(",".join(bodies))}]}}'.encode()


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
    """(n, 3) x, y, radius."""
    return np.array([(t["x"], t["y"], t["radius"]) for t in data["tracks"]]).reshape(-1, 3)


_BODIES = ("world.kind", "world.pos_w", "world.size", "world.yaw")

ROWS = (
    Topic("/goal", OBSTACLES, SCENE_UPDATE, _goal),
    Topic("/obstacles", OBSTACLES, SCENE_UPDATE, _scene, _BODIES, note="; truth"),
    Topic("/obstacles/truth", OBSTACLES, _OBSTACLES, _truth, (*_BODIES, "world.vel_w"), note="; truth"),
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
    ),
)
