"""Where the bodies of a scenario are at given times, and how far points are from them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from uuvtai.closed_form import body_positions, path_positions

Array = np.ndarray

_BEFORE_S = 1e-4
"""Velocities are differences over this time: exact but for the moment of a sharp turn."""


@dataclass(frozen=True)
class Obstacle:
    """One body of a scenario."""

    kind: str
    """sphere, cylinder or box"""
    size: Array
    """(3,) [m] as in ``WorldState``"""
    yaw: float
    pos_w: Array
    """(n_t, 3) [m]; n_t = 1 for a body at rest"""
    vel_w: Array
    """(n_t, 2) [m/s] horizontal"""

    @property
    def moves(self) -> bool:
        """Whether it has a path and a speed."""
        return bool(np.any(self.vel_w))

    @property
    def radius_m(self) -> float:
        """Radius of the circle that holds its plan view."""
        return float(np.hypot(*self.size[:2]) if self.kind == "box" else self.size[0])


def obstacles_of(scenario: dict[str, Any], t_s: Array) -> list[Obstacle]:
    """Bodies of a ``describe_scenario`` document at the times ``t_s`` (n_t,) [s] since the start."""
    return [_obstacle(body, t_s) for body in scenario["bodies"]]


def _obstacle(body: dict[str, Any], t_s: Array) -> Obstacle:
    pos, vel = np.array([body["position"]], float), np.zeros((1, 2))
    path = body["path"]
    if path is not None and path["speed_m_s"] > 0:
        pos = body_positions(body, t_s)
        vel = (pos[:, :2] - path_positions(path, t_s - _BEFORE_S)) / _BEFORE_S
    return Obstacle(body["kind"], np.array(body["size"], float), float(body["yaw"]), pos, vel)


def level_excess(body: Obstacle, dx: Array, dy: Array) -> tuple[Array, Array]:
    """(x, y) parts [m] of the way from the body's core to points at (dx, dy) from its middle; the core of a
    sphere is its centre."""
    if body.kind == "sphere":
        return dx, dy
    if body.kind == "cylinder":
        share = np.maximum(1.0 - body.size[0] / np.maximum(np.hypot(dx, dy), 1e-9), 0.0)
        return dx * share, dy * share
    c, s = np.cos(body.yaw), np.sin(body.yaw)
    x, y = c * dx + s * dy, c * dy - s * dx
    x, y = x - np.clip(x, -body.size[0], body.size[0]), y - np.clip(y, -body.size[1], body.size[1])
    return c * x - s * y, s * x + c * y


def upright_excess(body: Obstacle, dz: Array) -> Array:
    """z part [m] of that way."""
    return dz if body.kind == "sphere" else dz - np.clip(dz, -body.size[2], body.size[2])


def rounding_m(body: Obstacle) -> float:
    """[m] from the core to the surface."""
    return float(body.size[0]) if body.kind == "sphere" else 0.0
