"""NumPy / SciPy float64 oracles of the planner: clearance, sites, traversable set, exact least cost."""

from itertools import pairwise

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

SLACK_M = 1e-5
"""As in uuvtai: a cell exactly d_min away counts."""


def clearance_of(blocked, cell_m, max_m):
    """(clearance [m], site row, site col) of blocked cells; sites are -1 where it saturates at ``max_m``."""
    distance, (site_row, site_col) = distance_transform_edt(~blocked, return_indices=True)
    far = distance * cell_m >= max_m
    return np.minimum(distance * cell_m, max_m), np.where(far, -1, site_row), np.where(far, -1, site_col)


def traversable(blocked, clearance_m, min_m):
    return ~blocked & (clearance_m >= min_m - SLACK_M)


def least_cost(omega, clearance_m, epsilon_m, cell_m, start, goal):
    """Exact least cost from cell start to cell goal, inf where there is no way. Eight neighbours, no corner
    cut.

    An edge costs |dp| times the mean of 1 / max(clearance, eps) over its two cells: the integral of the
    paper's density along it.
    """
    n_row, n_col = omega.shape
    ids = np.arange(omega.size).reshape(omega.shape)
    density = 1.0 / np.maximum(clearance_m, epsilon_m)
    rows, cols, costs = [], [], []
    for d_row, d_col in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = (slice(0, n_row - d_row), slice(max(0, -d_col), n_col - max(0, d_col)))
        b = (slice(d_row, n_row), slice(max(0, d_col), n_col - max(0, -d_col)))
        is_open = omega[a] & omega[b]
        if d_row and d_col:
            is_open &= omega[b[0], a[1]] & omega[a[0], b[1]]
        rows.append(ids[a][is_open])
        cols.append(ids[b][is_open])
        costs.append(np.hypot(d_row, d_col) * cell_m * 0.5 * (density[a] + density[b])[is_open])
    graph = csr_matrix(
        (np.concatenate(costs), (np.concatenate(rows), np.concatenate(cols))), shape=(omega.size, omega.size)
    )
    return dijkstra(graph, directed=False, indices=ids[start])[ids[goal]]


def line_points(way_w, step_m):
    """Points along a polyline at most ``step_m`` apart, and the length that each stands for."""
    points, lengths = [], []
    for a, b in pairwise(way_w):
        n = max(1, int(np.ceil(np.linalg.norm(b - a) / step_m)))
        points.append(a + (b - a) * ((np.arange(n) + 0.5) / n)[:, None])
        lengths.append(np.full(n, np.linalg.norm(b - a) / n))
    return np.concatenate(points), np.concatenate(lengths)


def line_cost(way_w, clearance_m, epsilon_m, origin, cell_m, step_m=0.005):
    """Integral of 1 / max(clearance, eps) along a polyline, by fine sampling."""
    points, lengths = line_points(way_w, step_m)
    col, row = np.floor((points - origin) / cell_m).astype(int).T
    return float(np.sum(lengths / np.maximum(clearance_m[row, col], epsilon_m)))


def hopped_cost(way_w, clearance_m, epsilon_m, origin, cell_m):
    """The paper's sum as written: segments (here a cell at most) with the clearance at their first point."""
    total = 0.0
    for a, b in pairwise(way_w):
        n = max(1, int(np.ceil(np.linalg.norm(b - a) / cell_m)))
        for i in range(n):
            col, row = np.floor((a + (b - a) * i / n - origin) / cell_m).astype(int)
            total += np.linalg.norm(b - a) / n / max(clearance_m[row, col], epsilon_m)
    return total
