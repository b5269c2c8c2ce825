"""A synthetic episode for the tests of logs and pictures: plain NumPy, no simulator. A vehicle passes resting
and moving bodies."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from uuvtai.config import Config
from uuvtai.logs.closed_form import body_positions, scenario_document
from uuvtai.snapshot import DepthLine, EpisodeEnd, EpisodeHeader, EpisodeSnapshot, MapLayers

DT = 0.02
N_RAY = 256
COLUMNS = np.arange(3, 128, 2)
"""columns of the camera that see something at the vehicle's depth"""
MAX_RANGE_M = 12.0
CELL_M, ORIGIN, SHAPE = 0.1, (-0.4, -0.2), (64, 208)
TERMS = ("alive", "progress", "clearance", "ttc")
NODES = ("Root", "Emergency", "Back off", "Evade", "Follow", "Follow")
START, GOAL = (2.0, 1.5, -0.8), (17.0, 4.5, -0.8)

BODIES = [
    {
        "slot": 0,
        "kind": "cylinder",
        "position": [6.0, 3.6, -0.8],
        "size": [0.35, 0.35, 0.8],
        "yaw": 0.0,
        "path": None,
    },
    {
        "slot": 1,
        "kind": "box",
        "position": [10.0, 1.5, -0.8],
        "size": [0.5, 0.3, 0.8],
        "yaw": 0.6,
        "path": None,
    },
    {
        "slot": 2,
        "kind": "cylinder",
        "position": [13.5, 4.6, -0.8],
        "size": [0.25, 0.25, 0.8],
        "yaw": 0.0,
        "path": None,
    },
    {
        "slot": 4,
        "kind": "sphere",
        "position": [8.5, 3.0, -0.8],
        "size": [0.22, 0.22, 0.22],
        "yaw": 0.0,
        "path": {
            "shape": "circle",
            "center": [8.0, 3.0],
            "radius_m": -1.2,
            "length_m": 2 * math.pi * 1.2,
            "phase_m": 0.7,
            "speed_m_s": 0.6,
        },
    },
    {
        "slot": 5,
        "kind": "cylinder",
        "position": [12.0, 1.5, -0.7],
        "size": [0.2, 0.2, 0.2],
        "yaw": 0.0,
        "path": {
            "shape": "polyline",
            "corners": [[12.0, 1.0], [12.5, 5.0]],
            "length_m": 2 * math.dist((12.0, 1.0), (12.5, 5.0)),
            "phase_m": 1.0,
            "speed_m_s": 0.6,
        },
    },
]


def config() -> Config:
    return Config()


def scenario(episode: int = 3) -> dict:
    described = {
        "start": list(START),
        "start_yaw": 0.2,
        "goal": list(GOAL),
        "layout_draws": 1,
        "faults": 0,
        "bodies": BODIES,
    }
    return scenario_document(config(), described, world="pool", seed=7, episode=episode)


def header(controller: str = "bt", episode: int = 3) -> EpisodeHeader:
    return EpisodeHeader(
        controller=controller,
        config_yaml="world:\n  n_static: 3\n",
        scenario=scenario(episode),
        control_dt_s=DT,
        sonar_max_range_m=MAX_RANGE_M,
        reward_terms=TERMS,
        tree_nodes=NODES,
        git_sha="0" * 40,
    )


def snapshots(
    n_step: int, sway: float = 1.0, outcome: str = "success", maps: bool = True, depth: bool = False
) -> Iterator[EpisodeSnapshot]:
    """Steps 0 .. n_step; the vehicle drives from start to goal with a sideways swing of ``sway`` metres."""
    rng = np.random.default_rng(0)
    static, dynamic = np.zeros(SHAPE, np.float32), np.zeros(SHAPE, np.float32)
    for step in range(n_step + 1):
        share = step / max(n_step, 1)
        pos, yaw = _pose(share, sway)
        bodies = np.array([body_positions(body, step * DT)[0] for body in BODIES])
        ranges, hit, which = cast(pos, yaw, bodies)
        ranges = np.where(hit, ranges + rng.normal(0, 0.02, N_RAY), ranges).astype(np.float32)
        dynamic *= 0.99
        _mark(static, dynamic, pos, yaw, ranges, hit, which)
        yield EpisodeSnapshot(
            outcome=outcome if step == n_step else "running",
            **_truth(step, pos, yaw, bodies, ranges.min(), rng),
            **_sensed(step, pos, yaw, ranges, hit, rng),
            **_planned(step, pos, _pose(min(share + 0.06, 1.0), sway)[0]),
            tracks=np.column_stack([bodies[3:], np.zeros((2, 2)), [0.22, 0.2]]).astype(np.float32),
            track_beams=np.flatnonzero(which >= 3),
            depth_image_m=rng.uniform(0.5, 10, (72, 128)).astype(np.float32)
            if depth and step % 25 == 0
            else None,
            maps=layers(static, dynamic) if maps and (step % 25 == 0 or step == n_step) else None,
        )


