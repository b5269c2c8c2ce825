"""A synthetic episode for tests of logs: a vehicle passes static and moving obstacles; plain NumPy."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from tests.map_bits import away, kept
from uuvtai.common import enums
from uuvtai.common.enums import NO_SITE
from uuvtai.common.obstacle_motion import obstacle_positions
from uuvtai.config import Config, SensorsConfig, SonarConfig
from uuvtai.logs.encode import EpisodeHeader
from uuvtai.logs.scenario import scenario_document
from uuvtai.logs.writer import McapEpisodeLog

DT = 0.02
N_RAY = 256
MAX_RANGE_M = 12.0
CELL_M, ORIGIN, SHAPE = 0.1, (-0.4, -0.2), (64, 208)
TERMS = ("alive", "progress", "clearance", "ttc")
NODES = ("Root", "Emergency", "Back off", "Evade", "Follow", "Follow")
START, GOAL = (2.0, 1.5, -0.8), (17.0, 4.5, -0.8)

_CIRCLE = {
    "shape": "circle", "center": [8.0, 3.0], "radius_m": -1.2, "length_m": 2 * math.pi * 1.2, "phase_m": 0.7,
    "speed_m_s": 0.6,
}  # fmt: skip
_LINE = {
    "shape": "polyline", "corners": [[12.0, 1.0], [12.5, 5.0]],
    "length_m": 2 * math.dist((12.0, 1.0), (12.5, 5.0)), "phase_m": 1.0, "speed_m_s": 0.6,
}  # fmt: skip
OBSTACLES = [
    {"slot": slot, "kind": kind, "position": position, "size": size, "yaw": yaw, "path": path}
    for slot, kind, position, size, yaw, path in (
        (0, "cylinder", [6.0, 3.6, -0.8], [0.35, 0.35, 0.8], 0.0, None),
        (1, "box", [10.0, 1.5, -0.8], [0.5, 0.3, 0.8], 0.6, None),
        (2, "cylinder", [13.5, 4.6, -0.8], [0.25, 0.25, 0.8], 0.0, None),
        (4, "sphere", [8.5, 3.0, -0.8], [0.22, 0.22, 0.22], 0.0, _CIRCLE),
        (5, "cylinder", [12.0, 1.5, -0.7], [0.2, 0.2, 0.2], 0.0, _LINE),
    )
]


def config() -> Config:
    """With an image in which ranges are detected beside Doppler, so that every topic is there."""
    sonar = SonarConfig(image_bins=24).model_copy(update={"detector": "so"})
    return Config().model_copy(update={"sensors": SensorsConfig().model_copy(update={"sonar": sonar})})


def scenario(episode: int = 3) -> dict:
    described = {
        "start": list(START), "start_yaw": 0.2, "goal": list(GOAL), "layout_draws": 1, "faults": 0,
        "obstacles": OBSTACLES,
    }  # fmt: skip
    return scenario_document(config(), described, world="pool", seed=7, episode=episode)


def header(agent: str = "bt", episode: int = 3) -> EpisodeHeader:
    return EpisodeHeader(
        agent=agent,
        config=config(),
        config_yaml="world:\n  n_static: 3\n",
        scenario=scenario(episode),
        reward_terms=TERMS,
        tree_nodes=NODES,
        git_sha="0" * 40,
    )


def snapshots(
    n_step: int, sway: float = 1.0, outcome: str = "success", maps: bool = True
) -> Iterator[dict[str, Any]]:
    """Values of steps 0 .. n_step; the vehicle drives to the goal and swings by ``sway`` metres sideways."""
    rng = np.random.default_rng(0)
    static, dynamic = np.zeros(SHAPE, np.float32), np.zeros(SHAPE, np.float32)
    for step in range(n_step + 1):
        share = step / max(n_step, 1)
        pos, yaw = _pose(share, sway)
        obstacles = np.array([obstacle_positions(body, np.array([step * DT]))[0] for body in OBSTACLES])
        ranges, hit, which = cast(pos, yaw, obstacles)
        ranges = np.where(hit, ranges + rng.normal(0, 0.02, N_RAY), ranges).astype(np.float32)
        dynamic *= 0.99
        _mark(static, dynamic, pos, yaw, ranges, hit, which)
        due = maps and (step % 25 == 0 or step == n_step)
        yield {
            "clock.step": np.int32(step),
            "termination.outcome": np.int32(enums.OUTCOMES.index(outcome if step == n_step else "running")),
            **_truth(step, pos, yaw, obstacles, ranges.min(), rng),
            **_sensed(step, pos, yaw, ranges, hit, rng),
            **_tracked(obstacles, which),
            **_planned(step, pos, _pose(min(share + 0.06, 1.0), sway)[0]),
            **_driven(step),
            **(layers(static, dynamic) if due else {}),
        }


def _single(values: dict[str, Any]) -> dict[str, Any]:
    """In the types of the simulator's arrays: float32 and int32."""
    found = {name: np.asarray(value) for name, value in values.items()}
    return {name: v.astype(np.float32 if v.dtype.kind == "f" else np.int32)[()] for name, v in found.items()}


