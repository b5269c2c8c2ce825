"""NumPy float64 oracle of heights: 0 .. 14 = middles of fifteen slices of the water, 15 = all of it."""

import numpy as np

N_SLICE = 15
CERTAIN = 0.95
"""probability of an obstacle that was just matched to be where it is expected"""
LEAST = 0.01
LEAST_SHARE = 1e-3
"""likelihood of what cannot be"""
EDGE_M, EVIDENCE_S, HIT_SHARE = 0.06, 0.15, 0.9
TAIL_SHARE, COLUMN_TAIL_SHARE = 0.02, 0.15


def heights(tank):
    edges = np.linspace(*tank.z_m, N_SLICE + 1)
    return 0.5 * (edges[1:] + edges[:-1])


def prior(cfg):
    return np.array([(1 - cfg.column_share) / N_SLICE] * N_SLICE + [cfg.column_share])


def hit_probability(own_z, away_m, radius_m, half_m, sonar, tank):
    """Per hypothesis: 1 where it reaches ``EDGE_M`` into the fan, 0 where as much is missing."""
    fan = np.tan(np.radians(sonar.vertical_half_aperture_deg)) * max(away_m - radius_m / 2, 0)
    overlap = np.array([fan + half_m - abs(z - own_z) for z in heights(tank)])
    return np.append(np.interp(overlap, [-EDGE_M, EDGE_M], [0, 1]), 1.0)


def shared(weighed):
    """Shares that sum to 1 after every hypothesis has been lifted to the least one."""
    held = np.maximum(weighed / weighed.sum(), LEAST_SHARE)
    return held / held.sum()


def after_hit(share, own, place, radius_m, cfg, sonar, tank):
    """(shares, presence) after ``own`` (x, y, z) hit ``place``: a hit tells little near the edge."""
    half = max(radius_m, cfg.half_height_m) + EDGE_M
    likely = hit_probability(own[2], np.hypot(*(place - own[:2])), radius_m, half, sonar, tank)
    weighed = share * np.maximum(likely, LEAST)
    return shared(weighed), CERTAIN


def after_miss(share, present, own, place, place_cov, radius_m, dt_s, cfg, sonar, tank):
    """(shares, presence) after beams from ``own`` passed through ``place``, ``dt_s`` after the last scan."""
    half = cfg.least_half_height_m - EDGE_M
    inside = hit_probability(own[2], np.hypot(*(place - own[:2])), radius_m, half, sonar, tank)
    sure = HIT_SHARE * radius_m**2 / (radius_m**2 + np.linalg.eigvalsh(place_cov).max())
    hit = 1 - (1 - sure) ** min(dt_s / EVIDENCE_S, 1)
    return seen_not(share, present, np.maximum(1 - inside * hit, LEAST))


def seen_not(share, present, likely):
    """Bayes' rule for what did not show; ``likely`` = its probability per hypothesis if there, else 1."""
    joint = present * share * likely
    return shared(joint), joint.sum() / (joint.sum() + 1 - present)


def free_water(share, own_z, radius_m, cfg, tank):
    """(lowest edge above, highest edge below) [m] of obstacles that may be there, else the own height."""
    half = max(radius_m, cfg.half_height_m)
    above, below = np.inf, -np.inf
    if share[N_SLICE] > COLUMN_TAIL_SHARE:
        return own_z, own_z
    for z, p in zip(heights(tank), share, strict=False):
        if p > TAIL_SHARE and z >= own_z:
            above = min(above, max(z - half, own_z))
        if p > TAIL_SHARE and z <= own_z:
            below = max(below, min(z + half, own_z))
    return above, below
