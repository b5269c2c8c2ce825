"""NumPy float64 oracle of the clean sonar: segments, quadratics, no spans."""

import numpy as np

from tests.oracles.scenes import BOX, SPHERE, rotation

WALL = -1


def beam_headings(quat, n_ray):
    """World bearings of the beams [n_ray], from the yaw of the Z-Y-X angles."""
    R = rotation(quat)
    return np.arctan2(R[1, 0], R[0, 0]) + 2 * np.pi * np.arange(n_ray) / n_ray


def sonar_scan(scene, env, tank, n_ray, aperture_deg, turn=0.0):
    """(range [n_ray], cosine, index of the body hit or WALL), without limit; bearings off by ``turn``."""
    pos = scene["pos"][env]
    bearing = beam_headings(scene["quat"][env], n_ray) + turn
    u = np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
    best, cosine = wall_hits(pos[:2], u, tank)
    who = np.full(n_ray, WALL)
    slope = np.tan(np.radians(aperture_deg))
    for body in np.flatnonzero(scene["kind"][env]):
        r, c = obstacle_hits(scene, env, body, pos, u, slope)
        nearer = r < best
        best, cosine = np.where(nearer, r, best), np.where(nearer, c, cosine)
        who = np.where(nearer, body, who)
    return best, cosine, who


def wall_hits(start, u, tank):
    """(range, cosine) of the side walls from inside."""
    if tank.shape == "circle":
        rel = start - [0.5 * (tank.x_m[0] + tank.x_m[1]), 0.5 * (tank.y_m[0] + tank.y_m[1])]
        b = u @ rel
        r = -b + np.sqrt(b * b - rel @ rel + tank.radius_m**2)
        return r, np.sum((rel + r[:, None] * u) * u, axis=1) / tank.radius_m
    with np.errstate(divide="ignore"):
        tx = np.where(u[:, 0] > 0, tank.x_m[1] - start[0], tank.x_m[0] - start[0]) / u[:, 0]
        ty = np.where(u[:, 1] > 0, tank.y_m[1] - start[1], tank.y_m[0] - start[1]) / u[:, 1]
    return np.minimum(tx, ty), np.where(tx < ty, np.abs(u[:, 0]), np.abs(u[:, 1]))


def obstacle_hits(scene, env, body, pos, u, slope):
    """(range, cosine) where beams enter an outline and the vertical gap allows it, else inf."""
    kind, size = scene["kind"][env, body], scene["size"][env, body]
    rel = scene["obstacle_pos"][env, body] - pos
    if kind == BOX:
        r, cosine = box_entry(rel[:2], size[:2], scene["yaw"][env, body], u)
    else:
        radius_squared = size[0] ** 2
        if kind == SPHERE:
            radius_squared -= max(0.0, abs(rel[2]) - np.hypot(rel[0], rel[1]) * slope) ** 2
        r, cosine = circle_entry(rel[:2], radius_squared, u)
    gap = 0.0 if kind == SPHERE else max(0.0, abs(rel[2]) - size[2])
    return np.where(np.isfinite(r) & (gap <= np.where(np.isfinite(r), r, 0.0) * slope), r, np.inf), cosine


def circle_entry(centre, radius_squared, u):
    """First crossing of a circle from outside, by the quadratic formula."""
    b = u @ centre
    room = b * b - centre @ centre + radius_squared
    with np.errstate(invalid="ignore"):
        r = b - np.sqrt(room)
        r = np.where((room > 0) & (r > 0), r, np.inf)
        cosine = np.sqrt(room / radius_squared) if radius_squared > 0 else np.zeros(len(u))
    return r, cosine


def box_entry(centre, half, yaw, u):
    """First crossing of a yawed rectangle from outside: nearest of its four edges."""
    c, s = np.cos(yaw), np.sin(yaw)
    axes = np.array([[c, s], [-s, c]])
    best, cosine = np.full(len(u), np.inf), np.zeros(len(u))
    if np.all(np.abs(axes @ centre) < half):
        return best, cosine
    for axis in (0, 1):
        for side in (-1.0, 1.0):
            normal, along = side * axes[axis], axes[1 - axis]
            approach = -(u @ normal)
            with np.errstate(divide="ignore", invalid="ignore"):
                r = -(normal @ centre + half[axis]) / approach
                offset = (r[:, None] * u - centre) @ along
                hit = (approach > 0) & (r > 0) & (np.abs(offset) <= half[1 - axis]) & (r < best)
            best, cosine = np.where(hit, r, best), np.where(hit, approach, cosine)
    return best, cosine


def doppler_by_differences(scene, env, u, range_m, who, dt=1.0e-4):
    """[m/s] central difference of the distance to the material point that each beam hit; u [n, 2]."""
    sensor_vel = rotation(scene["quat"][env]) @ scene["vel_b"][env]
    moving = np.where((who == WALL)[:, None], 0.0, scene["obstacle_vel"][env][who])
    point = np.column_stack([range_m[:, None] * u, np.zeros(len(u))])
    ahead = np.linalg.norm(point + (moving - sensor_vel) * dt, axis=1)
    behind = np.linalg.norm(point - (moving - sensor_vel) * dt, axis=1)
    return (ahead - behind) / (2 * dt)
