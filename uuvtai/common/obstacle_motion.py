"""One scenario in closed form: what is in it, and where its obstacles are at any time.

Plain Python and NumPy in float64. The simulator moves its obstacles by the same formula in float32
(``kernels/world/motion.py``); logs, pictures and the oracles take it from here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

KIND_NAMES = {1: "sphere", 2: "cylinder", 3: "box"}  # by code of ``kernels.core.geometry``; others are empty

Read = Callable[[str], np.ndarray]  # One env's row of a field of the state, by 'struct.field'.


def describe_scenario(read: Read) -> dict[str, Any]:
    """One scenario as a document: where every obstacle is at any time follows from this
    (``obstacle_positions``).

    Positions [m] in the world frame, angles [rad], times from the episode's start.
    """
    kind, pos, size, yaw = (read(f"world.{name}") for name in ("kind", "pos_w", "size", "yaw"))
    path = {
        name: read(f"path.{name}")
        for name in ("n_way", "way_w", "radius_m", "length_m", "phase_m", "speed_m_s", "easing_m")
    }
    first_moving = len(kind) - len(path["n_way"])
    obstacles = []
    for slot in range(len(kind)):
        if kind[slot] in KIND_NAMES:
            lane = slot - first_moving
            row = {name: rows[lane] for name, rows in path.items()} if lane >= 0 else {}
            body = {
                "slot": slot,
                "kind": KIND_NAMES[int(kind[slot])],
                "position": pos[slot].tolist(),
                "size": size[slot].tolist(),
                "yaw": float(yaw[slot]),
                "path": path_document(row) if row else None,
            }
            obstacles.append(body)
    return {
        "start": read("mission.start_w").tolist(),
        "start_yaw": float(read("mission.start_yaw")),
        "goal": read("mission.goal_w").tolist(),
        "layout_draws": int(read("world.draws")),
        "unclear_paths": int(read("world.unclear_paths")),
        "faults": int(read("world.faults")),
        "obstacles": obstacles,
    }


def path_document(row: dict[str, Any]) -> dict[str, Any]:
    """The path of one moving obstacle, by its row of each field of ``PathState``."""
    common = {key: float(row[key]) for key in ("length_m", "phase_m", "speed_m_s")}
    if row["n_way"] == 0:
        circle = {"shape": "circle", "center": row["way_w"][0].tolist(), "radius_m": float(row["radius_m"])}
        return circle | common
    if row["easing_m"] > 0:
        common["easing_m"] = float(row["easing_m"])
    return {"shape": "polyline", "corners": row["way_w"][: int(row["n_way"])].tolist(), **common}


def path_positions(path: dict[str, Any], times_s: np.ndarray) -> np.ndarray:
    """(n, 2) [m] along a document's path at these times (n,) [s]."""
    arc = (path["phase_m"] + path["speed_m_s"] * np.asarray(times_s, float)) % path["length_m"]
    if path["shape"] == "circle":
        angle = arc / path["radius_m"]  # negative = clockwise
        ahead = np.column_stack([np.cos(angle), np.sin(angle)])
        return np.array(path["center"]) + abs(path["radius_m"]) * ahead
    corners = np.array(path["corners"], float)
    legs = np.roll(corners, -1, axis=0) - corners
    length = np.linalg.norm(legs, axis=1)
    begun = np.concatenate([[0.0], np.cumsum(length)[:-1]])
    leg = np.searchsorted(begun, arc, side="right") - 1
    share = np.minimum((arc - begun[leg]) / np.maximum(length[leg], 1e-9), 1.0)
    place = corners[leg] + share[:, None] * legs[leg]
    if easing_m := path.get("easing_m", 0.0):  # turns are parabolas: see ``kernels.world.motion.bend``
        along = legs / length[:, None]
        turns = along - np.roll(along, 1, axis=0)
        gone, leg_m = share * length[leg], length[leg]
        for corner, away_m in ((leg, gone), ((leg + 1) % len(legs), leg_m - gone)):
            size = np.linalg.norm(turns[corner], axis=1)
            inside = np.maximum(0.5 * easing_m * size - away_m, 0.0)
            place += turns[corner] * (0.5 * inside**2 / np.maximum(easing_m * size, 1e-9))[:, None]
    return place


def obstacle_positions(body: dict[str, Any], times_s: np.ndarray) -> np.ndarray:
    """Centres (n, 3) [m] of a document's body at these times (n,) [s]."""
    if body["path"] is None:
        return np.tile(np.array(body["position"], float), (len(times_s), 1))
    level = path_positions(body["path"], times_s)
    return np.column_stack([level, np.full(len(level), float(body["position"][2]))])
