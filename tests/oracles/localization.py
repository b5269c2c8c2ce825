"""The pose filter in float64, and the sensors of a made-up voyage: state x, y, heading's correction, velocity
ahead and left, rate of the correction, scale error of the DVL, accelerometer's error ahead and left; beside
it z, heave, error of the zeroed pressure sensor, accelerometer's error upwards.

Scans are taken in at once, all beams in one batch with their full covariance matrix, where the kernel adds
up information and takes in one number after the other.
"""

import numpy as np

N = 9
GRAVITY = 9.81
NEWEST_SHARE, JUMP_SHARE, ACCEL_DENSITY = 0.8, 0.12, 1e-6
SIDE = 2
"""beams on either side that are looked at together, in packets of sixteen"""


def full(triangle, n):
    """Symmetric matrices (..., n, n) of triangles stored row by row."""
    out = np.zeros((*triangle.shape[:-1], n, n))
    i, j = np.triu_indices(n)
    out[..., i, j] = out[..., j, i] = triangle
    return out


def level(roll, pitch, v, axes="ij"):
    """Body vectors in the level frame of the same yaw."""
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    turn = np.array([[cp, sp * sr, sp * cr], [0 * cr, cr, -sr], [-sp, cp * sr, cp * cr]])
    return np.einsum(f"{axes}...,...j->...i", turn, v)


def tilted(roll, pitch, v):
    """Level vectors in the body frame."""
    return level(roll, pitch, v, "ji")