def _truth(
    step: int,
    pos: np.ndarray,
    yaw: float,
    bodies: np.ndarray,
    nearest_m: np.floating,
    rng: np.random.Generator,
) -> dict:
    """Slot 3 is empty."""
    later = np.array([body_positions(body, step * DT + 1e-3)[0] for body in BODIES])
    return {
        "step": step,
        "pos_w": pos.astype(np.float32),
        "quat_wb": _quaternion(0.02, -0.03, yaw),
        "vel_b": np.array([0.5, 0.02, 0.0], np.float32),
        "rate_b": rng.normal(0, 0.01, 3).astype(np.float32),
        "current_w": np.zeros(3, np.float32),
        "rpm": rng.normal(500, 20, 6).astype(np.float32),
        "thrust_n": rng.normal(2, 0.1, 6).astype(np.float32),
        "clearance_m": float(np.float32(max(nearest_m - 0.17, 0.01))),
        "ttc_s": None if step % 3 else float(np.float32(2.3)),
        "obstacle_kind": np.array([2, 3, 2, 0, 1, 2], np.int32),
        "obstacle_pos_w": np.insert(bodies, 3, 0.0, axis=0).astype(np.float32),
        "obstacle_vel_w": np.insert((later - bodies) / 1e-3, 3, 0.0, axis=0).astype(np.float32),
        "obstacle_size": np.insert(np.array([body["size"] for body in BODIES]), 3, 0.0, axis=0).astype(
            np.float32
        ),
        "obstacle_yaw": np.array([0, 0.6, 0, 0, 0, 0], np.float32),
    }


def _sensed(
    step: int, pos: np.ndarray, yaw: float, ranges: np.ndarray, hit: np.ndarray, rng: np.random.Generator
) -> dict:
    return {
        "estimate_pos_w": (pos + 0.01).astype(np.float32),
        "estimate_rpy": np.array([0.02, -0.03, yaw], np.float32),
        "measured_vel_b": np.array([0.5, 0.02, 0.0], np.float32),
        "measured_vel_valid": True,
        "measured_rate_b": np.zeros(3, np.float32),
        "depth_m": -float(pos[2]),
        "sonar_fresh": True,
        "sonar_ping_step": step,
        "sonar_range_m": ranges,
        "sonar_doppler_m_s": rng.normal(-0.3, 0.05, N_RAY).astype(np.float32),
        "sonar_intensity": rng.uniform(0.01, 1, N_RAY).astype(np.float32),
        "sonar_hit": hit.astype(np.int32),
        "sonar_ping_vel_b": np.array([0.5, 0.02, 0.0], np.float32),
        "depth_line": DepthLine(COLUMNS, COLUMNS // 4, 1.0 + COLUMNS / np.float32(64))
        if step % 5 == 0
        else None,
    }


def _planned(step: int, pos: np.ndarray, ahead: np.ndarray) -> dict:
    """A new route every 200 steps, the second one by RRT; the tree evades in the last 30 of every 100."""
    follows = step % 100 < 70
    return {
        "action_applied": np.array([0.8, 0.0, 0.1, -0.2], np.float32),
        "action_teacher": np.array([0.8, 0.0, 0.1, -0.2], np.float32),
        "route_w": np.linspace(pos[:2], GOAL[:2], 40).astype(np.float32),
        "route_fresh": step % 200 == 0,
        "route_planner": "rrt" if step == 200 else "voronoi",
        "route_fallback": "no_path" if step == 200 else "",
        "replan_trigger": "none" if step % 200 else ("initial" if step == 0 else "stuck"),
        "lookahead_w": np.array([*ahead[:2], -0.8], np.float32),
        "path_risk": 0.4,
        "tree_status": np.array([2, 3, 0, 3, 2, 0] if follows else [1, 3, 0, 1, 0, 0], np.int32),
        "tree_leaf": 4 if follows else 3,
        "reward": np.array([0.01, 0.02, -0.001, 0.0], np.float32),
    }


def result(n_step: int, outcome: str = "success") -> EpisodeEnd:
    return EpisodeEnd(outcome, 12.5, n_step * DT, 0.31, {"initial": 1, "stuck": 2}, {"voronoi": 2, "rrt": 1})


def layers(static: np.ndarray, dynamic: np.ndarray) -> MapLayers:
    """Layers with a clearance computed the slow and simple way, up to 1 m."""
    rows, cols = np.indices(SHAPE)
    occupied = np.maximum(static, dynamic) >= 0.5
    x, y = ORIGIN[0] + (cols + 0.5) * CELL_M, ORIGIN[1] + (rows + 0.5) * CELL_M
    occupied |= (x < 0) | (x > 20) | (y < 0) | (y > 6)
    clearance = np.full(SHAPE, 1.0, np.float32)
    for dr in range(-10, 11):
        for dc in range(-10, 11):
            source = np.roll(occupied, (dr, dc), (0, 1))
            clearance = np.where(source, np.minimum(clearance, CELL_M * math.hypot(dr, dc)), clearance)
    clearance = clearance.astype(np.float32)
    risk = (static + dynamic + 0.1 / (clearance + 0.1)).astype(np.float32)
    return MapLayers(ORIGIN, CELL_M, static.copy(), dynamic.copy(), clearance, risk)


def cast(pos: np.ndarray, yaw: float, bodies: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(range, hit, index of the body or -1) of every beam against circles and the walls of the pool."""
    angle = yaw + 2 * np.pi * np.arange(N_RAY) / N_RAY
    ux, uy = np.cos(angle), np.sin(angle)
    with np.errstate(divide="ignore"):
        wall = np.minimum(
            np.where(ux > 0, 20 - pos[0], -pos[0]) / ux, np.where(uy > 0, 6 - pos[1], -pos[1]) / uy
        )
    best, which = wall, np.full(N_RAY, -1)
    for i, (body, at) in enumerate(zip(BODIES, bodies, strict=True)):
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
