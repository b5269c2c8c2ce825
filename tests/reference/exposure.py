"""NumPy float64 oracle of the exposure to moving bodies: the time average in blocks, read between them, and
what lines that fit between walls amount to."""

import numpy as np


def averaged(share, occupied, block, period_s, memory_s):
    """The average [0, 1] after one more map: ``share`` (rows, columns) of blocks, ``occupied`` of cells."""
    kept = np.exp(-period_s / memory_s)
    full = np.zeros((share.shape[0] * block, share.shape[1] * block), bool)
    full[: occupied.shape[0], : occupied.shape[1]] = occupied
    moved = full.reshape(share.shape[0], block, share.shape[1], block).any(axis=(1, 3))
    return kept * share + (1.0 - kept) * moved


def between_blocks(share, block, row, col):
    """The average at the centre of a cell, linear between the centres of blocks and constant beyond them."""
    y = np.clip((row + 0.5) / block - 0.5, 0, share.shape[0] - 1)
    x = np.clip((col + 0.5) / block - 0.5, 0, share.shape[1] - 1)
    rows, cols = np.arange(share.shape[0]), np.arange(share.shape[1])
    along = [np.interp(x, cols, line) for line in share]
    return np.interp(y, rows, along)


def density_across(width_m, leg_m, y_m, rng, n=200_000):
    """Density of bodies at the distances ``y_m`` from one of two walls, its mean over the width 1: points on
    lines of random length and direction, put anywhere between the walls where they fit."""
    half = 0.5 * np.abs(rng.uniform(*leg_m, n) * np.sin(rng.uniform(0, np.pi, n)))
    half = half[2 * half < width_m]
    middle = half + rng.random(len(half)) * (width_m - 2 * half)
    at = middle + half * rng.uniform(-1, 1, len(half))
    step = 0.2
    return np.array([np.mean(np.abs(at - y) < 0.5 * step) / step * width_m for y in y_m])
