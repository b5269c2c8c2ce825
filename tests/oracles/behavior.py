"""NumPy float64 oracle of the evasion's roll-outs and costs: one candidate, one obstacle at a time."""

import numpy as np


def rolled_out(pos, vel, command, lag_s, dt_s, n, burst_s=np.inf):
    """Positions and velocities [n + 1, axes] of a vehicle that follows ``command`` until ``burst_s`` and then
    0, with a first-order lag.

    The equation of motion is solved exactly over every step, in two pieces where the command ends within it.
    """

    def piece(pos, vel, wanted, dt):
        keep = np.exp(-dt / lag_s)
        return pos + wanted * dt + (vel - wanted) * lag_s * (1 - keep), wanted + (vel - wanted) * keep

    at, moving = [np.array(pos, float)], [np.array(vel, float)]
    command = np.array(command, float)
    for k in range(n):
        held = min(max(burst_s - k * dt_s, 0.0), dt_s)
        here = piece(*piece(at[-1], moving[-1], command, held), 0 * command, dt_s - held)
        at.append(here[0])
        moving.append(here[1])
    return np.array(at), np.array(moving)


def depth_band(tank, cfg):
    """Lowest and highest z that the teacher steers for."""
    return tank.z_m[0] + cfg.edge_gap_m, tank.z_m[1] - cfg.edge_gap_m


def distance_to(body, radius, above, below, at, cfg):
    """(distances [m] of points to an upright cylinder, their slopes along the level direction away from the
    axis, doubts [m]).

    Between ``below`` and ``above`` the water is free: the cylinder may be anywhere above or anywhere below
    that slab, whichever is nearer. Level with it, a point inside is as far below zero as it is from the
    mantle. ``doubt`` is how near the case is to flipping.
    """
    level = np.hypot(*(at[:, :2] - body).T) - radius
    room = np.minimum(above - at[:, 2], at[:, 2] - below)
    doubt = np.where(level < 0.001, np.abs(room), np.inf)
    beside = np.maximum(level, 0.0)
    aslant = np.where(room > 0, np.hypot(beside, cfg.vertical_weight * room), 1.0)
    return np.where(room > 0, aslant, level), np.where(room > 0, beside / aslant, 1.0), doubt


def obstacle_depths(pos, vel, command, forecast, cfg, tank, dt_s, burst_s=np.inf):
    """(peak, mean, contact, first, doubt) of one command [m/s, 3].

    ``forecast`` = (places [track, k, 2], radii [track, k], negative = nothing, above [track], below [track],
    other futures' places [track, future, k, 2], their shares [track, future]); ``doubt`` [m] = how near any
    sample is to a case that float32 may decide otherwise.
    """
    n = round(cfg.horizon_s / dt_s)
    at, moving = rolled_out(pos, vel, command, cfg.lag_s, dt_s, n, burst_s)
    at[:, 2] = np.clip(at[:, 2], *depth_band(tank, cfg))
    times_s = np.arange(1, n + 1) * dt_s
    peak, mean, contact, first, doubt = 0.0, 0.0, 0.0, np.inf, np.inf
    for body, radius, above, below, others, shares in zip(*forecast, strict=True):
        if radius[0] < 0:
            continue
        heeded = [(other, share, cfg.future_margin) for other, share in zip(others, shares, strict=True)]
        heeded = [future for future in heeded if future[1] > cfg.least_share]
        heeded.append((body, 1.0 - sum(future[1] for future in heeded), 1.0))
        expected = np.zeros(2)
        for places, share, margin in heeded:
            there, ahead = places[1 : n + 1], at[1:]
            distance, slope, unsure = distance_to(there, radius[1 : n + 1], above, below, ahead, cfg)
            outward = (ahead[:, :2] - there) / np.hypot(*(ahead[:, :2] - there).T)[:, None]
            nearing = (np.diff(places[: n + 1], axis=0) / dt_s - moving[1:, :2]) * outward
            free = distance - cfg.hull_reach_m - cfg.closing_s * np.maximum(0.0, nearing.sum(1)) * slope
            wanted = margin * cfg.caution * (cfg.margin_m + cfg.margin_growth_m_s * times_s)
            depth = np.maximum(0.0, cfg.contact_m + wanted - free)
            mean += share * depth.sum() / n
            doubt = min(doubt, unsure.min())
            if share >= cfg.evade_probability:
                first = min(first, times_s[depth > 0].min(initial=np.inf))
            expected += share * np.array([depth.max(), max(0.0, cfg.contact_m - free.min())])
        peak, contact = max(peak, expected[0]), max(contact, expected[1])
    return peak, mean, contact, first, doubt