def rotated(yaw, v):
    """Vectors (n, 3) turned to the left by ``yaw`` (n,)."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1], v[:, 2]], -1)


def motion(roll, pitch, force, rates):
    """What the filter makes of the IMU: level acceleration and rate of the yaw, (..., 4)."""
    yaw_rate = (rates[..., 1] * np.sin(roll) + rates[..., 2] * np.cos(roll)) / np.cos(pitch)
    return np.concatenate([level(roll, pitch, force) - [0, 0, GRAVITY], yaw_rate[..., None]], -1)


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


def gated(wrong, gate):
    """Variance of a mean of what passes the gate, by numbers: unit normal values and a share ``wrong`` of
    them anywhere in the gate; per value that passes, in units of its own variance."""
    at = np.linspace(-gate, gate, 20001)
    normal = (1 - wrong) * np.exp(-(at**2) / 2) / np.sqrt(2 * np.pi)
    density = normal + wrong / (2 * gate)
    slope = (normal * at**2).sum()  # of the mean residual by the mean, the gate's edges included
    return density.sum() * (density * at**2).sum() / slope**2


def beside(values):
    """Sum of each beam's value and its neighbours' within its packet of sixteen."""
    rows = np.pad(values.reshape(-1, 16), ((0, 0), (SIDE, SIDE)))
    return sum(rows[:, k : k + 16] for k in range(2 * SIDE + 1)).ravel()


class Filter:
    """Both filters of one vehicle."""

    def __init__(self, start, sensors, cfg, tank, dt):
        self.sensors, self.cfg, self.tank, self.dt = sensors, cfg, tank, dt
        self.mean, self.cov = np.zeros(N), np.zeros((N, N))
        self.mean[:2] = start[:2]
        bias = sensors.imu.accel_bias_m_s2**2
        told, heading = sensors.start_sigma_m**2, sensors.imu.heading_sigma_rad**2
        self.cov[range(N), range(N)] = (
            told, told, heading, 0.01, 0.01, sensors.imu.heading_drift_rad_s**2, sensors.dvl.scale_error**2,
            bias, bias,
        )  # fmt: skip
        self.depth = np.array([start[2], 0, 0, 0])
        self.depth_cov = np.diag([0, 0.01, sensors.pressure.sigma_m**2, bias])

    def seed(self, mean, cov, depth, depth_cov):
        """Go on from what another filter has."""
        self.mean, self.cov = mean.astype(float), full(cov.astype(float), N)
        self.depth, self.depth_cov = depth.astype(float), full(depth_cov.astype(float), 4)

    def middle_sigma(self):
        """Standard deviation of a range half as long as the sonar's reach."""
        s = self.sensors.sonar
        normal = s.range_sigma_m + s.range_sigma_slope * s.max_range_m / 2
        return np.sqrt(normal**2 + s.range_jitter_m**2 + s.range_quantum_m**2 / 12)

    def won(self, jump):
        """Variance that a velocity wins in a step whose acceleration changed by ``jump``."""
        imu = self.sensors.imu
        noise = imu.accel_sigma_m_s2**2 + (GRAVITY * imu.attitude_sigma_rad) ** 2
        return (noise + (JUMP_SHARE * jump) ** 2) * self.dt**2 + ACCEL_DENSITY * self.dt

    def move(self, roll, pitch, imu_yaw, before, now):
        """One step between two readings (acceleration ahead, left, up, yaw rate); the body leans by roll and
        pitch."""
        dt, share, jump = self.dt, NEWEST_SHARE, now - before
        accel, angle = share * now[:3] + (1 - share) * before[:3], 0.5 * dt * (now[3] + before[3])
        bias = np.array([self.mean[7], self.mean[8], self.depth[3]])
        accel = accel - (level(roll, pitch, bias) - bias)
        yaw = imu_yaw + self.mean[2] - angle / 2
        turn = dt * np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        spin = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        push = dt * (accel[:2] + angle / 2 * np.array([accel[1], -accel[0]]))
        f = np.eye(N)
        f[3:5, 3:5], f[3:5, 7:9] = spin, -dt * np.eye(2)
        after = f[3:5] @ self.mean + push
        way = turn @ (self.mean[3:5] + after) / 2
        f[:2, 2] = -way[1], way[0]
        f[:2, 3:5], f[:2, 7:9] = turn @ (np.eye(2) + spin) / 2, -dt / 2 * turn
        f[2, 5] = dt
        self.mean = np.array(
            [*(self.mean[:2] + way), self.mean[2] + dt * self.mean[5], *after, *self.mean[5:]]
        )
        q = np.zeros(N)
        q[2:5] = self.sensors.imu.gyro_noise_rad_s_rthz**2 * dt, self.won(jump[0]), self.won(jump[1])
        self.cov = f @ self.cov @ f.T + np.diag(q)
        f4 = np.eye(4)
        f4[0, 1], f4[0, 3], f4[1, 3] = dt, -dt * dt / 2, -dt
        self.depth = f4 @ self.depth + np.array([dt / 2, 1, 0, 0]) * dt * accel[2]
        self.depth_cov = f4 @ self.depth_cov @ f4.T + np.diag([0, self.won(jump[2]), 0, 0])

    def dvl(self, roll, pitch, vel_b):
        reading, s = level(roll, pitch, vel_b), self.mean[6]
        r = max(self.sensors.dvl.sigma_m_s, 0.002) ** 2
        h = np.zeros((2, N))
        h[:, 3:5], h[:, 6] = (1 + s) * np.eye(2), self.mean[3:5]
        self.mean, self.cov = taken(
            self.mean, self.cov, h, reading[:2] - (1 + s) * self.mean[3:5], r * np.eye(2)
        )
        h3 = np.array([[0.0, 1, 0, 0]])
        self.depth, self.depth_cov = taken(
            self.depth, self.depth_cov, h3, reading[2:] - self.depth[1], r * np.eye(1)
        )

    def pressure(self, depth_m):
        r = max(self.sensors.pressure.sigma_m, 0.001) ** 2 * np.eye(1)
        h = np.array([[-1.0, 0, 1, 0]])
        residual = np.array([depth_m + self.depth[0] - self.depth[2]])
        self.depth, self.depth_cov = taken(self.depth, self.depth_cov, h, residual, r)

    def scan(self, ping_pos, ping_yaw, ping_vel, late, range_m, doppler, hit):
        """Takes a scan in, ``ping_vel`` = level velocity; how near the nearest beam came to a gate's edge."""
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
        doubt = np.einsum("bi,ij,bj->b", h, self.cov, h)
        edge = cfg.gate_sigmas**2 * (var + doubt)
        fits = (hit == 1) & (e**2 < edge) & (rim < 1)
        near = np.minimum(np.abs(e**2 / edge - 1), np.abs(rim - 1))[hit == 1]
        short = np.sum((hit == 1) & (rim < 1) & (e < 0) & (e**2 >= edge))
        count, total = (beside(values) for values in (fits.astype(float), np.where(fits, e, 0.0)))
        mean, bound = total / np.maximum(count, 1), cfg.gate_sigmas**2 * (var / np.maximum(count, 1) + doubt)
        good = fits & (mean**2 < bound)
        near = np.concatenate([near, np.abs(mean**2 / bound - 1)[fits]])
        hv = np.zeros((len(u), N))
        hv[:, 3:5] = -own
        slip = doppler + own @ ping_vel
        still_var = max(sonar.doppler_sigma_m_s, 0.01) ** 2
        swing = cfg.gate_sigmas**2 * (still_var + np.einsum("bi,ij,bj->b", hv, self.cov, hv))
        still = good & (slip**2 < swing)
        near = np.concatenate([near, np.abs(slip**2 / swing - 1)[good]])
        rows, residual = np.concatenate([h[good], hv[still]]), np.concatenate([e[good], slip[still]])
        width = 2 * cfg.gate_sigmas * self.middle_sigma()
        clutter = (sonar.false_return + sonar.ghost) * width / sonar.max_range_m
        wild = sonar.doppler_outlier * cfg.gate_sigmas * np.sqrt(still_var) / sonar.doppler_outlier_m_s
        deep = width / 2 / np.sqrt(2 * SIDE + 1)
        var *= gated(clutter, cfg.gate_sigmas)
        unseen = cfg.obstacle_returns_per_m * deep**2 / (sonar.max_range_m / 2)
        var *= 1 + unseen * short / max(short + good.sum(), 1)
        still_var *= gated(wild, cfg.gate_sigmas)
        noise = np.diag(np.concatenate([var[good], np.full(still.sum(), still_var)]))
        k = good.sum()
        noise[k:, k:] += self.won(0.0) * late / self.dt * own[still] @ own[still].T
        if len(rows):
            self.mean, self.cov = taken(self.mean, self.cov, rows, residual, noise)
        return near.min(initial=1.0)


