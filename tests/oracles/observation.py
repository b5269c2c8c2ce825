"""Sectors of one scan in float64 NumPy."""

from __future__ import annotations

import numpy as np

from tests.oracles.forecast import turned
from tests.oracles.turn_history import expected_turn_rate


def sectors(range_m, doppler_m_s, hit, turned, n_sector, max_range_m, ttc_cap_s):
    """(range, ttc, closing, valid), each (n_sector,): beams by bearing after a turn of ``turned`` [rad]."""
    n_ray = len(range_m)
    position = np.arange(n_ray) * n_sector / n_ray - turned * n_sector / (2 * np.pi)
    sector = np.floor(position + 0.5).astype(int) % n_sector
    out = np.zeros((4, n_sector))
    for s in range(n_sector):
        mine = (sector == s) & (hit == 1)
        closing = -doppler_m_s[mine]
        approaching = closing > 0
        out[0, s] = min(max_range_m, *range_m[mine]) if mine.any() else max_range_m
        out[1, s] = min([ttc_cap_s, *(range_m[mine][approaching] / closing[approaching])])
        out[2, s] = closing.max() if mine.any() else 0.0
        out[3, s] = mine.any()
    return out


def rotation_wb(roll, pitch, yaw):
    """Body to world, Z-Y-X."""
    (sr, cr), (sp, cp), (sy, cy) = ((np.sin(a), np.cos(a)) for a in (roll, pitch, yaw))
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return about_z @ about_y @ about_x


def observation(values):
    """Named parts of one env's observation, from a dict of its arrays."""
    to_body = rotation_wb(*values["rpy"]).T
    return {
        "goal": to_body @ (values["goal_w"] - values["pos_w"]),
        "heading_error": np.array([np.sin(values["heading_error"]), np.cos(values["heading_error"])]),
        "velocity": values["vel_b"],
        "yaw_rate": values["rate_b"][2:],
        "depth": values["depth_m"],
        "tilt": values["rpy"][:2],
        "sector_range": values["sector_range_m"],
        "lookahead": to_body @ (values["lookahead_w"] - values["pos_w"]),
        "cross_track": values["cross_track_m"],
        "remaining": values["remaining_m"],
        "path_risk": values["path_risk"],
        "tilt_rate": values["rate_b"][:2],
        "sector_ttc": values["sector_ttc_s"],
        "sector_closing": values["sector_closing_m_s"],
    }


def closest_approach(pos, radius, own, vel, dt):
    """(distance to the surface, time) of two points that move straight between samples; pos (n, 2)."""
    t = dt * np.arange(len(pos))
    away = pos - own - np.outer(t, vel)
    course = np.diff(away, axis=0)
    share = np.clip(-(away[:-1] * course).sum(axis=1) / (course**2).sum(axis=1).clip(1e-9), 0, 1)
    gap = np.linalg.norm(away[:-1] + share[:, None] * course, axis=1) - (
        radius[:-1] + share * np.diff(radius)
    )
    best = int(np.argmin(gap))
    return gap[best], t[best] + share[best] * dt


def obstacles(v, n_obstacle, forecast_cfg, tracking, tank, rules):
    """Columns of one env's moving obstacles, closest first, as (n_obstacle, width); ``v``: 'struct.array'."""
    yaw, own = v["ego.rpy"][2], v["ego.pos_w"]
    vel = (rotation_wb(*v["ego.rpy"]) @ v["ego.vel_b"])[:2]
    rows = []
    for track in np.flatnonzero(v["forecast.radius_m"][:, 0] >= 0):
        pos, radius = v["forecast.pos_w"][track], v["forecast.radius_m"][track]
        state = v["tracks.state"][track]
        gap, time = closest_approach(pos, radius, own[:2], vel, tracking.forecast_dt_s)
        rate, rate_var = v["tracks.turn_rate"][track], v["tracks.turn_cov"][track, 4]
        water = np.array([v["forecast.above_w"][track] - own[2], own[2] - v["forecast.below_w"][track]])
        rows.append(
            {
                "obstacle_valid": [1.0],
                "obstacle_position": turned(pos[0] - own[:2], -yaw),
                "obstacle_velocity": turned(state[2:] - vel, -yaw),
                "obstacle_turn_rate": [expected_turn_rate(rate, rate_var, forecast_cfg, tracking)],
                "obstacle_radius": [radius[0]],
                "obstacle_free_water": np.minimum(water, tank.z_m[1] - tank.z_m[0]),
                "obstacle_age": [(v["clock.step"] - v["tracks.seen_step"][track]) * rules.control_dt_s],
                "obstacle_closest": [gap],
                "obstacle_closest_time": [time],
            }
        )
    rows = sorted(rows, key=lambda row: row["obstacle_closest"][0])[:n_obstacle]
    widths = {"obstacle_position": 2, "obstacle_velocity": 2, "obstacle_free_water": 2}
    names = (
        "valid", "position", "velocity", "turn_rate", "radius", "free_water", "age", "closest",
        "closest_time",
    )  # fmt: skip
    out = {f"obstacle_{name}": np.zeros((n_obstacle, widths.get(f"obstacle_{name}", 1))) for name in names}
    for slot, row in enumerate(rows):
        for name, value in row.items():
            out[name][slot] = value
    return out
