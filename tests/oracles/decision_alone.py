"""Redo the evasions of a log from its messages and scenario.json's ``formulas`` alone, in float64."""

import math
from types import SimpleNamespace

import numpy as np

from tests.oracles.log_alone import grid_values


def decisions(log):
    """Every decision of the log that looked for an evasion, with what it was taken from."""
    asked, seen, grids = (
        {log.step(time): data for time, data in log.messages[topic]}
        for topic in ("/action", "/futures", "/map/clearance")
    )
    found = []
    for step, (_, data) in zip(log.steps("/evasion"), log.messages["/evasion"], strict=True):
        own = SimpleNamespace(
            **{key: np.array(value, float) for key, value in data.items() if value is not None}
        )
        own.asked = np.array(asked[step - 1]["asked"] if step > 0 else [0.0, 0.0, 0.0])
        own.tracks, own.grid = seen[step]["tracks"], grids.get(step)
        c, s = math.cos(own.yaw), math.sin(own.yaw)
        own.vel = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ own.own_velocity
        own.low, own.high = band(log, float(own.z_variance), asked[step]["given_up"] != 0)
        found.append(own)
    return found


def band(log, z_variance, lost):
    """(lowest, highest) z that is steered for; ``lost``: with a dead vertical thruster."""
    t, (floor, surface) = log.config["behavior"], log.scenario["tank"]["z_m"]
    edge = max(t["edge_gap_m"], t["lost_edge_gap_m"] if lost else 0)
    gap = min(edge + t["place_sigmas"] * math.sqrt(z_variance), (surface - floor) / 2)
    return floor + gap, surface - gap


def candidates(log, own):
    """(velocities (n, 3), how long each is commanded (n,))."""
    t, vehicle = log.config["behavior"], log.config["vehicle"]
    z, h0 = own.position[2], math.atan2(own.follow[1], own.follow[0])

    def held(heave):
        return min(max(heave, min(own.low - z, 0.0)), max(own.high - z, 0.0))

    def towards(turn, share, heave):
        heading = h0 + turn
        limits = [
            abs(math.cos(heading - own.yaw)) / vehicle["max_surge_m_s"],
            abs(math.sin(heading - own.yaw)) / vehicle["max_sway_m_s"],
        ]
        speed = share * min(t["evade_m_s"], 1 / max(limits))
        return speed * math.cos(heading), speed * math.sin(heading), heave

    around = 2 * math.pi * np.arange(t["n_heading"]) / t["n_heading"]
    shares = (np.arange(t["n_speed"]) + 1) / t["n_speed"]
    rows = [towards(turn, share, own.follow[2]) for share in shares for turn in around]
    rows += [(0, 0, 0), (*own.asked[:2], held(own.asked[2])), tuple(own.follow)]
    if t["heave_m_s"] > 0:
        pair = held(t["heave_m_s"]), held(-t["heave_m_s"])
        around = 2 * math.pi * np.arange(t["n_heave_heading"]) / t["n_heave_heading"]
        rows += [towards(turn, 1, heave) for turn in around for heave in pair]
        rows += [(0, 0, heave) for heave in pair]
    rows += [(0, 0, 0)] * (-len(rows) % 16)
    lasts = [math.inf] * len(rows)
    if t["burst_s"] > 0:
        rows += [towards(2 * math.pi * nth / 32, 1, own.follow[2]) for nth in range(32)]
        lasts += [t["burst_s"]] * 32
    return np.array(rows, float), np.array(lasts)


def mean_of_the_best(log, own, velocities):
    """(3,) mean of the candidates by their logged costs."""
    above = (own.costs - own.costs.min()) / log.config["behavior"]["temperature"]
    weight = np.where(above < 12, np.exp(-above), 0.0)
    return weight @ velocities / weight.sum()


def costs(log, own, velocities, lasts):
    """(n,) costs by the logged tracks, and by the clearance of the decision's own step where it is logged."""
    t = log.config["behavior"]
    peak, mean, contact = moving_depths(log, own, velocities, lasts)
    static_mean, static_contact = static_depths(log, own, velocities, lasts)
    off, change = (np.linalg.norm(velocities - other, axis=1) for other in (own.follow, own.asked))
    return (
        t["weight_peak"] * peak
        + t["weight_mean"] * mean
        + t["weight_contact"] * contact
        + t["weight_static"] * static_mean
        + t["weight_static_contact"] * static_contact
        + (t["weight_deviation"] * off + t["weight_change"] * change) / t["cruise_m_s"]
    )


