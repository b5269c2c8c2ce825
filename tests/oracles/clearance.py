"""NumPy float64 oracle of the clearance: scipy's exact Euclidean distance transform, cut off at ``max_m``."""

import numpy as np
from scipy.ndimage import distance_transform_edt


def sites_of(static, dynamic, outside, occupied, use):
    """Cells that count as obstacles or boundary."""
    layer = np.maximum(static, dynamic) if use == "fused" else static
    return (layer >= occupied) | outside


def clearance_of(sites, cell_m, max_m):
    """(clearance [m], whether a site lies within ``max_m``)."""
    if not sites.any():
        return np.full(sites.shape, max_m), np.zeros(sites.shape, bool)
    distance = distance_transform_edt(~sites) * cell_m
    return np.minimum(distance, max_m), distance <= max_m + 1e-9