def static_depths(pos, vel, command, clearance, origin, cell_m, cfg, burst_s=np.inf):
    """(mean, contact, nearest cell border [m]) of one command on a clearance grid [row, col]."""
    n = max(1, round(cfg.static_horizon_s / cfg.static_dt_s))
    at, _ = rolled_out(pos, vel, command, cfg.lag_s, cfg.static_dt_s, n, burst_s)
    mean, contact, border = 0.0, 0.0, np.inf
    for x, y, _ in at[1:]:
        cells = np.array([(y - origin[1]) / cell_m, (x - origin[0]) / cell_m])
        row, col = np.clip(np.floor(cells).astype(int), 0, np.array(clearance.shape) - 1)
        below = cfg.hull_reach_m + cfg.contact_m - clearance[row, col]
        mean += max(0.0, below + cfg.static_margin_m) / n
        contact = max(contact, below)
        border = min(border, np.abs(cells - np.round(cells)).min() * cell_m)
    return mean, contact, border


def level_velocity(angle, share, yaw, cfg, vehicle):
    """(x, y) [m/s] towards a world bearing at a share of the speed that surge and sway allow there."""
    body = np.array([np.cos(angle - yaw) / vehicle.max_surge_m_s, np.sin(angle - yaw) / vehicle.max_sway_m_s])
    top = min(cfg.evade_m_s, 1 / np.abs(body).max())
    return top * share * np.array([np.cos(angle), np.sin(angle)])


def candidates(follow, last, yaw, own_z, cfg, vehicle, tank):
    """(velocities [n, 3], durations [n]): level, stop, last, follow, climbs and dives, padding, dashes."""
    ahead, heave = np.arctan2(follow[1], follow[0]), follow[2]
    low, high = depth_band(tank, cfg)
    up, down = min(cfg.heave_m_s, max(high - own_z, 0.0)), max(-cfg.heave_m_s, min(low - own_z, 0.0))
    held = [
        (
            *level_velocity(ahead + 2 * np.pi * h / cfg.n_heading, (s + 1) / cfg.n_speed, yaw, cfg, vehicle),
            heave,
        )
        for s in range(cfg.n_speed)
        for h in range(cfg.n_heading)
    ]
    within = np.clip(last[2], min(low - own_z, 0.0), max(high - own_z, 0.0))
    held += [(0.0, 0.0, 0.0), (last[0], last[1], within), tuple(follow)]
    if cfg.heave_m_s > 0:
        for h in range(cfg.n_heave_heading):
            way = level_velocity(ahead + 2 * np.pi * h / cfg.n_heave_heading, 1.0, yaw, cfg, vehicle)
            held += [(*way, up), (*way, down)]
        held += [(0.0, 0.0, up), (0.0, 0.0, down)]
    held += [(0.0, 0.0, 0.0)] * (-len(held) % 16)
    dashes = []
    if cfg.burst_s > 0:
        dashes = [
            (*level_velocity(ahead + 2 * np.pi * h / 32, 1.0, yaw, cfg, vehicle), heave) for h in range(32)
        ]
    return np.array(held + dashes), np.array([np.inf] * len(held) + [cfg.burst_s] * len(dashes))


def cost(
    pos, vel, command, burst_s, follow, last, forecast, clearance, origin, cell_m, cfg, tank, dt_s, still=None
):
    """(cost of one command, how near any sample is to a case that float32 may decide otherwise [m]);
    ``still``: the numbers for what stands still, where they are others."""
    peak, mean, contact, _, doubt = obstacle_depths(pos, vel, command, forecast, cfg, tank, dt_s, burst_s)
    static_mean, static_contact, border = static_depths(
        pos, vel, command, clearance, origin, cell_m, still or cfg, burst_s
    )
    total = cfg.weight_peak * peak + cfg.weight_mean * mean + cfg.weight_contact * contact
    total += cfg.weight_static * static_mean + cfg.weight_static_contact * static_contact
    total += cfg.weight_deviation * np.linalg.norm(command - follow) / cfg.cruise_m_s
    return total + cfg.weight_change * np.linalg.norm(command - last) / cfg.cruise_m_s, min(doubt, border)


def mean_velocity(velocities, costs, temperature):
    """Mean of velocities weighted by exp(-cost / temperature); weights below exp(-12) are left out."""
    excess = (costs - costs.min()) / temperature
    weight = np.where(excess < 12, np.exp(-excess), 0.0)
    return weight @ velocities / weight.sum()
