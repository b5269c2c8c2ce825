"""scenario.json: everything true about an episode's world in closed form, and how to recompute what the log claims from it."""

from __future__ import annotations

from typing import Any

import numpy as np

FRAMES = {
    "world": "z up, x along the tank, y across, z = 0 at the surface [m]",
    "base": "vehicle at its centre of mass, x ahead, y left, z up",
    "sonar": "at the vehicle, turned with its yaw only, always level: the beams lie in its x-y plane, beam 0 along x, counter-clockwise",
    "camera": "optical: z along the vehicle's x, x to its right, y down; depth is along z",
}
"""of /tf"""

FORMULAS = {
    "obstacle_position": (
        "z stays. Without a path a body rests. arc(t) = (phase_m + speed_m_s * t) mod length_m. circle: angle = arc / radius_m "
        "(radius_m < 0 is clockwise), (x, y) = center + |radius_m| (cos angle, sin angle). polyline: the point at arc along "
        "corners[0], corners[1], .., back to corners[0]; with two corners that is back and forth. Velocity = speed_m_s along "
        "the path. t = step * control_dt_s."
    ),
    "size": (
        "sphere (r, r, r); vertical cylinder (r, r, half height); box half extents along its own axes before it is turned by yaw about z"
    ),
    "sonar": (
        "Beam i of n looks along the true yaw + 2 pi i / n in the horizontal plane of the true position at the scan's own "
        "timestamp. A body is met where the beam enters its horizontal outline (of a sphere: the circle of radius sqrt(r^2 - "
        "g^2), g = max(|dz| - d tan(a), 0), d = horizontal distance of its centre) if the vertical gap is at most range * "
        "tan(a); a = sensors.sonar.vertical_half_aperture_deg. Side walls are always met, floor and surface never. Doppler = "
        "rate of change of that range. Errors as in sensors.sonar."
    ),
    "clearance": (
        "Hull = capsule about the vehicle's x axis (vehicle.hull_half_length_m either side of the origin, "
        "vehicle.hull_radius_m). clearance_m = smallest distance of its surface to any body or side wall."
    ),
    "ttc": (
        "Smallest clearance / closing speed over the bodies whose closing speed exceeds episode.ttc_closing_m_s; closing speed "
        "= rate at which that body's clearance shrinks, from the velocities of both nearest points. null = none."
    ),
    "outcome": (
        "The first that holds after a control step: out_of_tank (hull centre outside the tank), collision (clearance < "
        "episode.collision_clearance_m, or hull beyond floor or surface), ttc (< episode.ttc_s), success (3-D distance to the "
        "goal at most episode.goal_radius_m), timeout (episode.horizon_steps)."
    ),
    "map": (
        "Per scan, gains of `mapping` scaled from 10 Hz to the scan rate: static = clip((1 - static_decay) static + static_hit "
        "[hit] - static_free [free] + depth_hit [depth], 0, 1); dynamic = clip((1 - dynamic_decay) dynamic + dynamic_hit "
        "[moving] - dynamic_free [free], 0, 1). Scans in /sonar/scan and /sonar/doppler, own pose in /pose_estimate at the "
        "scan's timestamp, own velocity in /sonar/doppler, beams of tracked moving bodies in /tracks."
    ),
    "map_clearance": (
        "Distance between the centre of a cell and the centre of the nearest cell that is occupied (>= mapping.occupied in the "
        "layers named by voronoi.use) or whose centre lies outside the tank; clearance.max_m stands for 'at least'. Computed "
        "every clearance.period_steps from the map of that step: its time is the timestamp of /map/clearance and /map/risk, "
        "which on a replan may lie before their log time."
    ),
}
"""How an outsider recomputes the log's figures; names such as mapping.occupied are keys of config.yaml."""


def scenario_document(config: Any, described: dict[str, Any], world: str, seed: int, episode: int) -> dict[str, Any]:
    """Content of scenario.json. ``config`` is a Config, ``described`` comes from ``uuvtai.scenario.describe_scenario`` at step 0."""
    wanted, tank = config.world, config.world.tank
    moving = sum(body["path"] is not None for body in described["bodies"])
    return {
        "schema": 1,
        "world": world,
        "seed": seed,
        "episode": episode,
        "S": len(described["bodies"]) - moving,
        "D": moving,
        "v_m_s": wanted.dynamic_speed_m_s,
        "control_dt_s": config.episode.control_dt_s,
        "goal_radius_m": config.episode.goal_radius_m,
        "tank": {"shape": tank.shape, "x_m": list(tank.x_m), "y_m": list(tank.y_m), "z_m": list(tank.z_m), "radius_m": tank.radius_m},
        **described,
        "frames": FRAMES,
        "formulas": FORMULAS,
    }


def body_positions(body: dict[str, Any], times_s: np.ndarray) -> np.ndarray:
    """Centres (n, 3) [m] of a body of scenario.json at these times (float64), by the formula ``obstacle_position``."""
    times = np.atleast_1d(np.asarray(times_s, float))
    path = body["path"]
    x, y, z = body["position"]
    if path is None:
        return np.tile([x, y, z], (len(times), 1))
    arc = (path["phase_m"] + path["speed_m_s"] * times) % path["length_m"]
    flat = _on_circle(path, arc) if path["shape"] == "circle" else _on_polyline(path, arc)
    return np.column_stack([flat, np.full(len(times), z)])


def _on_circle(path: dict[str, Any], arc: np.ndarray) -> np.ndarray:
    angle = arc / path["radius_m"]
    return np.array(path["center"]) + abs(path["radius_m"]) * np.column_stack([np.cos(angle), np.sin(angle)])


def _on_polyline(path: dict[str, Any], arc: np.ndarray) -> np.ndarray:
    corners = np.array([*path["corners"], path["corners"][0]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    return np.column_stack([np.interp(arc, along, corners[:, axis]) for axis in (0, 1)])
