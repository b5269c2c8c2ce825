"""The pose filter in float64, and the sensors of a made-up voyage: state x, y, heading's correction, velocity
ahead and left, rate of the correction, scale error of the DVL; beside it z, heave, error of the zeroed
pressure sensor.

Scans are taken in at once, all beams in one batch with their full covariance matrix, where the kernel adds
up information and takes in one number after the other.
"""

import numpy as np

N = 7
UP = np.triu_indices(N)
UP3 = np.triu_indices(3)


def full(triangle, n):
    """Symmetric matrices (..., n, n) of triangles stored row by row."""
    out = np.zeros((*triangle.shape[:-1], n, n))
    i, j = np.triu_indices(n)
    out[..., i, j] = out[..., j, i] = triangle
    return out


def level(roll, pitch, v):
    """Body vectors in the level frame of the same yaw."""
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    turn = np.array([[cp, sp * sr, sp * cr], [0 * cr, cr, -sr], [-sp, cp * sr, cp * cr]])
    return np.einsum("ij...,...j->...i", turn, v)


def tilted(roll, pitch, v):
    """Level vectors in the body frame."""
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    turn = np.array([[cp, sp * sr, sp * cr], [0 * cr, cr, -sr], [-sp, cp * sr, cp * cr]])
    return np.einsum("ji...,...j->...i", turn, v)


def wall(tank, pos, u):
    """(range, inward normal) of the wall that rays from ``pos`` (.., 2) along ``u`` (.., 2) meet."""
    if tank.shape == "circle":
        centre = np.array([sum(tank.x_m), sum(tank.y_m)]) / 2
        s = pos - centre
        b = np.sum(s * u, -1)
        r = -b + np.sqrt(np.maximum(b * b - np.sum(s * s, -1) + tank.radius_m**2, 0.0))
        return r, -(s + r[..., None] * u) / tank.radius_m
    high = np.array([tank.x_m[1], tank.y_m[1]])
    low = np.array([tank.x_m[0], tank.y_m[0]])
    with np.errstate(divide="ignore"):
        to = np.where(u > 0, high - pos, low - pos) / u
    first = np.argmin(np.where(u == 0, np.inf, to), -1)
    axis = np.eye(2)[first]
    return np.sum(to * axis, -1), -np.sign(u) * axis


def taken(mean, cov, h, residual, noise):
    """Kalman's update for a batch of measurements with covariance ``noise``, in Joseph's form."""
    gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + noise)
    left = np.eye(len(mean)) - gain @ h
    return mean + gain @ residual, left @ cov @ left.T + gain @ noise @ gain.T