class Voyage:
    """Truth and readings of ``n`` vehicles that steer for another velocity now and then."""

    def __init__(self, n, steps, sensors, tank, dt, rng, obstacles=None):
        self.sensors, self.tank, self.rng, self.obstacles = sensors, tank, rng, obstacles
        t = np.arange(steps)[:, None] * dt
        mid = np.array([sum(tank.x_m), sum(tank.y_m)]) / 2
        turn = rng.uniform(0.5, 1.5, n), rng.uniform(0, 6.28, n)
        rate = 0.6 * np.sin(turn[0] * t + turn[1])
        self.yaw = rng.uniform(-np.pi, np.pi, n) - 0.6 / turn[0] * np.cos(turn[0] * t + turn[1])
        self.roll = 0.05 * np.sin(t + rng.uniform(0, 6, n))
        self.pitch = 0.08 * np.sin(2 * t + rng.uniform(0, 6, n))
        self.vel, self.pos, accel = (np.zeros((steps, n, 3)) for _ in range(3))
        self.vel[0] = 0.1 * rng.normal(size=(n, 3))
        self.pos[0] = [*mid, -0.8] + rng.uniform(-1, 1, (n, 3)) * [1.5, 0.5, 0.0]
        aim = np.repeat(rng.normal(size=(-(-steps // 25), n, 3)) * [0.3, 0.3, 0.1], 25, 0)
        for k in range(1, steps):
            accel[k] = (aim[k] - self.vel[k - 1]) / 0.3
            jump = accel[k] - accel[k - 1]
            between = accel[k] + (NEWEST_SHARE - 1 + JUMP_SHARE * rng.normal(size=(n, 3))) * jump
            between += np.sqrt(ACCEL_DENSITY / dt) * rng.normal(size=(n, 3))
            before = rotated(self.yaw[k - 1], self.vel[k - 1])
            push = rotated((self.yaw[k] + self.yaw[k - 1]) / 2, dt * between)
            self.pos[k] = self.pos[k - 1] + dt * (before + push / 2)
            self.vel[k] = rotated(-self.yaw[k], before + push)
        imu, dvl, p = sensors.imu, sensors.dvl, sensors.pressure
        gyro = imu.gyro_noise_rad_s_rthz / np.sqrt(dt) * rng.normal(size=(steps, n))
        drift = imu.heading_drift_rad_s * rng.normal(size=n) + gyro
        drift[0] = 0
        self.imu_yaw, self.told = self.yaw + dt * np.cumsum(drift, 0), self.pos[0].copy()
        # the level frame turns by the yaw alone: rates of roll and pitch do not matter to the filter
        yaw_rate = (rate + gyro) * np.cos(self.pitch)
        self.rates = np.stack([0 * rate, yaw_rate * np.sin(self.roll), yaw_rate * np.cos(self.roll)], -1)
        gravity, bias = np.array([0.0, 0.0, GRAVITY]), imu.accel_bias_m_s2 * rng.normal(size=(n, 3))
        self.force = tilted(self.roll, self.pitch, accel + gravity) + bias
        self.force += imu.accel_sigma_m_s2 * rng.normal(size=self.force.shape)
        scale = 1 + dvl.scale_error * rng.normal(size=n)
        self.reading = scale[:, None] * tilted(self.roll, self.pitch, self.vel)
        self.reading += dvl.sigma_m_s * rng.normal(size=self.reading.shape)
        noise = p.sigma_m * rng.normal(size=(steps, n))
        self.depth = -self.pos[:, :, 2] + noise - noise[0]
        self.valid = np.ones((steps, n), np.int32)
        begin = rng.integers(50, 100, n)
        self.imu_yaw += imu.heading_sigma_rad * rng.normal(size=n)
        self.told[:, :2] += sensors.start_sigma_m * rng.normal(size=(n, 2))
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
        for x, y, radius in () if self.obstacles is None else self.obstacles:
            along = np.sum((np.array([x, y]) - at) * u, -1)
            across = u[..., 0] * (y - at[..., 1]) - u[..., 1] * (x - at[..., 0])
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
