"""A world before anything runs in it: a picture, and what is wrong with it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from uuvtai.common.errors import UserError
from uuvtai.config import Config, FixedObstacle, WorldConfig
from uuvtai.logs import drawing
from uuvtai.logs.encode import checked_suffix
from uuvtai.logs.picture import save_image
from uuvtai.logs.scenario import tank_document

_CELL_M = 0.2  # of the grid on which scenarios look for a way (``kernels.world.scenario``)
_LEAST_SHARE, _ROUGH_M, _MOST_TOLD = 0.01, 0.05, 5
"""of the spawn area that is told; that an obstacle may reach through a wall; obstacles that are told"""
_CLEAR = drawing.mixed(drawing.GOAL, drawing.WATER, 0.35)


class WorldError(UserError):
    """A world in which no episode can begin, and what to change."""


def check(config: Config) -> tuple[list[str], str, np.ndarray]:
    """What to know of a world; why no episode can begin in it, or ''; and by cells (n_row, n_col), y up, 0
    where neither start nor goal fits, else the number of the free water that joins it."""
    world, cell, (n_static, n_dynamic, speed) = config.world, config.mapping.cell_m, config.world.own_scene
    across, along, deep = (side[1] - side[0] for side in (world.tank.x_m, world.tank.y_m, world.tank.z_m))
    moving = f", {n_dynamic} dynamic at {speed:g} m/s" if n_dynamic else ""
    label, share, farthest = _ground(world)
    told = [
        f"{across:g} x {along:g} m, {deep:g} m deep; a map of {round(across / cell)} x {round(along / cell)} "
        f"cells of {cell:g} m",
        f"obstacles: {len(world.fixed)} fixed; drawn anew in each episode {n_static} static{moving}",
        *(f"look at it: {text}" for text in _remarkable(world, across, along)),
        f"start and goal may be in {sum(share):.0%} of the spawn area",
    ]
    if len(parts := sorted((part for part in share if part >= _LEAST_SHARE), reverse=True)) > 1:
        clear, shares = world.static.joined_clearance_m, ", ".join(f"{part:.0%}" for part in parts[:5])
        joins = f"no way with {clear:g} m of clearance joins {len(parts)} parts of it"
        told.append(f"look at it: {joins} ({shares})")
    problem = (
        "no episode can begin: no two free places of the spawn area are joined and "
        f"{world.start_goal_gap_m:g} m apart; widen spawn_x_m and spawn_y_m, move fixed obstacles, or "
        "lower start_goal_gap_m or static.joined_clearance_m"
    )
    return told, "" if sum(share) > 0 and farthest >= world.start_goal_gap_m else problem, label


def _ground(world: WorldConfig) -> tuple[np.ndarray, list[float], float]:
    """Labels of ``check``, the share of the spawn area that each has, the farthest two cells of one [m]; by
    the rule of ``kernels.world.scenario``, of the fixed obstacles alone."""
    sides = [np.arange(low + 0.5 * _CELL_M, high, _CELL_M) for low, high in (world.tank.x_m, world.tank.y_m)]
    x, y = np.meshgrid(*sides)
    away = np.full(x.shape, np.inf)
    for obstacle in world.fixed:
        if not obstacle.path:
            np.minimum(away, _distance(obstacle, x, y), out=away)
    free = np.minimum(away, world.tank.from_wall(x, y)) >= world.static.joined_clearance_m + 0.5 * _CELL_M
    _, label = cv2.connectedComponents(free.astype(np.uint8), connectivity=4)
    spawn = np.ones(x.shape, bool)
    for place, (low, high) in ((x, world.spawn_x_m), (y, world.spawn_y_m)):  # a cell at least
        off = np.abs(place - np.clip(place, low, high))
        spawn &= off <= max(0.5 * _CELL_M - 1e-6, float(off.min()))
    label = np.where(spawn & (away >= world.static.endpoint_gap_m), label, 0)
    share, farthest = np.bincount(label.ravel())[1:] / spawn.sum(), 0.0
    for i in np.flatnonzero(share) + 1:
        hull = cv2.convexHull(np.column_stack([x[label == i], y[label == i]]).astype(np.float32))[:, 0]
        farthest = max(farthest, float(np.hypot(*(hull[:, None] - hull[None]).T).max()) + _CELL_M)
    return label, share.tolist(), farthest


def _distance(obstacle: FixedObstacle, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[m] from places to an obstacle's footprint, 0 within."""
    dx, dy, yaw = x - obstacle.x_m, y - obstacle.y_m, math.radians(obstacle.yaw_deg)
    if obstacle.half_extents_m is None or obstacle.kind != "box":
        return np.maximum(np.hypot(dx, dy) - (obstacle.radius_m or 0.0), 0.0)
    along, across = math.cos(yaw) * dx + math.sin(yaw) * dy, math.cos(yaw) * dy - math.sin(yaw) * dx
    beyond = [np.abs(v) - half for v, half in zip((along, across), obstacle.half_extents_m, strict=True)]
    return np.hypot(*np.maximum(beyond, 0.0))