class Filter:
    """Both filters of one vehicle."""

    def __init__(self, start, sensors, cfg, tank, dt):
        self.sensors, self.cfg, self.tank, self.dt = sensors, cfg, tank, dt
        self.mean, self.cov = np.zeros(N), np.zeros((N, N))
        self.mean[:2] = start[:2]
        self.cov[[3, 4, 5, 6], [3, 4, 5, 6]] = (
            0.01, 0.01, sensors.imu.heading_drift_rad_s**2, sensors.dvl.scale_error**2,
        )  # fmt: skip
        self.depth, self.depth_cov = (
            np.array([start[2], 0, 0]),
            np.diag([0, 0.01, sensors.pressure.sigma_m**2]),
        )

    def seed(self, mean, cov, depth, depth_cov):
        """Go on from what another filter has."""
        self.mean, self.cov = mean.astype(float), full(cov.astype(float), N)
        self.depth, self.depth_cov = depth.astype(float), full(depth_cov.astype(float), 3)

    def move(self, imu_yaw, yaw_rate):
        dt = self.dt
        yaw = imu_yaw + self.mean[2] - yaw_rate * dt / 2
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        way = dt * turn @ self.mean[3:5]
        f = np.eye(N)
        f[:2, 2] = -way[1], way[0]
        f[:2, 3:5] = dt * turn
        f[2, 5] = dt
        self.mean = self.mean + np.array([*way, dt * self.mean[5], 0, 0, 0, 0])
        q = np.diag([0, 0, self.sensors.imu.gyro_noise_rad_s_rthz**2, *[self.cfg.accel_density] * 2, 0, 0])
        self.cov = f @ self.cov @ f.T + q * dt
        f3 = np.eye(3)
        f3[0, 1] = dt
        self.depth = f3 @ self.depth
        self.depth_cov = f3 @ self.depth_cov @ f3.T + np.diag([0, self.cfg.heave_density * dt, 0])

    def dvl(self, roll, pitch, vel_b):
        reading, s = level(roll, pitch, vel_b), self.mean[6]
        r = max(self.sensors.dvl.sigma_m_s, 0.002) ** 2
        h = np.zeros((2, N))
        h[:, 3:5], h[:, 6] = (1 + s) * np.eye(2), self.mean[3:5]
        self.mean, self.cov = taken(
            self.mean, self.cov, h, reading[:2] - (1 + s) * self.mean[3:5], r * np.eye(2)
        )
        h3 = np.array([[0.0, 1, 0]])
        self.depth, self.depth_cov = taken(
            self.depth, self.depth_cov, h3, reading[2:] - self.depth[1], r * np.eye(1)
        )

    def pressure(self, depth_m):
        r = max(self.sensors.pressure.sigma_m, 0.001) ** 2 * np.eye(1)
        h = np.array([[-1.0, 0, 1]])
        residual = np.array([depth_m + self.depth[0] - self.depth[2]])
        self.depth, self.depth_cov = taken(self.depth, self.depth_cov, h, residual, r)

    def scan(self, ping_pos, ping_yaw, late, range_m, doppler, hit):
        """Takes a scan in; returns how near the nearest beam came to a gate's edge (0 = on it)."""
        sonar, cfg = self.sensors.sonar, self.cfg
        bearing = 2 * np.pi * np.arange(len(range_m)) / len(range_m)
        own = np.stack([np.cos(bearing), np.sin(bearing)], 1)
        c, s = np.cos(ping_yaw), np.sin(ping_yaw)
        u = own @ np.array([[c, s], [-s, c]])
        r, n = wall(self.tank, np.broadcast_to(ping_pos[:2], u.shape), u)
        cosine = -np.sum(n * u, 1)
        lever = r * (n[:, 1] * u[:, 0] - n[:, 0] * u[:, 1])
        e = cosine * (range_m - sonar.range_jitter_m - r)
        sigma = sonar.range_sigma_m + sonar.range_sigma_slope * r
        along = sigma**2 + sonar.range_jitter_m**2 + sonar.range_quantum_m**2 / 12
        rim = (r + cfg.gate_sigmas * np.sqrt(along) + sonar.range_jitter_m) / sonar.max_range_m
        var = cosine**2 * along
        var += (lever * cfg.bearing_sigma_rad) ** 2 + cfg.wall_sigma_m**2
        ping = np.zeros((3, N))
        ping[:, :3] = np.eye(3)
        ping[:2, 3:5] = -late * np.array([[c, -s], [s, c]])
        h = np.column_stack([n, lever]) @ ping
        edge = cfg.gate_sigmas**2 * (var + np.einsum("bi,ij,bj->b", h, self.cov, h))
        good = (hit == 1) & (e**2 < edge) & (rim < 1)
        near = np.minimum(np.abs(e**2 / edge - 1), np.abs(rim - 1))[hit == 1]
        hv = np.zeros((len(u), N))
        hv[:, 3:5] = -own
        slip = doppler + own @ self.mean[3:5]
        still_var = max(sonar.doppler_sigma_m_s, 0.01) ** 2
        swing = cfg.gate_sigmas**2 * (still_var + np.einsum("bi,ij,bj->b", hv, self.cov, hv))
        still = good & (slip**2 < swing)
        near = np.concatenate([near, np.abs(slip**2 / swing - 1)[good]])
        rows, residual = np.concatenate([h[good], hv[still]]), np.concatenate([e[good], slip[still]])
        noise = np.diag(cfg.inflation * np.concatenate([var[good], np.full(still.sum(), still_var)]))
        k = good.sum()
        noise[k:, k:] += cfg.accel_density * late * own[still] @ own[still].T
        if len(rows):
            self.mean, self.cov = taken(self.mean, self.cov, rows, residual, noise)
        return near.min(initial=1.0)