def _truth(
    step: int,
    pos: np.ndarray,
    yaw: float,
    obstacles: np.ndarray,
    nearest_m: np.floating,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """Slot 3 is empty."""
    later = np.array([obstacle_positions(body, np.array([step * DT + 1e-3]))[0] for body in OBSTACLES])
    sizes = np.array([body["size"] for body in OBSTACLES])
    return _single({
        "vehicle.pos_w": pos, "vehicle.quat_wb": _quaternion(0.02, -0.03, yaw),
        "sonar_image.heard": np.zeros((1, 16)), "vehicle.vel_b": [0.5, 0.02, 0.0],
        "vehicle.rate_b": rng.normal(0, 0.01, 3), "current.vel_w": np.zeros(3),
        "vehicle.rpm": rng.normal(500, 20, 6), "actuation.thrust_n": rng.normal(2, 0.1, 6),
        "termination.clearance_m": np.float32(max(nearest_m - 0.17, 0.01)),
        "termination.ttc_s": 1e6 if step % 3 else 2.3, "world.kind": [2, 3, 2, 0, 1, 2],
        "world.pos_w": np.insert(obstacles, 3, 0.0, axis=0),
        "world.vel_w": np.insert((later - obstacles) / 1e-3, 3, 0.0, axis=0),
        "world.size": np.insert(sizes, 3, 0.0, axis=0), "world.yaw": [0, 0.6, 0, 0, 0, 0],
    })  # fmt: skip


def _sensed(
    step: int, pos: np.ndarray, yaw: float, ranges: np.ndarray, hit: np.ndarray, rng: np.random.Generator
) -> dict[str, Any]:
    camera = config().sensors.depth
    return _single({
        "ego.pos_w": pos + 0.01, "ego.rpy": [0.02, -0.03, yaw], "ego.vel_b": [0.5, 0.02, 0.0],
        "ego.vel_valid": 1, "ego.rate_b": np.zeros(3), "ego.depth_m": -pos[2],
        "ego.imu_rpy": [0.02, -0.03, yaw - 0.01], "ego.specific_force_b": [0.1, -0.2, 9.8],
        "ego.dvl_b": [0.51, 0.01, 0.02], "ego.given_up": 0, "ego.dvl_fresh": step % 5 == 0,
        "ego.pose_cov": [4e-4, -1e-4, 2e-5, 9e-4, -3e-5, 4e-6], "ego.z_var": 2.5e-5,
        "scan.fresh": 1, "scan.ping_step": step, "scan.range_m": ranges,
        "scan.doppler_m_s": rng.normal(-0.3, 0.05, N_RAY), "scan.intensity": rng.uniform(0.01, 1, N_RAY),
        "scan.hit": hit, "scan.new_from": 0, "scan.new_count": 0, "scan.ping_vel_b": [0.5, 0.02, 0.0],
        "image.fresh": step % 5 == 0, "image.shot_rpy": [0.02, -0.03, yaw],
        "image.depth_m": rng.uniform(0.5, 10, (camera.rows, camera.cols)),
    })  # fmt: skip


def _tracked(obstacles: np.ndarray, which: np.ndarray) -> dict[str, Any]:
    """The two that move, in slots 0 and 2; slot 1 is dead, slot 3 rests."""
    state = np.zeros((4, 4))
    state[[0, 2], :2] = obstacles[3:, :2]
    return _single({
        "tracks.alive": [1, 0, 1, 1], "tracks.moving": [1, 1, 1, 0], "tracks.state": state,
        "tracks.z_m": [obstacles[3, 2], 0, obstacles[4, 2], 0], "tracks.radius_m": [0.22, 0, 0.2, 0.5],
        "tracks.cov": np.outer([1.0, 0.0, 2.0, 1.0], np.arange(1, 11) * 1e-3),
        "tracks.turn_rate": [0.3, 0, 0, 0],
        "tracks.turn_cov": np.outer([1.0, 0, 0, 0], [1e-3, 0, 0, 0, 0.04]),
        "tracks.present": [0.95, 0, 0.6, 0.95],
        "forecast.above_w": [1e6, 0, -0.4, 0], "forecast.below_w": [-1.0, 0, -1e6, 0],
        "futures.share": [[0.0, 0.0], [0, 0], [0.1, 0.25], [0, 0]],
        "futures.pos_w": np.arange(4.0 * 2 * 3 * 2).reshape(4, 2, 3, 2),
        "forecast.pos_w": -np.arange(4.0 * 3 * 2).reshape(4, 3, 2),
        "forecast.radius_m": np.outer([0.3, -1, 0.2, -1], np.ones(3)),
        "tracks.beam_track": np.select([which == 3, which == 4], [0, 2], -1),
    })  # fmt: skip


def _planned(step: int, pos: np.ndarray, ahead: np.ndarray) -> dict[str, Any]:
    """A new route every 200 steps, the second one by RRT."""
    begun = enums.TRIGGER_STUCK if step else enums.TRIGGER_INITIAL
    return _single({
        "route.way_w": np.linspace(pos[:2], GOAL[:2], 64), "route.n_way": 40,
        "route.plan_step": step - step % 200,
        "route.planner": enums.PLANNER_RRT if step == 200 else enums.PLANNER_VORONOI,
        "route.fallback_reason": enums.FAIL_DISCONNECTED if step == 200 else enums.FAIL_NONE,
        "route.trigger": enums.TRIGGER_NONE if step % 200 else begun,
        "route.lookahead_w": [*ahead[:2], -0.8], "route.path_risk": 0.4,
    })  # fmt: skip


def _driven(step: int) -> dict[str, Any]:
    """By a tree, which evades in the last 30 of every 100 steps."""
    follows = step % 100 < 70
    outputs = ("action", "value", "std", "distillation_lambda", "residual", "uncertainty")
    return _single({
        "behavior.action": [0.8, 0.0, 0.1, -0.2],
        "behavior.status": [2, 3, 0, 3, 2, 0, 9, 9] if follows else [1, 3, 0, 1, 0, 0, 9, 9],
        "behavior.leaf": 4 if follows else 3, "behavior.want_evade": not follows and step % 5 == 0,
        "behavior.conflict_s": 1e6 if step % 2 else 0.9, "behavior.hold_conflict_s": 1e6,
        "behavior.follow_vel_w": [0.6, 0.1, 0.0], "behavior.cruise_z_m": -0.2,
        "behavior.evade_vel_w": [0.1, 0.6, 0.2], "behavior.patience": 1.0, "behavior.evade_cost": 2.5,
        "behavior.evade_candidate": -1 if step % 2 else 17, "behavior.candidate_cost": np.arange(160.0),
        "behavior.last_vel_w": [0.2, 0.5, -0.1], "reward.term": [0.01, 0.02, -0.001, 0.0],
        "agent.applied": [0.8, 0.0, 0.1, -0.2],
    }) | {f"agent.{name}": None for name in outputs}  # fmt: skip


def result(n_step: int, outcome: str = "success") -> SimpleNamespace:
    return SimpleNamespace(
        outcome=outcome, episode_return=12.5, time_s=n_step * DT, min_clearance_m=0.31,
        replans={"initial": 1, "stuck": 2}, planned_by={"voronoi": 2, "rrt": 1},
    )  # fmt: skip


def layers(static: np.ndarray, dynamic: np.ndarray) -> dict[str, np.ndarray]:
    """Layers with a clearance computed the slow and simple way, up to 1 m."""
    rows, cols = np.indices(SHAPE)
    occupied = np.maximum(static, dynamic) >= 0.5
    x, y = ORIGIN[0] + (cols + 0.5) * CELL_M, ORIGIN[1] + (rows + 0.5) * CELL_M
    occupied |= (x < 0) | (x > 20) | (y < 0) | (y > 6)
    nearest, site = np.full(SHAPE, 10.5), np.full(SHAPE, NO_SITE)
    for dr in range(-10, 11):
        for dc in range(-10, 11):
            source = np.roll(occupied, (dr, dc), (0, 1))
            source &= nearest > math.hypot(dr, dc)
            nearest[source], site[source] = math.hypot(dr, dc), away(-dr, -dc)
    return {
        "grid_map.static_occ": kept(static),
        "grid_map.dynamic_occ": kept(dynamic),
        "clearance.site": site.astype(np.int16),
    }


def cast(pos: np.ndarray, yaw: float, obstacles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(range, hit, index of the body or -1) of every beam against circles and the walls of the pool."""
    angle = yaw + 2 * np.pi * np.arange(N_RAY) / N_RAY
    ux, uy = np.cos(angle), np.sin(angle)
    with np.errstate(divide="ignore"):
        wall = np.minimum(
            np.where(ux > 0, 20 - pos[0], -pos[0]) / ux, np.where(uy > 0, 6 - pos[1], -pos[1]) / uy
        )
    best, which = wall, np.full(N_RAY, -1)
    for i, (body, at) in enumerate(zip(OBSTACLES, obstacles, strict=True)):
        dx, dy = at[0] - pos[0], at[1] - pos[1]
        along, across = ux * dx + uy * dy, ux * dy - uy * dx
        radius = body["size"][0]
        meets = (np.abs(across) < radius) & (along > 0)
        enter = np.where(meets, along - np.sqrt(np.maximum(radius**2 - across**2, 0)), np.inf)
        which = np.where(enter < best, i, which)
        best = np.minimum(best, enter)
    hit = best < MAX_RANGE_M
    return np.minimum(best, MAX_RANGE_M), hit, np.where(hit, which, -1)


def _mark(static, dynamic, pos, yaw, ranges, hit, which) -> None:
    angle = yaw + 2 * np.pi * np.arange(N_RAY) / N_RAY
    col = np.floor((pos[0] + ranges * np.cos(angle) - ORIGIN[0]) / CELL_M).astype(int)
    row = np.floor((pos[1] + ranges * np.sin(angle) - ORIGIN[1]) / CELL_M).astype(int)
    good = hit & (col >= 0) & (col < SHAPE[1]) & (row >= 0) & (row < SHAPE[0])
    for layer, chosen in ((static, which < 3), (dynamic, which >= 3)):
        keep = good & chosen
        layer[row[keep], col[keep]] = np.minimum(1.0, layer[row[keep], col[keep]] + 0.15)


def _pose(share: float, sway: float) -> tuple[np.ndarray, float]:
    start, goal = np.array(START), np.array(GOAL)
    share *= 0.94  # it arrives where the goal's radius begins
    pos = start + share * (goal - start)
    pos[1] += sway * math.sin(2 * math.pi * share)
    slope = (goal[1] - start[1]) + sway * 2 * math.pi * math.cos(2 * math.pi * share)
    return pos, math.atan2(slope, goal[0] - start[0])


def _quaternion(roll: float, pitch: float, yaw: float) -> np.ndarray:
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(0.5 * a), math.sin(0.5 * a)) for a in (roll, pitch, yaw))
    values = [
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    ]
    return np.array(values, np.float32)


def record(
    path: Path, n_step: int, described: EpisodeHeader | None = None, outcome: str = "success", **how: Any
) -> Path:
    """A log of an episode at that path; how the vehicle drives: see ``snapshots``."""
    with McapEpisodeLog(path, described or header()) as log:
        for snap in snapshots(n_step, outcome=outcome, **how):
            log.write(snap)
        log.close(result(n_step, outcome))
    return path
