"""A world before anything runs in it: a picture, and what is wrong with it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from uuvtai.common.errors import UserError
from uuvtai.config import Config, FixedObstacle, WorldConfig
from uuvtai.logs import drawing
from uuvtai.logs.encode import checked_suffix
from uuvtai.logs.picture import save_image
from uuvtai.logs.scenario import tank_document

_CELL_M = 0.2
"""of the grid on which scenarios look for a way (``kernels.world.scenario``)"""
_LEAST_SHARE, _ROUGH_M, _MOST_TOLD = 0.01, 0.05, 5
"""of the spawn area that is told; that an obstacle may reach through a wall; obstacles that are told"""
_CLEAR = drawing.mixed(drawing.GOAL, drawing.WATER, 0.35)


class WorldError(UserError):
    """A world in which no episode can begin, and what to change."""


class Ground(NamedTuple):
    """Where episodes may begin, by cells (n_row, n_col), y up."""

    label: np.ndarray
    """0 = neither start nor goal fits here; else the number of the free water that it belongs to"""
    share: list[float]
    """of the spawn area, of each number from 1 on"""
    is_possible: bool
    """some two cells of one number are far enough apart"""


def refuse(name: str, world: WorldConfig, ground: Ground) -> None:
    """Raise WorldError where no episode can begin."""
    if not ground.is_possible:
        raise WorldError(
            f"{name}: no episode can begin: no two free places of the spawn area are joined and "
            f"{world.start_goal_gap_m:g} m apart; widen spawn_x_m and spawn_y_m, move fixed obstacles, or "
            "lower start_goal_gap_m or static.joined_clearance_m"
        )


def check(config: Config) -> tuple[list[str], Ground]:
    """What to know and what to mend of a world."""
    world, ground, cell = config.world, _ground(config.world), config.mapping.cell_m
    (n_static, n_dynamic, speed), (across, along, deep) = world.own_scene, _sides(world)
    moving = f", {n_dynamic} dynamic at {speed:g} m/s" if n_dynamic else ""
    told = [
        f"{across:g} x {along:g} m, {deep:g} m deep; a map of {round(across / cell)} x {round(along / cell)} "
        f"cells of {cell:g} m",
        f"obstacles: {len(world.fixed)} fixed; drawn anew in each episode {n_static} static{moving}",
    ]
    told += [f"look at it: {text}" for text in _remarkable(world)]
    free, parts = sum(ground.share), [share for share in ground.share if share >= _LEAST_SHARE]
    told.append(f"start and goal may be in {free:.0%} of the spawn area")
    if len(parts) > 1:
        shares = ", ".join(f"{share:.0%}" for share in sorted(parts, reverse=True)[:5])
        clear = f"{world.static.joined_clearance_m:g} m"
        told.append(f"look at it: no way with {clear} of clearance joins {len(parts)} parts of it ({shares})")
    return told, ground


def _sides(world: WorldConfig) -> tuple[float, float, float]:
    x, y, z = (high - low for low, high in (world.tank.x_m, world.tank.y_m, world.tank.z_m))
    return x, y, z


def _remarkable(world: WorldConfig) -> list[str]:
    """Explicit obstacles that reach through a wall, the first few; paths of random ones that do not fit."""
    (across, along, _), found, drawn = _sides(world), [], world.dynamic
    for i, one in enumerate(_drawn(world)):
        places = np.array([one["position"][:2], *(one["path"] or {"corners": []})["corners"]])
        outlines = np.concatenate([drawing.obstacle_outline(one, at) for at in places])
        out = -float(world.tank.from_wall(*outlines.T).min())
        if out > _ROUGH_M and len(found) < _MOST_TOLD:
            found.append(f"fixed.{i} ({one['kind']}) reaches {out:.2f} m through a side wall")
    if world.n_dynamic and drawn.motion == "line_circle":
        wide, long = 2 * (drawn.circle_radius_m[1] + drawn.radius_m[1]), drawn.line_length_m[1]
        if drawn.circle_fraction > 0 and wide > min(across, along):
            found.append(f"circles of dynamic.circle_radius_m, {wide:g} m wide, do not fit the tank")
        if drawn.circle_fraction < 1 and long > math.hypot(across, along):
            found.append(f"lines of dynamic.line_length_m, {long:g} m long, do not fit the tank")
    return found


def _ground(world: WorldConfig) -> Ground:
    """By the same rule as ``kernels.world.scenario``, of the fixed obstacles alone."""
    (x0, x1), (y0, y1) = world.tank.x_m, world.tank.y_m
    x = x0 + (np.arange(math.ceil((x1 - x0) / _CELL_M - 1e-9)) + 0.5) * _CELL_M
    y = y0 + (np.arange(math.ceil((y1 - y0) / _CELL_M - 1e-9)) + 0.5) * _CELL_M
    x, y = np.meshgrid(x, y)
    away = np.full(x.shape, np.inf)
    for obstacle in world.fixed:
        if not obstacle.path:
            np.minimum(away, _distance(obstacle, x, y), out=away)
    free = np.minimum(away, world.tank.from_wall(x, y)) >= world.static.joined_clearance_m + 0.5 * _CELL_M
    _, label = cv2.connectedComponents(free.astype(np.uint8), connectivity=4)
    spawn = np.zeros(x.shape, bool)
    spawn[_cells(*world.spawn_y_m, y0, len(x)), _cells(*world.spawn_x_m, x0, x.shape[1])] = True
    label = np.where(spawn & (away >= world.static.endpoint_gap_m), label, 0)
    share = [float((label == i).sum() / spawn.sum()) for i in range(1, int(label.max()) + 1)]
    farthest = 0.0
    for i in range(1, len(share) + 1):
        if share[i - 1]:
            hull = cv2.convexHull(np.column_stack([x[label == i], y[label == i]]).astype(np.float32))[:, 0]
            farthest = max(farthest, float(np.hypot(*(hull[:, None] - hull[None]).T).max()) + _CELL_M)
    return Ground(label, share, farthest >= world.start_goal_gap_m and sum(share) > 0)


def _cells(low: float, high: float, first: float, count: int) -> slice:
    """Cells of a range, of which there is one at least."""
    begin = min(math.floor((low - first) / _CELL_M + 1e-6), count - 1)
    return slice(begin, max(begin + 1, math.ceil((high - first) / _CELL_M - 1e-6)))


def _distance(obstacle: FixedObstacle, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[m] from places to an obstacle's footprint, 0 within."""
    dx, dy = x - obstacle.x_m, y - obstacle.y_m
    if obstacle.kind != "box":
        return np.maximum(np.hypot(dx, dy) - (obstacle.radius_m or 0.0), 0.0)
    (a, b), yaw = obstacle.half_extents_m or (0.0, 0.0), math.radians(obstacle.yaw_deg)
    along, across = (math.cos(yaw) * dx + math.sin(yaw) * dy, math.cos(yaw) * dy - math.sin(yaw) * dx)
    return np.hypot(np.maximum(np.abs(along) - a, 0.0), np.maximum(np.abs(across) - b, 0.0))


