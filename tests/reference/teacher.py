"""NumPy float64 oracle of the evasion's roll-outs and costs: one candidate, one body and one sample at a time."""

import numpy as np


def rolled_out(pos, vel, command, lag_s, dt_s, n):
    """Positions and velocities [n + 1, 2] of a vehicle that follows ``command`` with a first-order lag, by exact steps of ``dt_s``."""
    keep = np.exp(-dt_s / lag_s)
    positions, velocities = [np.array(pos, float)], [np.array(vel, float)]
    for _ in range(n):
        off = velocities[-1] - command
        positions.append(positions[-1] + command * dt_s + off * lag_s * (1 - keep))
        velocities.append(command + off * keep)
    return np.array(positions), np.array(velocities)


def body_depths(pos, vel, command, bodies, radii, cfg, dt_s):
    """(peak, mean, contact, first) of one command; bodies [track, k, 2], radii [track, k], negative = nothing."""
    n = round(cfg.horizon_s / dt_s)
    at, moving = rolled_out(pos, vel, command, cfg.lag_s, dt_s, n)
    peak, mean, contact, first = 0.0, 0.0, 0.0, np.inf
    for body, radius in zip(bodies, radii, strict=True):
        if radius[0] < 0:
            continue
        for k in range(1, n + 1):
            away = at[k] - body[k]
            distance = np.hypot(*away)
            closing = max(0.0, -(moving[k] - (body[k] - body[k - 1]) / dt_s) @ away / distance)
            free = distance - radius[k] - cfg.hull_reach_m - cfg.closing_s * closing
            depth = max(0.0, cfg.contact_m + cfg.margin_m + cfg.margin_growth_m_s * k * dt_s - free)
            peak, contact = max(peak, depth), max(contact, cfg.contact_m - free)
            mean += depth / n
            if depth > 0:
                first = min(first, k * dt_s)
    return peak, mean, contact, first


def static_depths(pos, vel, command, clearance, origin, cell_m, cfg):
    """(mean, contact, nearest cell border [m]) of one command on a clearance grid [row, col]."""
    n = max(1, round(cfg.static_horizon_s / cfg.static_dt_s))
    at, _ = rolled_out(pos, vel, command, cfg.lag_s, cfg.static_dt_s, n)
    mean, contact, border = 0.0, 0.0, np.inf
    for x, y in at[1:]:
        cells = np.array([(y - origin[1]) / cell_m, (x - origin[0]) / cell_m])
        row, col = np.clip(np.floor(cells).astype(int), 0, np.array(clearance.shape) - 1)
        below = cfg.hull_reach_m + cfg.contact_m - clearance[row, col]
        mean += max(0.0, below + cfg.static_margin_m) / n
        contact = max(contact, below)
        border = min(border, np.abs(cells - np.round(cells)).min() * cell_m)
    return mean, contact, border


def candidates(follow, last, yaw, cfg, vehicle):
    """Candidate velocities [n, 2] in their order, without padding."""
    out = []
    for s in range(cfg.n_speed):
        for h in range(cfg.n_heading):
            angle = np.arctan2(follow[1], follow[0]) + 2 * np.pi * h / cfg.n_heading
            body = np.array([np.cos(angle - yaw) / vehicle.max_surge_m_s, np.sin(angle - yaw) / vehicle.max_sway_m_s])
            top = min(cfg.evade_m_s, 1 / np.abs(body).max())
            out.append(top * (s + 1) / cfg.n_speed * np.array([np.cos(angle), np.sin(angle)]))
    return np.array([*out, np.zeros(2), last, follow])


def cost(pos, vel, command, follow, last, bodies, radii, clearance, origin, cell_m, cfg, dt_s):
    """(cost of one command, distance of its samples to the nearest cell border [m])."""
    peak, mean, contact, _ = body_depths(pos, vel, command, bodies, radii, cfg, dt_s)
    static_mean, static_contact, border = static_depths(pos, vel, command, clearance, origin, cell_m, cfg)
    total = cfg.weight_peak * peak + cfg.weight_mean * mean + cfg.weight_contact * contact
    total += cfg.weight_static * static_mean + cfg.weight_static_contact * static_contact
    total += cfg.weight_deviation * np.hypot(*(command - follow)) / cfg.cruise_m_s
    return total + cfg.weight_change * np.hypot(*(command - last)) / cfg.cruise_m_s, border
