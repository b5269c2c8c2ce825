"""What the planner found, and the point that is steered at."""

from __future__ import annotations

from typing import Any

import numpy as np

from uuvtai.logs.encode import dumped, line, pose_in_frame, scene_entity, scene_update, vector
from uuvtai.logs.moment import Moment
from uuvtai.logs.schemas import POINT3, POSE_IN_FRAME, SCENE_UPDATE, STRING, array_of, described, record
from uuvtai.logs.topic import EVERY_STEP, REPLAN, Topic
from uuvtai.plan_codes import PLANNERS, REASONS, TRIGGERS

_ROUTE_COLOR = (0.13, 0.55, 0.9, 1.0)

_PLAN = record(
    "uuv.Plan",
    points=described(array_of(POINT3), "[m] waypoints in the world frame"),
    planner=described(STRING, "who planned: voronoi or rrt; none = both failed"),
    trigger=described(STRING, "why: initial, stuck, safety or intersection"),
    fallback=described(STRING, "why the Voronoi planner failed, empty = it did not"),
)


def waypoints_of(moment: Moment) -> np.ndarray:
    """(n, 3) [m] of the route, at the depth of the goal."""
    level = np.asarray(moment["route.way_w"][: int(moment["route.n_way"])], float)
    return np.column_stack([level, np.full(len(level), moment.header.scenario["goal"][2])])


def planner_of(moment: Moment) -> str:
    """Who planned the route."""
    return code_name(PLANNERS, moment["route.planner"])


def fallback_of(moment: Moment) -> str:
    """Why the Voronoi planner failed, empty = it did not."""
    return code_name(REASONS, moment["route.fallback_reason"], "")


def trigger_of(moment: Moment) -> str:
    """Why a route was planned in this step."""
    return code_name(TRIGGERS, moment["route.trigger"])


def code_name(names: tuple[str, ...], code: int, nothing: str = "none") -> str:
    """Name of a code that counts from 1; 0 = ``nothing``."""
    return names[int(code) - 1] if code > 0 else nothing


def _strip(moment: Moment) -> bytes:
    strip = line(waypoints_of(moment), _ROUTE_COLOR, 0.04)
    return scene_update(scene_entity(moment.time_ns, "route", lines=[strip]))


def _plan(moment: Moment) -> bytes:
    plan = {
        "points": [vector(point) for point in waypoints_of(moment)],
        "planner": planner_of(moment),
        "trigger": trigger_of(moment),
        "fallback": fallback_of(moment),
    }
    return dumped(plan)


def _read_plan(data: dict[str, Any]) -> tuple[np.ndarray, str]:
    """((n, 2) points, why)."""
    points = [(point["x"], point["y"]) for point in data["points"]]
    return np.array(points).reshape(-1, 2), data["trigger"]


def _read_lookahead(data: dict[str, Any]) -> tuple[float, float]:
    place = data["pose"]["position"]
    return place["x"], place["y"]


ROUTE = ("route.n_way", "route.way_w")
SOURCE = ("route.planner", "route.fallback_reason", "route.trigger")

ROWS = (
    Topic("/plan", REPLAN, SCENE_UPDATE, _strip, ROUTE),
    Topic("/plan/info", REPLAN, _PLAN, _plan, (*ROUTE, *SOURCE), _read_plan, in_picture=True),
    Topic(
        "/plan/lookahead",
        EVERY_STEP,
        POSE_IN_FRAME,
        lambda moment: pose_in_frame(moment.stamp, moment["route.lookahead_w"], (1, 0, 0, 0)),
        ("route.lookahead_w",),
        _read_lookahead,
        note=" with a route",
    ),
)