def driven(own, velocities, lasts, times, lag_s):
    """(places, velocities), each (n, n_t, 3), of a vehicle that follows with a first-order lag and stops."""

    def settled(t):
        return lag_s * (1 - np.exp(-t / lag_s))

    over = np.maximum(times - lasts[:, None], 0)
    gain = (times - settled(times)) - (over - settled(over))
    rate = np.exp(-over / lag_s) - np.exp(-times / lag_s)
    decay = np.exp(-times / lag_s)[:, None]
    places = own.position + own.vel * settled(times)[:, None] + velocities[:, None] * gain[..., None]
    return places, own.vel * decay + velocities[:, None] * rate[..., None]


def moving_depths(log, own, velocities, lasts):
    """(peak, mean, contact), each (n,)."""
    t, dt = log.config["behavior"], log.config["tracking"]["forecast_dt_s"]
    n = round(t["horizon_s"] / dt)
    times = dt * np.arange(1, n + 1)
    at, moving = driven(own, velocities, lasts, times, t["lag_s"])
    z = np.clip(at[..., 2], own.low, own.high)
    peak, mean, contact = np.zeros((3, len(velocities)))
    for track in own.tracks:
        above, below = (
            far if track[side] is None else track[side] for side, far in (("above", 1e6), ("below", -1e6))
        )
        gap = np.maximum(np.minimum(above - z, z - below), 0) * t["vertical_weight"]
        radius = np.array(track["radius"])[1 : n + 1]
        heeded = [path for path in track["hypotheses"][:-1] if path["weight"] > t["least_share"]]
        left = 1 - sum(path["weight"] for path in heeded)
        deepest, touching = np.zeros((2, len(velocities)))
        for path, weight, share in [
            *((path, path["weight"], t["future_margin"]) for path in heeded),
            (track["hypotheses"][-1], left, 1.0),
        ]:
            body = np.array([path["x"], path["y"]]).T
            rel = at[..., :2] - body[1 : n + 1]
            closing = moving[..., :2] - np.diff(body[: n + 1], axis=0) / dt
            free = free_m(rel, closing, gap, radius, t, own.patience)
            margin = own.patience * t["caution"] * (t["margin_m"] + t["margin_growth_m_s"] * times)
            depth = np.maximum(t["contact_m"] + share * margin - free, 0)
            deepest += weight * depth.max(1)
            touching += weight * np.maximum(t["contact_m"] - free, 0).max(1)
            mean += weight * depth.mean(1)
        peak, contact = np.maximum(peak, deepest), np.maximum(contact, touching)
    return peak, mean, contact


def free_m(rel, closing, gap, radius, t, patience):
    """(n, n_t) [m] free water between hull and body, less what closing in takes."""
    away = np.hypot(rel[..., 0], rel[..., 1])
    beside = np.maximum(away - radius, 0)
    slant = np.hypot(beside, gap)
    level = gap <= 0
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = np.where(level, 1.0, beside / slant)
    nearing = np.maximum(-(rel * closing).sum(-1) / away, 0) * slope
    return np.where(level, away - radius, slant) - t["hull_reach_m"] - patience * t["closing_s"] * nearing


def static_depths(log, own, velocities, lasts):
    """(mean depth, largest contact), each (n,), on the clearance grid of the decision's own step."""
    t, grid = log.config["behavior"], own.grid
    if grid is None:
        return np.zeros((2, len(velocities)))
    n = max(1, round(t["static_horizon_s"] / t["static_dt_s"]))
    at, _ = driven(own, velocities, lasts, t["static_dt_s"] * np.arange(1, n + 1), t["lag_s"])
    cells, cell_m = grid_values(grid), grid["cell_size"]["x"]
    col, row = (
        np.clip(np.floor((at[..., i] - grid["pose"]["position"]["xy"[i]]) / cell_m).astype(int), 0, most - 1)
        for i, most in ((0, cells.shape[1]), (1, cells.shape[0]))
    )
    doubt = t["place_sigmas"] * math.sqrt(own.place_variance)
    below = t["hull_reach_m"] + t["contact_m"] + doubt - cells[row, col]
    return np.maximum(below + t["static_margin_m"], 0).mean(1), np.maximum(below, 0).max(1)