def _remarkable(world: WorldConfig, across: float, along: float) -> list[str]:
    """Explicit obstacles that reach through a wall, the first few; paths of random ones that do not fit."""
    found, drawn = [], world.dynamic
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


def picture(name: str, world: WorldConfig, label: np.ndarray, out: Path) -> Path:
    """Draw tank, fixed obstacles with their paths, and where start and goal may be. Raises LogError."""
    checked_suffix(out, (".png",), "picture")
    tank, drawn = tank_document(world.tank), _drawn(world)
    (x0, x1), (y0, y1) = world.spawn_x_m, world.spawn_y_m
    canvas = drawing.map_canvas(tank, 1200, (62, 44, 74, 92))
    drawing.paint_water(canvas, tank)
    canvas.cells(np.array(_CLEAR), label > 0, (tank["x_m"][0], tank["y_m"][0]), _CELL_M)
    canvas.dashes(np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]), drawing.GREY, 1)
    for one in drawn:
        color = drawing.STATIC if one["path"] is None else drawing.DYNAMIC
        canvas.area(drawing.obstacle_outline(one, np.array(one["position"])), color)
    drawing.paint_truth(canvas, {"obstacles": [one for one in drawn if one["path"]]}, 0.0)
    drawing.paint_walls(canvas, tank)
    drawing.paint_ruler(canvas)
    canvas.text((60, 40), Path(name).stem, 24, drawing.INK, bold=True)
    x, y, (n_static, n_dynamic, _) = 62.0, canvas.size[1] - 30, world.own_scene
    legend = ((_CLEAR, "start and goal"), (drawing.STATIC, "fixed"), (drawing.DYNAMIC, "fixed, on its path"))
    for color, text in legend:
        canvas.filled(np.array([(x, y - 12), (x + 14, y - 12), (x + 14, y + 2), (x, y + 2)]), color)
        x += 22 + canvas.text((x + 22, y), text, 17, drawing.GREY) + 24
    random = f"of each episode, not drawn: {n_static} static, {n_dynamic} dynamic"
    canvas.text((x, y), random, 17, drawing.GREY)
    return save_image(canvas.image, out)


def _drawn(world: WorldConfig) -> list[dict[str, Any]]:
    """Explicit obstacles as ``obstacle_motion.describe_scenario`` has them."""
    found = []
    for one in world.fixed:
        z, size = world.center_and_size(one)
        body: dict[str, Any] = {
            "kind": one.kind,
            "position": [one.x_m, one.y_m, z],
            "size": size,
            "path": None,
        }
        if one.path:
            corners = np.array([(way.x_m, way.y_m) for way in one.path])
            length = float(np.hypot(*(np.roll(corners, -1, axis=0) - corners).T).sum())
            body["path"] = {"shape": "polyline", "corners": corners, "length_m": length, "phase_m": 0.0}
            body["path"]["speed_m_s"] = one.speed_m_s or world.dynamic_speed_m_s
        found.append(body | {"yaw": math.radians(one.yaw_deg)})
    return found
