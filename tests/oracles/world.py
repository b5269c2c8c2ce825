"""Independent float64 checks of scenarios: gaps between plan views, free space, positions along paths."""

import math
from itertools import pairwise

import numpy as np
from scipy import ndimage

SPHERE, CYLINDER, BOX = 1, 2, 3
GRID_M = 0.05


def outline(kind, pos, size, yaw, spacing=0.005):
    """Points on the outline of an obstacle's plan view (n, 2), corners included."""
    if kind != BOX:
        angle = np.linspace(0, 2 * np.pi, max(8, int(2 * np.pi * size[0] / spacing)), endpoint=False)
        return np.asarray(pos[:2]) + size[0] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]]) * size[:2]
    sides = [np.linspace(a, b, max(2, int(np.hypot(*(b - a)) / spacing))) for a, b in pairwise(corners)]
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray(pos[:2]) + np.concatenate(sides) @ np.array([[c, s], [-s, c]])


def plan_distances(points, kind, pos, size, yaw):
    """Distances [m] of points (..., 2) to an obstacle's plan view; 0 inside a box, negative inside a disc."""
    points = np.asarray(points, float)
    x, y = points[..., 0] - pos[0], points[..., 1] - pos[1]
    if kind != BOX:
        return np.hypot(x, y) - size[0]
    c, s = math.cos(yaw), math.sin(yaw)
    beside = (
        np.maximum(np.abs(c * x + s * y) - size[0], 0.0),
        np.maximum(np.abs(c * y - s * x) - size[1], 0.0),
    )
    return np.hypot(*beside)


def gap(a, b):
    """Smallest distance between plan views (kind, pos, size, yaw) [m], up to 1 mm above the exact one."""
    return float(min(plan_distances(outline(*a), *b).min(), plan_distances(outline(*b), *a).min()))


def keeps_gap(a, b, least):
    """Whether two obstacles' plan views lie this far apart [m]; circles around them tell first."""
    reach = sum(math.hypot(*size[:2]) if kind == BOX else size[0] for kind, _, size, _ in (a, b))
    return math.dist(a[1][:2], b[1][:2]) - reach >= least or gap(a, b) >= least


def wall_distances(points, tank):
    """Distances [m] of points (..., 2) to the side walls, negative outside."""
    x, y = points[..., 0], points[..., 1]
    if tank.shape == "circle":
        return tank.radius_m - np.hypot(x - 0.5 * sum(tank.x_m), y - 0.5 * sum(tank.y_m))
    along = np.minimum(x - tank.x_m[0], tank.x_m[1] - x)
    return np.minimum(along, np.minimum(y - tank.y_m[0], tank.y_m[1] - y))


def is_joined(start, goal, obstacles, tank, clearance):
    """Whether start and goal lie in one region (8 neighbours) with the clearance, less half a diagonal."""
    cols = np.arange(tank.x_m[0] + GRID_M / 2, tank.x_m[1], GRID_M)
    rows = np.arange(tank.y_m[0] + GRID_M / 2, tank.y_m[1], GRID_M)
    points = np.stack(np.meshgrid(cols, rows), axis=-1)
    free = wall_distances(points, tank)
    for body in obstacles:
        free = np.minimum(free, plan_distances(points, *body))
    label, _ = ndimage.label(free >= clearance - GRID_M * np.sqrt(0.5), np.ones((3, 3)))
    cells = [
        label[int((p[1] - tank.y_m[0]) / GRID_M), int((p[0] - tank.x_m[0]) / GRID_M)] for p in (start, goal)
    ]
    return cells[0] == cells[1] > 0


def path_points(n_way, way, radius, length, spacing=0.02):
    """Points (n, 2) all along a path."""
    if n_way == 0:
        angle = np.linspace(0, 2 * np.pi, int(length / spacing) + 2)
        return way[0] + abs(radius) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    closed = [*way[:n_way], way[0]]
    legs = [np.linspace(a, b, int(np.hypot(*(b - a)) / spacing) + 2) for a, b in pairwise(closed)]
    return np.concatenate(legs)


def path_position(path, time_s):
    """(x, y) [m] of a moving obstacle at a time, from its path in scenario.json."""
    arc = (path["phase_m"] + path["speed_m_s"] * time_s) % path["length_m"]
    if path["shape"] == "circle":
        angle = arc / path["radius_m"]
        x, y = path["center"]
        return x + abs(path["radius_m"]) * math.cos(angle), y + abs(path["radius_m"]) * math.sin(angle)
    corners = path["corners"]
    i = 0
    while i < len(corners) - 1 and arc > (leg := math.dist(corners[i], corners[i + 1])):
        arc -= leg
        i += 1
    a, b = corners[i], corners[(i + 1) % len(corners)]
    share = min(1.0, arc / math.dist(a, b))
    return a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])


def driven(corners, phase_m, speed, acceleration, times_s):
    """Rows of (x, y, vx, vy) at times (n,) [s]: around a closed polyline, integrated in steps of 1 ms. Where
    the next corner is so near that half of the change of velocity is done when an obstacle that turns at once
    would be there, it accelerates towards the next leg's velocity."""
    legs = np.roll(corners, -1, axis=0) - corners
    length = np.linalg.norm(legs, axis=1)
    along = speed * legs / length[:, None]
    turn = along - np.roll(along, 1, axis=0)  # at each corner, from the leg before it
    turn_s = np.linalg.norm(turn, axis=1) / acceleration
    begun_s = (np.cumsum(length) - length) / speed  # when each corner would be reached
    lap_s, now_s = length.sum() / speed, phase_m / speed
    share = turn_s[0] / (turn_s[0] + turn_s[1])  # a moment of leg 0 that is in no turn
    t = np.arange(share * length[0] / speed - lap_s, now_s + times_s[-1] + 2e-3, 1e-3)
    apart = (t[:, None] + 5e-4 - begun_s + 0.5 * lap_s) % lap_s - 0.5 * lap_s
    within = np.clip((0.5 * turn_s - np.abs(apart)) / 1e-3 + 0.5, 0.0, 1.0)  # parts of each step
    push = within @ (turn / turn_s[:, None])
    velocity = along[0] + 1e-3 * (np.cumsum(push, axis=0) - push)
    steps = 1e-3 * (velocity + 5e-4 * push)
    place = corners[0] + share * legs[0] + np.cumsum(steps, axis=0) - steps
    return np.hstack([place, velocity])[np.searchsorted(t, now_s + times_s)]
