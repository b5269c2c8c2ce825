"""Topics of planning: the route, the point that is steered at, what the agent decided."""

from __future__ import annotations

import functools
import json
import math
from typing import Any

import numpy as np

from uuvtai.common.enums import PLANNERS, REASONS, TRIGGERS
from uuvtai.logs.encode import (
    EVADING,
    EVERY_STEP,
    REPLAN,
    EpisodeHeader,
    Moment,
    Topic,
    dumped,
    line,
    number,
    number_or_null,
    numbers,
    numbers_or_null,
    pose_in_frame,
    scene_entity,
    scene_update,
    vector,
)
from uuvtai.logs.schemas import (
    FOUR,
    INT,
    NUMBER,
    POINT3,
    POSE_IN_FRAME,
    SCENE_UPDATE,
    STRING,
    THREE,
    Schema,
    array_of,
    described,
    record,
)

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

PLAN_ROWS = (
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


# ---- What drives: action, policy, safety, behaviour tree.

_FAR = 1e5  # A time to collision beyond stands for "nothing closes in" in the simulator.
_STATUSES = ("IDLE", "RUNNING", "SUCCESS", "FAILURE")  # by the codes of ``tree_codes``

_ACTION = record(
    "uuv.Action",
    "Surge, sway, heave and yaw rate, each in [-1, 1].",
    {"policy": FOUR, "behavior": FOUR},
    applied=described(FOUR, "what drove the step that led here"),
    asked=described(THREE, "[m/s] velocity that the tree asks for, world"),
    thrust=described(array_of(NUMBER), "[N] of each thruster"),
    given_up=described(
        INT, "number from 1 of the vertical thruster taken for dead; -1 = one is suspected, 0 = none"
    ),
    leaf=described(STRING, "node of the tree that sets the behaviour tree's action"),
)
_SAFETY = record(
    "uuv.Safety",
    "As the termination check looks at it, from the truth; path_risk and replan_trigger are the vehicle's "
    "own.",
    {"ttc_s": described(NUMBER, "null = nothing closes in")},
    clearance_m=described(NUMBER, "hull to the nearest obstacle or wall"),
    path_risk=NUMBER,
    replan_trigger=described(STRING, "none, initial, stuck, safety or intersection"),
)


_EVASION = record(
    "uuv.Evasion",
    "What the behaviour tree weighs where following the route conflicts, or lately did, and with /futures of "
    "the same time what it weighs it by: scenario.json says how (candidates, evasion_cost, evasion_choice). "
    "Velocities: world.",
    {
        "conflict_s": described(NUMBER, "first conflict of following the route; null = none"),
        "hold_conflict_s": described(NUMBER, "first conflict of stopping here; null = none"),
    },
    follow=described(THREE, "[m/s] velocity that follows the route"),
    cruise_z=described(NUMBER, "[m] world z that is cruised at"),
    velocity=described(THREE, "[m/s] evasive velocity of least cost"),
    cost=described(NUMBER, "of that velocity"),
    candidate=described(INT, "its number among the candidates; -1 = the mean of the best ones"),
    costs=described(array_of(NUMBER), "of every candidate"),
    position=described(THREE, "[m] own, as estimated"),
    own_velocity=described(THREE, "[m/s] body frame, as measured or estimated"),
    yaw=described(NUMBER, "[rad] own, as estimated"),
    patience=described(NUMBER, "share of caution and closing_s that waiting has left"),
    z_variance=described(NUMBER, "[m^2] of the estimated z"),
    place_variance=described(NUMBER, "[m^2] of the estimated x and y in their worst direction"),
)


def _policy_schema(header: EpisodeHeader) -> Schema:
    return record(
        "uuv.Policy",
        "Null where there is no policy or world model. Reward terms are weighted; `reward` is their sum.",
        {"value": NUMBER, "std": FOUR, "lambda": NUMBER, "wm_residual": NUMBER, "wm_uncertainty": NUMBER},
        reward=NUMBER,
        **dict.fromkeys(header.reward_terms, NUMBER),
    )


def _tree_schema(header: EpisodeHeader) -> Schema:
    status: Schema = {"type": "string", "enum": list(_STATUSES)}
    return record("uuv.Tree", "The behaviour tree's tick.", **dict.fromkeys(header.nodes, status))


def _action(moment: Moment) -> bytes:
    node = int(moment["behavior.leaf"])
    leaf = "" if node < 0 else moment.header.nodes[node]
    return (
        f'{{"policy":{numbers_or_null(moment["agent.action"])},'
        f'"behavior":{numbers(moment["behavior.action"])},'
        f'"applied":{numbers(moment["agent.applied"])},'
        f'"asked":{numbers(moment["behavior.last_vel_w"])},'
        f'"thrust":{numbers(moment["actuation.thrust_n"])},"given_up":{int(moment["ego.given_up"])},'
        f'"leaf":{json.dumps(leaf)}}}'
    ).encode()


def _policy(moment: Moment) -> bytes:
    terms = moment["reward.term"]
    rewards = "".join(
        f'"{name}":{number(value)},' for name, value in zip(moment.header.reward_terms, terms, strict=True)
    )
    return (
        f'{{"value":{number_or_null(moment["agent.value"])},'
        f'"std":{numbers_or_null(moment["agent.std"])},'
        f'"reward":{number(float(np.sum(terms)))},{rewards}'
        f'"lambda":{number_or_null(moment["agent.distillation_lambda"])},'
        f'"wm_residual":{number_or_null(moment["agent.residual"])},'
        f'"wm_uncertainty":{number_or_null(moment["agent.uncertainty"])}}}'
    ).encode()


def _worst_variance(cov: np.ndarray) -> float:
    """[m^2] of x and y in their worst direction; ``cov``: upper triangle of x, y and heading."""
    xx, xy, yy = (float(cov[i]) for i in (0, 1, 3))
    return 0.5 * (xx + yy) + math.hypot(0.5 * (xx - yy), xy)


def _evasion(moment: Moment) -> bytes:
    first, hold = (
        number_or_null(None if moment[f"behavior.{name}"] > _FAR else float(moment[f"behavior.{name}"]))
        for name in ("conflict_s", "hold_conflict_s")
    )
    return (
        f'{{"conflict_s":{first},"hold_conflict_s":{hold},'
        f'"follow":{numbers(moment["behavior.follow_vel_w"])},'
        f'"cruise_z":{number(moment["behavior.cruise_z_m"])},'
        f'"velocity":{numbers(moment["behavior.evade_vel_w"])},'
        f'"cost":{number(moment["behavior.evade_cost"])},"candidate":{int(moment["behavior.evade_candidate"])},'
        f'"costs":{numbers(moment["behavior.candidate_cost"])},'
        f'"position":{numbers(moment["ego.pos_w"])},"own_velocity":{numbers(moment["ego.vel_b"])},'
        f'"yaw":{number(moment["ego.rpy"][2])},"patience":{number(moment["behavior.patience"])},'
        f'"z_variance":{number(moment["ego.z_var"])},'
        f'"place_variance":{number(_worst_variance(moment["ego.pose_cov"]))}}}'
    ).encode()


def _safety(moment: Moment) -> bytes:
    ttc_s = float(moment["termination.ttc_s"])
    return (
        f'{{"clearance_m":{number(moment["termination.clearance_m"])},'
        f'"ttc_s":{number_or_null(None if ttc_s > _FAR else ttc_s)},'
        f'"path_risk":{number(moment["route.path_risk"])},"replan_trigger":"{trigger_of(moment)}"}}'
    ).encode()


def _tree(moment: Moment) -> bytes:
    nodes = moment.header.nodes
    return _tree_text(nodes, tuple(moment["behavior.status"][: len(nodes)].tolist()))


@functools.lru_cache(maxsize=4096)
def _tree_text(nodes: tuple[str, ...], codes: tuple[int, ...]) -> bytes:
    """The same few ticks come again and again: their texts are kept."""
    return dumped(dict(zip(nodes, (_STATUSES[code] for code in codes), strict=True)))


_DECISION = (
    *("conflict_s", "hold_conflict_s", "follow_vel_w", "cruise_z_m", "evade_vel_w", "evade_cost"),
    *("evade_candidate", "candidate_cost", "patience"),
)
_OWN = ("ego.pos_w", "ego.vel_b", "ego.rpy", "ego.z_var", "ego.pose_cov")

AGENT_ROWS = (
    Topic(
        "/action",
        EVERY_STEP,
        _ACTION,
        _action,
        (
            *("agent.action", "agent.applied", "behavior.action", "behavior.last_vel_w", "behavior.leaf"),
            *("actuation.thrust_n", "ego.given_up"),
        ),
        lambda data: data.get("leaf", ""),
    ),
    Topic(
        "/policy",
        EVERY_STEP,
        _policy_schema,
        _policy,
        (
            "reward.term",
            *(f"agent.{name}" for name in ("value", "std", "distillation_lambda", "residual", "uncertainty")),
        ),
        varies="Each term of the reward under its own name ([`reward`](configuration/reward.md)): number",
    ),
    Topic("/evasion", EVADING, _EVASION, _evasion, (*(f"behavior.{name}" for name in _DECISION), *_OWN)),
    Topic(
        "/safety",
        EVERY_STEP,
        _SAFETY,
        _safety,
        ("termination.clearance_m", "termination.ttc_s", "route.path_risk", "route.trigger"),
        lambda data: (data["clearance_m"], data["ttc_s"], data["replan_trigger"]),
        in_picture=True,
        note="; truth",
    ),
    Topic(
        "/tree",
        EVERY_STEP,
        _tree_schema,
        _tree,
        ("behavior.status",),
        varies="Each node of the behaviour tree by its name: its status as text",
    ),
)
