"""A small NumPy sonar for scenes of the tracking tests: horizontal plane only, circles, yawed boxes and the
walls of a rectangular tank.

Written apart from the product's sonar. All arrays lead with the env: positions (E, 2), obstacles (E, B, ...).
Radius 0 = box.
"""

import numpy as np

N_RAY = 256
MAX_RANGE_M = 12.0


def cast(pos, yaw, vel_w, centre, obstacle_vel, radius, half, obstacle_yaw, tank):
    """Ranges, Doppler (receding positive, own motion included), hit flags and body hit (-1 = wall or
    nothing), each (E, 256)."""
    bearing = yaw[:, None] + np.arange(N_RAY) * (2 * np.pi / N_RAY)
    u = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    to_body = np.stack([_circle(pos, u, centre, radius), _box(pos, u, centre, half, obstacle_yaw)])
    to_body = np.where(radius[:, None, :] > 0, to_body[0], to_body[1])
    # an obstacle that is never hit, so that there may be none
    none = np.full((*to_body.shape[:2], 1), np.inf)
    to_body = np.concatenate([to_body, none], -1)
    obstacle_vel = np.concatenate([obstacle_vel, np.zeros((len(pos), 1, 2))], 1)
    nearest = to_body.argmin(axis=-1)
    to_nearest = np.take_along_axis(to_body, nearest[..., None], -1)[..., 0]
    to_wall = _walls(pos, u, tank)
    body = np.where(to_nearest < to_wall, nearest, -1)
    reach = np.minimum(to_nearest, to_wall)
    surface_vel = np.where(
        (body >= 0)[..., None], np.take_along_axis(obstacle_vel, nearest[..., None], 1), 0.0
    )
    doppler = np.einsum("erk,erk->er", surface_vel - vel_w[:, None, :], u)
    hit = reach < MAX_RANGE_M
    return (
        np.where(hit, reach, MAX_RANGE_M),
        np.where(hit, doppler, 0.0),
        hit.astype(np.int32),
        np.where(hit, body, -1),
    )


def noisy(range_m, doppler, hit, rng, sonar):
    """The errors of a SonarConfig that matter to tracking: range, Doppler with outliers, missed and false
    returns."""
    sigma = sonar.range_sigma_m + sonar.range_sigma_slope * range_m
    answer = (
        range_m
        + sigma * rng.standard_normal(range_m.shape)
        + rng.exponential(sonar.range_jitter_m, range_m.shape)
    )
    rate = doppler + sonar.doppler_sigma_m_s * rng.standard_normal(range_m.shape)
    wild = rng.uniform(size=range_m.shape) < sonar.doppler_outlier
    rate = np.where(
        wild, rng.uniform(-sonar.doppler_outlier_m_s, sonar.doppler_outlier_m_s, range_m.shape), rate
    )
    seen = hit * (rng.uniform(size=range_m.shape) >= sonar.missed_return)
    false = rng.uniform(size=range_m.shape) < sonar.false_return
    answer = np.where(false, rng.uniform(0, MAX_RANGE_M, range_m.shape), answer)
    seen = np.where(false, 1, seen) * (answer < MAX_RANGE_M)
    return (
        np.where(seen, np.maximum(answer, 0), MAX_RANGE_M),
        np.where(seen, rate, 0.0),
        seen.astype(np.int32),
    )


def _circle(pos, u, centre, radius):
    dx, dy = np.moveaxis(centre - pos[:, None, :], -1, 0)
    along = u[..., :1] * dx[:, None] + u[..., 1:] * dy[:, None]
    chord = (radius**2 - dx**2 - dy**2)[:, None] + along**2
    out = along - np.sqrt(np.maximum(chord, 0))
    return np.where((chord > 0) & (out > 0), out, np.inf)


def _box(pos, u, centre, half, obstacle_yaw):
    """Axis by axis: NumPy is slow where the last axis has two elements."""
    c, s = np.cos(obstacle_yaw), np.sin(obstacle_yaw)
    dx, dy = np.moveaxis(pos[:, None, :] - centre, -1, 0)
    enter, leave = -np.inf, np.inf
    for axis, (x, y) in enumerate([(c, s), (-s, c)]):
        way = x[:, None] * u[..., :1] + y[:, None] * u[..., 1:]
        way = np.where(np.abs(way) < 1e-12, 1e-12, way)
        origin, reach = (x * dx + y * dy)[:, None], half[:, None, :, axis]
        a, b = (-reach - origin) / way, (reach - origin) / way
        enter, leave = np.maximum(enter, np.minimum(a, b)), np.minimum(leave, np.maximum(a, b))
    return np.where((enter < leave) & (enter > 0), enter, np.inf)


def _walls(pos, u, tank):
    low, high = np.array([tank.x_m[0], tank.y_m[0]]), np.array([tank.x_m[1], tank.y_m[1]])
    edge = np.where(u > 0, high, low)
    along = np.abs(u) < 1e-12
    far = np.where(along, np.inf, (edge - pos[:, None, :]) / np.where(along, 1.0, u))
    return np.minimum(far[..., 0], far[..., 1])
