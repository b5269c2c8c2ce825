"""What the truth looked like, in NumPy: distances of the hull to every body, what the sonar could reach, what
its beams met.

For explanations after the fact only; nothing that drives a vehicle may import it. Same geometry as
``kernels/core/hull.py`` and ``kernels/sensors/raycast.py``. Arrays of one episode have the samples first,
shape (n, ...); bodies are on the next axis.
"""

from __future__ import annotations

import math

import numpy as np

from uuvtai.config import SonarConfig, TankConfig
from uuvtai.kernels.core.geometry import BOX, CYLINDER, NONE, SPHERE

Array = np.ndarray

_AXIS_SAMPLES = 9
"""Points along the hull's axis: 25 mm apart, which overestimates the clearance by less than 1 mm (0.0125^2 /
(2 x 0.27 m + clearance))."""


def rotation(quat_wb: Array) -> Array:
    """(n, 3, 3) rotation matrices body to world of unit quaternions (n, 4) = (w, x, y, z)."""
    w, x, y, z = np.moveaxis(np.asarray(quat_wb, float), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def hull_gaps(
    pos_w: Array,
    axis_w: Array,
    kind: Array,
    body_w: Array,
    size: Array,
    yaw: Array,
    radius_m: float,
    half_m: float,
):
    """(gap [m], unit vector hull to body, place on the axis [m]) of the capsule to every body: (n, nb), (n,
    nb, 3), (n, nb).

    ``pos_w``, ``axis_w`` (n, 3); ``body_w`` (n, nb, 3); ``kind``, ``yaw`` (nb,), ``size`` (nb, 3). Empty
    slots are infinitely far.
    """
    along = np.linspace(-half_m, half_m, _AXIS_SAMPLES)
    point = pos_w[:, None, :] + along[:, None] * axis_w[:, None, :]
    away = point[:, None, :, :] - np.asarray(body_w, float)[:, :, None, :]
    c, s = (
        turn[None, :, None]
        for turn in (np.cos(np.where(kind == BOX, yaw, 0.0)), np.sin(np.where(kind == BOX, yaw, 0.0)))
    )
    q = np.stack([c * away[..., 0] + s * away[..., 1], c * away[..., 1] - s * away[..., 0], away[..., 2]], -1)
    outside = q - _core_point(q, kind[None, :, None], size[None, :, None, :])
    distance = np.linalg.norm(outside, axis=-1)
    best = distance.argmin(-1)
    gap = (
        np.take_along_axis(distance, best[..., None], -1)[..., 0]
        - radius_m
        - np.where(kind == SPHERE, size[:, 0], 0.0)
    )
    toward = -np.take_along_axis(outside, best[..., None, None], 2)[..., 0, :]
    toward = np.stack(
        [
            c[..., 0] * toward[..., 0] - s[..., 0] * toward[..., 1],
            s[..., 0] * toward[..., 0] + c[..., 0] * toward[..., 1],
            toward[..., 2],
        ],
        -1,
    )
    normal = toward / np.maximum(np.linalg.norm(toward, axis=-1, keepdims=True), 1e-9)
    return np.where(kind == NONE, np.inf, gap), normal, along[best]


def _core_point(q: Array, kind: Array, size: Array) -> Array:
    """Point of a body's core nearest to q: a sphere's core is its centre, other bodies are their own."""
    rho = np.hypot(q[..., 0], q[..., 1])
    scale = np.minimum(1.0, size[..., 0] / np.maximum(rho, 1e-9))
    z = np.clip(q[..., 2], -size[..., 2], size[..., 2])
    cylinder = np.stack([q[..., 0] * scale, q[..., 1] * scale, z], -1)
    box = np.clip(q, -size, size)
    return np.where((kind == BOX)[..., None], box, np.where((kind == CYLINDER)[..., None], cylinder, 0.0))


def wall_gaps(pos_w: Array, axis_w: Array, tank_cfg: TankConfig, radius_m: float, half_m: float) -> Array:
    """(n,) clearance of the hull to the nearest side wall [m]."""
    ends = np.stack([pos_w + half_m * axis_w, pos_w - half_m * axis_w])
    if tank_cfg.shape == "circle":
        middle = [0.5 * sum(tank_cfg.x_m), 0.5 * sum(tank_cfg.y_m)]
        return tank_cfg.radius_m - np.linalg.norm(ends[..., :2] - middle, axis=-1).max(0) - radius_m
    low, high = np.array([tank_cfg.x_m, tank_cfg.y_m]).T
    return np.minimum(ends[..., :2] - low, high - ends[..., :2]).min((0, -1)) - radius_m


def floor_and_surface_gaps(
    pos_w: Array, axis_w: Array, tank_cfg: TankConfig, radius_m: float, half_m: float
) -> tuple[Array, Array]:
    """(n,) clearance of the hull to the floor and to the surface [m]."""
    low, high = tank_cfg.z_m
    reach = np.abs(axis_w[:, 2]) * half_m + radius_m
    return pos_w[:, 2] - low - reach, high - pos_w[:, 2] - reach


def vertical_gap(pos_w: Array, kind: int, body_w: Array, size: Array) -> Array:
    """(n,) signed gap [m] from the sonar's plane to a body's vertical extent: positive = the body is above, 0
    = it crosses the plane."""
    rise = body_w[:, 2] - pos_w[:, 2]
    half = size[0] if kind == SPHERE else size[2]
    return np.where(np.abs(rise) > half, rise - np.sign(rise) * half, 0.0)


def beam_entries(
    pos_w: Array, yaw: Array, kind: int, body_w: Array, size: Array, body_yaw: float, sonar_cfg: SonarConfig
) -> Array:
    """(n, n_ray) range at which each beam enters one body's outline within the sonar's vertical fan; inf = it
    does not (4-sensing.md)."""
    slope = math.tan(math.radians(sonar_cfg.vertical_half_aperture_deg))
    beams = np.arange(sonar_cfg.n_ray)
    bearing = yaw[:, None] + sonar_cfg.first_beam_rad + sonar_cfg.beam_step_rad * beams
    ux, uy = np.cos(bearing), np.sin(bearing)
    start = pos_w - body_w
    sx, sy, rise = start[:, 0:1], start[:, 1:2], np.abs(start[:, 2:3])
    if kind == BOX:
        c, s = math.cos(body_yaw), math.sin(body_yaw)
        enter = _box_entry(sx * c + sy * s, sy * c - sx * s, ux * c + uy * s, uy * c - ux * s, size)
    else:
        lost = np.maximum(rise - np.hypot(sx, sy) * slope, 0.0) if kind == SPHERE else 0.0
        room = size[0] ** 2 - lost**2 - (sx * uy - sy * ux) ** 2
        enter = np.where(room >= 0, -(sx * ux + sy * uy) - np.sqrt(np.maximum(room, 0.0)), np.inf)
    gap = 0.0 if kind == SPHERE else np.maximum(rise - size[2], 0.0)
    return np.where((enter > 0) & (enter * slope >= gap) & (enter <= sonar_cfg.max_range_m), enter, np.inf)


def _box_entry(x: Array, y: Array, dx: Array, dy: Array, size: Array) -> Array:
    into, out = -np.inf, np.inf
    for start, direction, half in ((x, dx, size[0]), (y, dy, size[1])):
        inverse = 1.0 / np.where(np.abs(direction) < 1e-9, 1e-9, direction)
        one, other = (-half - start) * inverse, (half - start) * inverse
        into, out = np.maximum(into, np.minimum(one, other)), np.minimum(out, np.maximum(one, other))
    return np.where(into <= out, into, np.inf)
