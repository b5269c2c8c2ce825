"""How much danger a scenario holds for who does not look: a ride along the straight line from start to goal
at cruise speed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from uuvtai.config import Config
from uuvtai.privileged.obstacles import (
    Array,
    Obstacle,
    level_excess,
    obstacles_of,
    rounding_m,
    upright_excess,
)


@dataclass(frozen=True)
class BlindRide:
    """What one such ride meets."""

    time_s: float
    """until the goal's radius is reached"""
    threats: int
    """moving bodies that come within the collision clearance of the hull, each counted once"""


def ride_blindly(scenario: dict[str, Any], config: Config) -> BlindRide:
    """Ride through a scenario (``describe_scenario``'s document): nose ahead, at full speed at once,
    through whatever is met."""
    start, goal, rules = np.array(scenario["start"]), np.array(scenario["goal"]), config.episode
    away = float(np.linalg.norm(goal - start))
    way = max(away - rules.goal_radius_m, 0.0)
    course = (goal - start) / max(away, 1e-9)
    speed_m_s = min(config.teacher.cruise_m_s, config.vehicle.max_surge_m_s)
    t = np.arange(0.0, way / speed_m_s + rules.control_dt_s, rules.control_dt_s)
    middle = start + speed_m_s * t[:, None] * course
    moving = [body for body in obstacles_of(scenario, t) if body.moves]
    return BlindRide(
        float(t[-1]),
        sum(_nearest_m(middle, course, body, config) < rules.collision_clearance_m for body in moving),
    )


def _nearest_m(middle: Array, course: Array, body: Obstacle, config: Config) -> float:
    """Least clearance [m] of a hull that goes through ``middle`` (n_t, 3); a capsule seen as three balls,
    which adds less than 2 cm."""
    gaps = []
    for along in (-1.0, 0.0, 1.0):
        off = middle + along * config.vehicle.hull_half_length_m * course - body.pos_w
        ox, oy = level_excess(body, off[:, 0], off[:, 1])
        gaps.append(np.sqrt(ox**2 + oy**2 + upright_excess(body, off[:, 2]) ** 2).min())
    return float(min(gaps)) - rounding_m(body) - config.vehicle.hull_radius_m