class Voyage:
    """Truth and readings of ``n`` vehicles that move as the filter supposes: velocity and heave wander."""

    def __init__(self, n, steps, sensors, cfg, tank, dt, rng, bodies=None):
        self.sensors, self.tank, self.rng, self.bodies = sensors, tank, rng, bodies
        t = np.arange(steps)[:, None] * dt
        mid = np.array([sum(tank.x_m), sum(tank.y_m)]) / 2
        rate = 0.6 * np.sin(rng.uniform(0.5, 1.5, n) * t + rng.uniform(0, 6.28, n))
        self.yaw = rng.uniform(-np.pi, np.pi, n) + dt * np.cumsum(rate, 0)
        self.roll, self.pitch = (
            0.05 * np.sin(t + rng.uniform(0, 6, n)),
            0.08 * np.sin(2 * t + rng.uniform(0, 6, n)),
        )
        wander = rng.normal(size=(steps, n, 3)) * np.sqrt(
            np.array([cfg.accel_density] * 2 + [cfg.heave_density]) * dt
        )
        self.vel = np.cumsum(wander, 0) + 0.1 * rng.normal(size=(n, 3))
        self.pos = np.empty((steps, n, 3))
        self.pos[0] = [*mid, -0.8] + rng.uniform(-1, 1, (n, 3)) * [1.5, 0.5, 0.0]
        for k in range(1, steps):
            half = self.yaw[k] - 0.5 * dt * rate[k]
            v = self.vel[k - 1]
            way = [
                np.cos(half) * v[:, 0] - np.sin(half) * v[:, 1],
                np.sin(half) * v[:, 0] + np.cos(half) * v[:, 1],
            ]
            self.pos[k] = self.pos[k - 1] + dt * np.stack([*way, v[:, 2]], 1)
        imu, dvl, p = sensors.imu, sensors.dvl, sensors.pressure
        gyro = imu.gyro_noise_rad_s_rthz / np.sqrt(dt) * rng.normal(size=(steps, n))
        drift = imu.heading_drift_rad_s * rng.normal(size=n) + gyro
        drift[0] = 0
        self.imu_yaw, self.rate = self.yaw + dt * np.cumsum(drift, 0), rate + gyro
        scale = 1 + dvl.scale_error * rng.normal(size=n)
        self.reading = scale[:, None] * tilted(self.roll, self.pitch, self.vel)
        self.reading += dvl.sigma_m_s * rng.normal(size=self.reading.shape)
        noise = p.sigma_m * rng.normal(size=(steps, n))
        self.depth = -self.pos[:, :, 2] + noise - noise[0]
        self.valid = np.ones((steps, n), np.int32)
        begin = rng.integers(50, 100, n)
        if dvl.dropout_s[1] > 0:  # a burst of one to two seconds in every second row
            lost = (np.arange(steps)[:, None] >= begin) & (np.arange(steps)[:, None] < begin + 75)
            self.valid[lost & (np.arange(n) % 2 == 0)] = 0

    def scan(self, k):
        """(range, Doppler, hit) of a ping at step k, each (n, n_ray)."""
        sonar, rng = self.sensors.sonar, self.rng
        bearing = 2 * np.pi * np.arange(sonar.n_ray) / sonar.n_ray
        angle = self.yaw[k][:, None] + bearing
        u = np.stack([np.cos(angle), np.sin(angle)], -1)
        at = np.broadcast_to(self.pos[k][:, None, :2], u.shape)
        r, normal = wall(self.tank, at, u)
        r = np.where(-np.sum(normal * u, -1) < sonar.grazing_cosine, np.inf, r)
        for x, y, radius in () if self.bodies is None else self.bodies:
            along, across = (
                np.sum((np.array([x, y]) - at) * u, -1),
                u[..., 0] * (y - at[..., 1]) - u[..., 1] * (x - at[..., 0]),
            )
            met = (np.abs(across) < radius) & (along > 0)
            r = np.where(met, np.minimum(r, along - np.sqrt(np.maximum(radius**2 - across**2, 0))), r)
        ghost = rng.random(r.shape) < sonar.ghost
        r = np.where(ghost, r + rng.uniform(0, 8, r.shape), r)
        r = np.where(rng.random(r.shape) < sonar.missed_return, np.inf, r)
        sigma = sonar.range_sigma_m + sonar.range_sigma_slope * np.where(np.isfinite(r), r, 0)
        r = r + sigma * rng.normal(size=r.shape) + sonar.range_jitter_m * rng.exponential(size=r.shape)
        false = rng.random(r.shape) < sonar.false_return
        r = np.maximum(np.where(false, rng.uniform(0, sonar.max_range_m, r.shape), r), 0)
        hit = r <= sonar.max_range_m
        own = self.vel[k][:, None, 0] * np.cos(bearing) + self.vel[k][:, None, 1] * np.sin(bearing)
        doppler = -own + sonar.doppler_sigma_m_s * rng.normal(size=r.shape)
        wild = rng.random(r.shape) < sonar.doppler_outlier
        doppler = np.where(wild, rng.uniform(-2, 2, r.shape), doppler)
        return np.where(hit, r, sonar.max_range_m), np.where(hit, doppler, 0.0), hit.astype(np.int32)