def picture(name: str, config: Config, ground: Ground, out: Path) -> Path:
    """Draw tank, fixed obstacles with their paths, and where start and goal may be. Raises LogError."""
    checked_suffix(out, (".png",), "picture")
    world, tank = config.world, tank_document(config.world.tank)
    canvas = drawing.map_canvas(tank, 1200, (62, 44, 74, 92))
    drawing.paint_water(canvas, tank)
    canvas.cells(np.array(_CLEAR), ground.label > 0, (tank["x_m"][0], tank["y_m"][0]), _CELL_M)
    (x0, x1), (y0, y1) = world.spawn_x_m, world.spawn_y_m
    canvas.dashes(np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]), drawing.GREY, 1)
    drawn = _drawn(world)
    for obstacle in drawn:
        color = drawing.STATIC if obstacle["path"] is None else drawing.DYNAMIC
        canvas.area(drawing.obstacle_outline(obstacle, np.array(obstacle["position"])), color)
    drawing.paint_truth(canvas, {"obstacles": [one for one in drawn if one["path"]]}, 0.0)
    drawing.paint_walls(canvas, tank)
    drawing.paint_ruler(canvas)
    canvas.text((60, 40), Path(name).stem, 24, drawing.INK, bold=True)
    n_static, n_dynamic, _ = world.own_scene
    x, y = 62.0, canvas.size[1] - 30
    for color, text in (
        (_CLEAR, "start and goal"),
        (drawing.STATIC, "fixed"),
        (drawing.DYNAMIC, "fixed, on its path"),
    ):
        canvas.filled(np.array([(x, y - 12), (x + 14, y - 12), (x + 14, y + 2), (x, y + 2)]), color)
        x += 22 + canvas.text((x + 22, y), text, 17, drawing.GREY) + 24
    if n_static + n_dynamic:
        canvas.text(
            (x, y), f"of each episode, not drawn: {n_static} static, {n_dynamic} dynamic", 17, drawing.GREY
        )
    return save_image(canvas.image, out)


def _drawn(world: WorldConfig) -> list[dict[str, Any]]:
    """Explicit obstacles as ``obstacle_motion.describe_scenario`` has them."""
    found = []
    for one in world.fixed:
        z, size = world.center_and_size(one)
        corners = np.array([(way.x_m, way.y_m) for way in one.path])
        path = None
        if one.path:
            speed = world.dynamic_speed_m_s if one.speed_m_s is None else one.speed_m_s
            length = float(np.hypot(*(np.roll(corners, -1, axis=0) - corners).T).sum())
            path = {"shape": "polyline", "corners": corners, "length_m": length}
            path |= {"phase_m": 0.0, "speed_m_s": speed}
        place = {"kind": one.kind, "position": [one.x_m, one.y_m, z], "size": size}
        found.append(place | {"yaw": math.radians(one.yaw_deg), "path": path})
    return found
