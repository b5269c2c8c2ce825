"""NumPy float64 oracle of following a polyline: foot, look-ahead, signed cross-track, length left."""

import numpy as np


def corners_and_lengths(way):
    return way, np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])


def nearest_on(way, pos):
    """(arc length of the nearest point, its distance, signed: positive = left of the route)."""
    _, at = corners_and_lengths(way)
    best = (np.inf, 0.0, 0.0)
    for i in range(len(way) - 1):
        along = way[i + 1] - way[i]
        share = np.clip((pos - way[i]) @ along / (along @ along), 0, 1)
        off = pos - way[i] - share * along
        gap = np.linalg.norm(off)
        if gap < best[0]:
            signed = np.copysign(gap, along[0] * off[1] - along[1] * off[0])
            best = gap, at[i] + share * np.linalg.norm(along), signed
    return best[1], best[2]


def point_at(way, length):
    way, at = corners_and_lengths(way)
    return np.array([np.interp(length, at, way[:, 0]), np.interp(length, at, way[:, 1])])
