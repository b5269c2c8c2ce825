"""Sectors of one scan in float64 NumPy."""

from __future__ import annotations

import numpy as np


def sectors(range_m, doppler_m_s, hit, turned, n_sector, max_range_m, ttc_cap_s):
    """(range, ttc, closing, valid), each (n_sector,): beams binned by their bearing after a turn of ``turned`` [rad] since."""
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
