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
