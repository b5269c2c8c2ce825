"""NumPy float64 oracle of what a depth image says of a track's height, by pixels and hypotheses."""

import numpy as np

from tests.oracles import height
from tests.oracles.scenes import quaternions, rotation

SLACK_M = 0.25
"""what is this much farther than the middle, or nearer than the near side, is not the body"""
TRUNCATED_M = 0.4
EDGE_M = 0.1
LEAST, HIT_SHARE = 0.05, 0.5


def column_through(pos, rpy, at, depth):
    """(rays [rows, 3] with body-x 1, camera [3], distance ahead [m], column, next column [pixel])."""
    attitude = rotation(quaternions(np.array([rpy]))[0])
    eye = pos + attitude @ np.array(depth.offset_b_m)
    ahead = (at - eye[:2]) @ [np.cos(rpy[2]), np.sin(rpy[2])]
    left = (at - eye[:2]) @ [-np.sin(rpy[2]), np.cos(rpy[2])]
    focal = depth.cols / 2 / np.tan(np.radians(depth.fov_deg / 2))
    place = depth.cols / 2 - focal * left / max(ahead, 1e-3)
    col = int(np.floor(place))
    up = (depth.rows / 2 - 0.5 - np.arange(depth.rows)) / focal
    rays = (
        np.stack([np.ones(depth.rows), np.full(depth.rows, (depth.cols / 2 - 0.5 - col) / focal), up], 1)
        @ attitude.T
    )
    return rays, eye, ahead, col, abs(place - np.round(place))


def look(share, present, image, pos, rpy, at, radius, depth, tank):
    """(shares, presence, doubt) after an image [rows, cols]; ``doubt``: how near float32 is to differing."""
    rays, eye, ahead, col, doubt = column_through(pos, rpy, at, depth)
    doubt = min(doubt, abs(ahead - radius - SLACK_M), abs(depth.max_range_m - SLACK_M - ahead))
    if not radius + SLACK_M < ahead < depth.max_range_m - SLACK_M or not 0 <= col < depth.cols:
        return share, present, doubt
    away = image[:, col]
    doubt = min(
        doubt, np.abs(away - (ahead - radius - SLACK_M)).min(), np.abs(away - (ahead + SLACK_M)).min()
    )
    hides, past = away <= ahead - radius - SLACK_M, away >= ahead + SLACK_M
    body = np.flatnonzero(~hides & ~past)
    z = height.heights(tank)
    if len(body):
        likely, unsure = shown(eye[2] + rays[body, 2] * away[body], body, hides, z, tank)
        weighed = share * likely
        return height.shared(weighed), present, min(doubt, unsure)
    front = eye + rays * (ahead - radius / 2)
    rows = [np.abs(front[:, 2] - height).argmin() for height in z]
    pitch = abs(front[1, 2] - front[0, 2])
    offs = np.array([abs(front[row, 2] - height) for row, height in zip(rows, z, strict=True)])
    doubt = min(doubt, np.abs(offs - pitch / 2).min())
    free = (offs < pitch / 2) & past[rows]
    likely = np.append(np.where(free, 1 - HIT_SHARE, 1.0), 1 - HIT_SHARE)
    return (*height.seen_not(share, present, likely), doubt) if free.any() else (share, present, doubt)


def shown(heights_m, body, hides, z, tank):
    """(likelihood per hypothesis, doubt) of an obstacle whose pixels lie at these heights."""
    low, high = heights_m.min(), heights_m.max()
    covered = np.concatenate([[True], hides, [True]])  # beyond the image nothing is seen
    on_top = any(covered[row] for row in body)
    below = any(covered[row + 2] for row in body)
    middle, slice_m = 0.5 * (low + high), z[1] - z[0]
    first, last = {
        (False, False): (middle, middle),
        (True, False): (middle, low + TRUNCATED_M),
        (False, True): (high - TRUNCATED_M, middle),
        (True, True): (low, high),
    }[on_top, below]
    reach = EDGE_M + 0.5 * slice_m
    centre = np.append(z, 0.5 * sum(tank.z_m))
    likely = np.where((centre >= first - reach) & (centre <= last + reach), 1.0, LEAST)
    to_floor, to_surface = below or low < tank.z_m[0] + 2 * EDGE_M, on_top or high > tank.z_m[1] - 2 * EDGE_M
    likely[-1] = 1.0 if to_floor and to_surface else LEAST
    doubt = min(np.abs(z - first + reach).min(), np.abs(z - last - reach).min())
    return likely, min(doubt, abs(low - tank.z_m[0] - 2 * EDGE_M), abs(high - tank.z_m[1] + 2 * EDGE_M))
