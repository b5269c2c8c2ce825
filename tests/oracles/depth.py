"""NumPy float64 oracle of the clean depth camera: every surface on its own, nearest seen from outside."""

import numpy as np

from tests.oracles.scenes import BOX, SPHERE, rotation


def camera_rays(quat, pixels, depth):
    """World rays [n, 3] with body-x component 1 through the centres of pixels [n, 2] = (row, col)."""
    focal = 0.5 * depth.cols / np.tan(np.radians(0.5 * depth.fov_deg))
    right = (pixels[:, 1] + 0.5 - 0.5 * depth.cols) / focal
    down = (pixels[:, 0] + 0.5 - 0.5 * depth.rows) / focal
    return np.stack([np.ones(len(pixels)), -right, -down], axis=1) @ rotation(quat).T


def camera_position(scene, env, depth):
    return scene["pos"][env] + rotation(scene["quat"][env]) @ np.array(depth.offset_b_m)


def z_depths(scene, env, tank, rays, eye):
    """z-depth [n] along rays from ``eye``, without the limit of range; it is outside every obstacle."""
    best = walls(eye, rays, tank)
    for body in np.flatnonzero(scene["kind"][env]):
        kind, size, yaw = scene["kind"][env, body], scene["size"][env, body], scene["yaw"][env, body]
        turn = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        start, d = turn @ (eye - scene["obstacle_pos"][env, body]), rays @ turn.T
        if kind == SPHERE:
            found = [round_surface(start, d, size[0])]
        elif kind == BOX:
            found = [
                flat_face(start, d, axis, side * size[axis], size, False)
                for axis in range(3)
                for side in (-1, 1)
            ]
        else:
            side = round_surface(start[:2], d[:, :2], size[0])
            side[np.abs(start[2] + np.where(np.isinf(side), 0.0, side) * d[:, 2]) > size[2]] = np.inf
            found = [side] + [flat_face(start, d, 2, cap * size[2], size, True) for cap in (-1, 1)]
        best = np.minimum(best, np.min(found, axis=0))
    return best


def walls(eye, rays, tank):
    d = rays[:, :2]
    with np.errstate(divide="ignore"):
        if tank.shape == "circle":
            rel = eye[:2] - [0.5 * (tank.x_m[0] + tank.x_m[1]), 0.5 * (tank.y_m[0] + tank.y_m[1])]
            a, b, c = np.sum(d * d, axis=1), d @ rel, rel @ rel - tank.radius_m**2
            return (-b + np.sqrt(b * b - a * c)) / a
        tx = np.where(d[:, 0] > 0, tank.x_m[1] - eye[0], tank.x_m[0] - eye[0]) / d[:, 0]
        ty = np.where(d[:, 1] > 0, tank.y_m[1] - eye[1], tank.y_m[0] - eye[1]) / d[:, 1]
    return np.minimum(tx, ty)


def round_surface(start, d, radius):
    """First crossing of a circle or sphere around the origin, inf if none ahead."""
    a, b, c = np.sum(d * d, axis=1), d @ start, start @ start - radius**2
    room = b * b - a * c
    with np.errstate(invalid="ignore"):
        t = (-b - np.sqrt(room)) / a
    return np.where((room > 0) & (t > 0), t, np.inf)


def flat_face(start, d, axis, level, size, disc):
    """Crossing of one face, a rectangle or a disc, inf if none ahead."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (level - start[axis]) / d[:, axis]
        p = start + t[:, None] * d
        if disc:
            inside = np.hypot(p[:, 0], p[:, 1]) <= size[0]
        else:
            others = [i for i in range(3) if i != axis]
            inside = np.all(np.abs(p[:, others]) <= size[others], axis=1)
    return np.where((t > 0) & inside, t, np.inf)
