"""What the map takes from a depth image, for the log: whole images are too big for it, and without these
pixels nobody redoes the map."""

from __future__ import annotations

import math

import numpy as np

from uuvtai.config import DepthConfig, MappingConfig
from uuvtai.snapshot import DepthLine

_NO_RETURN_SHARE = 0.999
"""As in ``kernels.evidence``: a pixel beyond this share of the camera's range saw nothing."""


def depth_line(
    depth_m: np.ndarray, rpy: np.ndarray, depth_cfg: DepthConfig, mapping_cfg: MappingConfig
) -> DepthLine:
    """Per column the nearest pixel within ``depth_gate_m`` of the vehicle's own depth; ``rpy`` [rad] is its
    attitude estimate."""
    rows, cols = depth_m.shape
    focal = 0.5 * depth_cfg.cols / math.tan(math.radians(0.5 * depth_cfg.fov_deg))
    left = (0.5 * depth_cfg.cols - 0.5 - np.arange(cols)) / focal
    up = (0.5 * depth_cfg.rows - 0.5 - np.arange(rows))[:, None] / focal
    roll, pitch = (float(v) for v in rpy[:2])
    ahead_z, left_z, up_z = (
        -math.sin(pitch),
        math.sin(roll) * math.cos(pitch),
        math.cos(roll) * math.cos(pitch),
    )
    mount = np.dot((ahead_z, left_z, up_z), depth_cfg.offset_b_m)
    rise = mount + depth_m * (ahead_z + left_z * left + up_z * up)
    counts = (
        (np.abs(rise) <= mapping_cfg.depth_gate_m)
        & (depth_m > 0)
        & (depth_m < depth_cfg.max_range_m * _NO_RETURN_SHARE)
    )
    gated = np.where(counts, depth_m, np.inf)
    row = np.argmin(gated, axis=0)
    column = np.flatnonzero(np.isfinite(gated[row, np.arange(cols)]))
    return DepthLine(column=column, row=row[column], depth_m=depth_m[row[column], column])
