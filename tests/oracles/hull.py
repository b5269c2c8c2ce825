"""Float64 oracle of hull distances: the capsule's axis sampled densely, each solid's exact distance."""

import numpy as np

SPHERE, CYLINDER, BOX = 1, 2, 3


def point_distances(
    points: np.ndarray, kind: int, pos: np.ndarray, size: np.ndarray, yaw: float
) -> np.ndarray:
    """Distances [m] of points (n, 3) to a solid; 0 inside cylinders and boxes, negative inside spheres."""
    q = points - pos
    if kind == SPHERE:
        return np.linalg.norm(q, axis=1) - size[0]
    if kind == CYLINDER:
        excess = np.stack([np.hypot(q[:, 0], q[:, 1]) - size[0], np.abs(q[:, 2]) - size[2]], axis=1)
    else:
        c, s = np.cos(yaw), np.sin(yaw)
        local = np.stack([c * q[:, 0] + s * q[:, 1], c * q[:, 1] - s * q[:, 0], q[:, 2]], axis=1)
        excess = np.abs(local) - size
    return np.linalg.norm(np.maximum(excess, 0.0), axis=1)


def clearance(pos, axis, kind, obstacle_pos, size, yaw, radius=0.17, half_length=0.10, samples=4001) -> float:
    """Hull to solid [m]."""
    along = np.linspace(-half_length, half_length, samples)
    points = np.asarray(pos) + along[:, None] * np.asarray(axis)
    return float(
        point_distances(points, kind, np.asarray(obstacle_pos), np.asarray(size), yaw).min() - radius
    )


def wall_clearance(pos, axis, shape, x_m, y_m, radius=0.17, half_length=0.10, samples=2001) -> float:
    """Hull to the nearest side wall [m]."""
    along = np.linspace(-half_length, half_length, samples)
    points = np.asarray(pos) + along[:, None] * np.asarray(axis)
    if shape == "circle":
        center = np.array([0.5 * sum(x_m), 0.5 * sum(y_m)])
        wall = 0.5 * min(x_m[1] - x_m[0], y_m[1] - y_m[0])
        return float((wall - np.linalg.norm(points[:, :2] - center, axis=1)).min() - radius)
    gaps = [points[:, 0] - x_m[0], x_m[1] - points[:, 0], points[:, 1] - y_m[0], y_m[1] - points[:, 1]]
    return float(np.min(gaps) - radius)
