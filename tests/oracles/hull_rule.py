"""Oracle of the fixed rule that lays a wished velocity on the hull: NumPy, float64, one vehicle at a time."""

import numpy as np


def hull_command(wish, yaw, z, gap, vehicle, tank):
    """(4,) surge, sway, heave, yaw rate in parts of the limits; ``wish`` (3,) [m/s] in the world."""
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    level = turn @ wish[:2] / [vehicle.max_surge_m_s, vehicle.max_sway_m_s]
    level /= max(1.0, np.abs(level).max())
    up = wish[2]
    if z + up > tank.z_m[1] - gap:  # one second ahead
        up = max(tank.z_m[1] - gap - z, min(up, 0.0))
    if z + up < tank.z_m[0] + gap:
        up = min(tank.z_m[0] + gap - z, max(up, 0.0))
    rate = 0.0
    if np.hypot(*wish[:2]) > 0.1:
        diagonals = yaw + np.pi / 4 + np.pi / 2 * np.arange(4)
        off = (np.arctan2(wish[1], wish[0]) - diagonals + np.pi) % (2 * np.pi) - np.pi
        rate = 2.5 * off[np.abs(off).argmin()] / vehicle.max_yaw_rate_rad_s
    return np.array([*level, np.clip(up / vehicle.max_heave_m_s, -1, 1), np.clip(rate, -1, 1)])
