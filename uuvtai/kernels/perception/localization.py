"""Where the vehicle is: two Kalman filters on sensor data and the known bounds of the water.

Horizontal, extended: x, y, the heading's correction, velocity ahead and to the left in the level body frame,
the correction's rate (the gyro drifts), the DVL's scale error and the accelerometer's error. The velocity
carries the position from step to step, and the accelerometer the velocity from one reading of the DVL to the
next, or while that has lost the bottom. Rotors follow their command within a step, so a change of the
acceleration makes the velocity less sure. Every fresh scan corrects pose and velocity by the beams that end
on a known wall (wall_fix.py). Depth: z, heave, the error that zeroing the pressure sensor at the known start
has left, and the accelerometer's upwards. The start is known but for ``sensors.start_sigma_m``.

Errors of a scan refer to its ping: the pose there is off by the pose's error of now less the latency times
the velocity's; for one later than the sonar's own latency the accelerometer's error counts too. S. Thrun,
W. Burgard, D. Fox, Probabilistic Robotics (2005), chapters 3 and 7.
"""

import math
from typing import Any

import taichi as ti

from uuvtai.compile.launch import quick_launch
from uuvtai.kernels.core.beams import beam_lanes
from uuvtai.kernels.core.geometry import quaternion_wb, rotation_wb, wrapped_angle
from uuvtai.kernels.core.kalman import halved, measured, place
from uuvtai.kernels.core.simd import LANES, f16x, lane_bits
from uuvtai.kernels.core.stage import Bundle, Out, n_envs
from uuvtai.kernels.perception.io import LocalizationIO
from uuvtai.kernels.perception.sensor_model import is_new

# ------------------------------------------------------------------------------------------------------------
# What the beams that end on a known wall say of the own pose and velocity (part of the pose stage).
#
# A beam along the unit vector u meets a wall of inward normal n at the range r: the point where it ends lies
# e = c (range - r), c = -u'n, off the wall, and that is n'(error of the position) + r n'v (error of the
# heading), v = u turned to the left by a right angle. The wall does not move, so its Doppler is -u'(own
# velocity). Each beam adds its part to an information matrix and vector; obstacles before a wall, ghosts and
# clutter lie outside the gate, or outside that of a few neighbouring beams together. What passes all the same
# makes every beam count less, as much as the sonar's rates of wrong returns and the returns before the walls
# say. A sonar without Doppler says nothing of the velocity.


_BESIDE = 2  # Beams on either side that are looked at together with one: most obstacles are wider.

_MOST_WRONG = 0.5  # No sonar is taken to be worse.

NEWEST_SHARE, JUMP_SHARE = 0.8, 0.12
"""Share of a step's mean acceleration that its newest reading tells, for rotors follow their command within a
step, and its standard deviation: what a change of the acceleration leaves unknown (EC, tuned)."""

ACCEL_DENSITY = 1e-6
"""[m^2/s^3] spectral density of what else the acceleration leaves unknown; the accelerometer's own errors
come on top (EC, tuned)."""

Beams = ti.types.struct(ahead=f16x, left=f16x, range_m=f16x, hit=f16x)
"""Sixteen neighbouring beams: direction in the level body frame, and what was measured."""

Fix = ti.types.struct(
    pose=ti.types.vector(6, ti.f32),
    pose_part=ti.math.vec3,
    velocity=ti.types.vector(3, ti.f32),
    velocity_part=ti.math.vec2,
)
"""Information on (x, y, heading) at the ping and on (velocity ahead, to the left): upper triangles of the
matrices, and the vectors H'R^-1 residual."""


@ti.func
def seen_walls(env, place_cov, speed, speed_cov, io: Bundle[LocalizationIO]):
    """Fix from the newest scan. ``place_cov`` (6) and ``speed_cov`` (3): covariance of the pose at the ping
    and of the velocity, their upper triangles, for the gates; ``speed`` (2) the velocity."""
    pos, yaw = io.scan.ping_pos_w[env], io.scan.ping_yaw[env]
    c, s = ti.cos(yaw), ti.sin(yaw)
    fix = Fix(pose=0.0, pose_part=0.0, velocity=0.0, velocity_part=0.0)
    seen, short, kept = 0.0, 0.0, ti.Vector.zero(ti.i32, ti.static(io.sensors_cfg.sonar.n_ray // LANES))
    for packet in range(ti.static(io.sensors_cfg.sonar.n_ray // LANES)):
        beams = read_beams(env, packet, io)
        ux, uy = c * beams.ahead - s * beams.left, s * beams.ahead + c * beams.left
        r, nx, ny = expected_wall(pos[0], pos[1], ux, uy, io)
        lever = r * (ny * ux - nx * uy)
        cosine = -(nx * ux + ny * uy)
        e = cosine * (beams.range_m - r)
        along = range_variance(r, io)
        var = (
            cosine * cosine * along
            + lever * lever * ti.static(aim_variance(io.sensors_cfg, io.localization_cfg))
            + ti.static(io.localization_cfg.wall_sigma_m**2)
        )
        doubt = form3(place_cov, nx, ny, lever)
        near = r + io.localization_cfg.gate_sigmas * ti.sqrt(along) < ti.static(
            io.sensors_cfg.sonar.max_range_m - io.sensors_cfg.sonar.range_jitter_m
        )
        fits = e * e < ti.static(io.localization_cfg.gate_sigmas**2) * (var + doubt)
        good = beams.hit * ti.select(near & fits, 1.0, 0.0)
        n = ti.max(beside(good), 1.0)
        mean = beside(good * e) / n
        together = mean * mean < ti.static(io.localization_cfg.gate_sigmas**2) * (var / n + doubt)
        good *= ti.select(together, 1.0, 0.0)
        seen += good.sum()
        short += (beams.hit * ti.select(near & (e < 0.0) & ~fits, 1.0, 0.0)).sum()
        weight = good / (
            var * ti.static(gated(wrong_ranges(io.sensors_cfg, io.localization_cfg), io.localization_cfg))
        )
        wx, wy, wt = weight * nx, weight * ny, weight * lever
        fix.pose += ti.Vector(
            [
                (wx * nx).sum(), (wx * ny).sum(), (wx * lever).sum(),
                (wy * ny).sum(), (wy * lever).sum(), (wt * lever).sum(),
            ]
        )  # fmt: skip
        fix.pose_part += ti.Vector([(wx * e).sum(), (wy * e).sum(), (wt * e).sum()])
        kept[packet] = lane_bits(good > 0.0)
    # what stands before the walls, as much as was seen of it, stands unseen just before them too
    share = short / ti.max(short + seen, 1.0)
    together = 1.0 / (1.0 + share * ti.static(unseen_returns(io.sensors_cfg, io.localization_cfg)))
    fix.pose *= together
    fix.pose_part *= together
    if ti.static(io.sensors_cfg.sonar.doppler):
        add_dopplers(env, fix, kept, speed, speed_cov, io)
    return fix


@ti.func
def add_dopplers(env, fix: Out[Any], kept, speed, speed_cov, io: Bundle[LocalizationIO]):
    """What the Doppler of the beams that end on a wall says of the velocity; ``kept``: a bit for each of
    them, by packet. A loop of its own: both together need more registers than a GPU's thread has."""
    for packet in range(ti.static(io.sensors_cfg.sonar.n_ray // LANES)):
        ahead, left, _ahead, _left = beam_lanes(0.0, packet * LANES, io.sensors_cfg.sonar)
        good, doppler = f16x(0.0), f16x(0.0)
        for i in ti.static(range(LANES)):
            good[i] = ti.cast((kept[packet] >> i) & 1, ti.f32)
            doppler[i] = io.scan.doppler_m_s[env, packet * LANES + i]
        slip = doppler + speed[0] * ahead + speed[1] * left
        swing = ti.static(doppler_variance(io.sensors_cfg)) + (
            speed_cov[0] * ahead * ahead + 2.0 * speed_cov[1] * ahead * left + speed_cov[2] * left * left
        )
        still = good * ti.select(
            slip * slip < ti.static(io.localization_cfg.gate_sigmas**2) * swing, 1.0, 0.0
        )
        trust = still * ti.static(
            1.0
            / gated(wrong_dopplers(io.sensors_cfg, io.localization_cfg), io.localization_cfg)
            / doppler_variance(io.sensors_cfg)
        )
        va, vl = trust * ahead, trust * left
        fix.velocity += ti.Vector([(va * ahead).sum(), (va * left).sum(), (vl * left).sum()])
        fix.velocity_part -= ti.Vector([(va * slip).sum(), (vl * slip).sum()])


@ti.func
def beside(values):
    """Sum of each beam's value and those of its ``_BESIDE`` neighbours on either side, among sixteen."""
    out = f16x(0.0)
    for i in ti.static(range(LANES)):
        for j in ti.static(range(max(i - _BESIDE, 0), min(i + _BESIDE + 1, LANES))):
            out[i] += values[j]
    return out


@ti.func
def read_beams(env, packet, io: Bundle[LocalizationIO]):
    """Sixteen beams; ranges without the mean of their one-sided error. What a mechanical beam heard before
    was used then: it counts as no return."""
    ahead, left, _ahead, _left = beam_lanes(0.0, packet * LANES, io.sensors_cfg.sonar)
    range_m, hit = f16x(0.0), f16x(0.0)
    for i in ti.static(range(LANES)):
        range_m[i] = io.scan.range_m[env, packet * LANES + i] - io.sensors_cfg.sonar.range_jitter_m
        hit[i] = ti.cast(io.scan.hit[env, packet * LANES + i], ti.f32)
        if ti.static(io.sensors_cfg.sonar.mechanical):
            if not is_new(env, packet * LANES + i, io.scan, io.sensors_cfg.sonar):
                hit[i] = 0.0
    return Beams(ahead=ahead, left=left, range_m=range_m, hit=hit)


@ti.func
def expected_wall(x, y, ux, uy, io: Bundle[LocalizationIO]):
    """(range, inward normal x, y) of the side wall that level beams (ux, uy) from (x, y) meet; lanes."""
    r, nx, ny = f16x(0.0), f16x(0.0), f16x(0.0)
    if ti.static(io.tank_cfg.shape == "circle"):
        radius = ti.static(io.tank_cfg.radius_m)
        dx = x - ti.static(0.5 * (io.tank_cfg.x_m[0] + io.tank_cfg.x_m[1]))
        dy = y - ti.static(0.5 * (io.tank_cfg.y_m[0] + io.tank_cfg.y_m[1]))
        along, across = dx * ux + dy * uy, dx * uy - dy * ux
        r = ti.sqrt(ti.max(radius * radius - across * across, 0.0)) - along
        nx, ny = -(dx + r * ux) / radius, -(dy + r * uy) / radius
    else:
        safe_x = ti.select(ti.abs(ux) < 1.0e-6, 1.0e-6, ux)
        safe_y = ti.select(ti.abs(uy) < 1.0e-6, 1.0e-6, uy)
        to_x = ti.select(safe_x > 0.0, io.tank_cfg.x_m[1] - x, io.tank_cfg.x_m[0] - x) / safe_x
        to_y = ti.select(safe_y > 0.0, io.tank_cfg.y_m[1] - y, io.tank_cfg.y_m[0] - y) / safe_y
        r = ti.min(to_x, to_y)
        nx = ti.select(to_x < to_y, ti.select(safe_x > 0.0, -1.0, 1.0), 0.0)
        ny = ti.select(to_x < to_y, 0.0, ti.select(safe_y > 0.0, -1.0, 1.0))
    return r, nx, ny


@ti.func
def range_variance(range_m, io: Bundle[LocalizationIO]):
    """Variance [m^2] of one beam's range."""
    sigma = io.sensors_cfg.sonar.range_sigma_m + io.sensors_cfg.sonar.range_sigma_slope * range_m
    return sigma * sigma + ti.static(
        io.sensors_cfg.sonar.range_jitter_m**2 + io.sensors_cfg.sonar.range_quantum_m**2 / 12.0
    )


def middle_sigma(sensors_cfg):
    """[m] standard deviation of a range half as long as the sonar's reach; plain Python."""
    sonar = sensors_cfg.sonar
    normal = sonar.range_sigma_m + sonar.range_sigma_slope * 0.5 * sonar.max_range_m
    return math.sqrt(normal**2 + sonar.range_jitter_m**2 + sonar.range_quantum_m**2 / 12.0)


def wrong_ranges(sensors_cfg, localization_cfg):
    """Share of the beams that pass the gate and do not come from the wall: clutter and ghosts are anywhere in
    reach; plain Python."""
    sonar = sensors_cfg.sonar
    width = 2.0 * localization_cfg.gate_sigmas * middle_sigma(sensors_cfg)
    return min((sonar.false_return + sonar.ghost) * width / sonar.max_range_m, _MOST_WRONG)


def wrong_dopplers(sensors_cfg, localization_cfg):
    """The same of their Doppler; plain Python."""
    sonar = sensors_cfg.sonar
    if sonar.doppler_outlier_m_s == 0.0:
        return 0.0
    width = localization_cfg.gate_sigmas * math.sqrt(doppler_variance(sensors_cfg))
    return min(sonar.doppler_outlier * min(width / sonar.doppler_outlier_m_s, 1.0), _MOST_WRONG)


def gated(wrong, localization_cfg):
    """How many times larger the variance of a gated measurement is, of which a share ``wrong`` is anywhere in
    the gate: that of an M-estimator that leaves out what lies beyond the gate (P. Huber, Robust Statistics,
    1981, section 3.2), for as many as pass; plain Python."""
    g = localization_cfg.gate_sigmas
    inside = math.erf(g / math.sqrt(2.0))
    slope = (1.0 - wrong) * (inside - 2.0 * g * math.exp(-0.5 * g * g) / math.sqrt(2.0 * math.pi))
    square = slope + wrong * g * g / 3.0
    return ((1.0 - wrong) * inside + wrong) * square / slope**2


def unseen_returns(sensors_cfg, localization_cfg):
    """Returns that err together, times the share of the water before a wall in which an obstacle passes for
    the wall, half the sonar's reach away. The deeper that water, the longer an obstacle stays in it; plain
    Python."""
    deep = localization_cfg.gate_sigmas * middle_sigma(sensors_cfg) / math.sqrt(2 * _BESIDE + 1)
    return localization_cfg.obstacle_returns_per_m * deep * deep / (0.5 * sensors_cfg.sonar.max_range_m)


def aim_variance(sensors_cfg, localization_cfg):
    """[rad^2] of a beam's direction, which a wide beam has anywhere in its width; plain Python."""
    width = sensors_cfg.sonar.half_width_rad
    return localization_cfg.bearing_sigma_rad**2 + sensors_cfg.imu.attitude_sigma_rad**2 + width**2


def doppler_variance(sensors_cfg):
    """[m^2/s^2] of one beam; plain Python."""
    return max(sensors_cfg.sonar.doppler_sigma_m_s, 0.01) ** 2


@ti.func
def form3(cov, a, b, c):
    """h'P h of h = (a, b, c) in lanes, P by its upper triangle."""
    across = 2.0 * (cov[1] * a * b + cov[2] * a * c + cov[4] * b * c)
    return cov[0] * a * a + cov[3] * b * b + cov[5] * c * c + across


# ------------------------------------------------------------------------------------------------------------


_N = 9  # Numbers of the horizontal filter,
_D = 4  # and of the depth's.

_START_SPEED_M_S = 0.1
"""Standard deviation of the velocity before the first reading: vehicles start at rest, or nearly (EC)."""

_LEAST_SPEED_SIGMA_M_S = 0.002
_LEAST_DEPTH_SIGMA_M = 0.001
"""What a reading's error is taken for where the sensor has none: float32 and the midpoint rule leave that."""


@quick_launch
@ti.kernel
def reset_pose(io: Bundle[LocalizationIO]):
    """At the place that is told, ``ego.pos_w``, with the heading that the IMU says. Active rows only."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
            pos = io.ego.pos_w[env]
            io.localization.mean[env] = ti.Vector([pos[0], pos[1], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
            io.localization.depth[env] = ti.Vector([pos[2], 0.0, 0.0, 0.0])
            io.localization.cov[env] = 0.0
            io.localization.depth_cov[env] = 0.0
            io.localization.motion[env] = 0.0
            drift, scale = io.sensors_cfg.imu.heading_drift_rad_s, io.sensors_cfg.dvl.scale_error
            bias = io.sensors_cfg.imu.accel_bias_m_s2
            told, heading = io.sensors_cfg.start_sigma_m, io.sensors_cfg.imu.heading_sigma_rad
            io.localization.cov[env][ti.static(place(2, 2, _N))] = heading * heading
            for axis in ti.static((0, 1)):
                io.localization.cov[env][ti.static(place(axis, axis, _N))] = told * told
            for axis in ti.static((3, 4)):
                io.localization.cov[env][ti.static(place(axis, axis, _N))] = (
                    _START_SPEED_M_S * _START_SPEED_M_S
                )
                io.localization.cov[env][ti.static(place(axis + 4, axis + 4, _N))] = bias * bias
            io.localization.cov[env][ti.static(place(5, 5, _N))] = drift * drift
            io.localization.cov[env][ti.static(place(6, 6, _N))] = scale * scale
            zeroed = io.sensors_cfg.pressure.sigma_m * io.sensors_cfg.pressure.sigma_m
            io.localization.depth_cov[env][ti.static(place(1, 1, _D))] = _START_SPEED_M_S * _START_SPEED_M_S
            io.localization.depth_cov[env][ti.static(place(2, 2, _D))] = zeroed
            io.localization.depth_cov[env][ti.static(place(3, 3, _D))] = bias * bias


@quick_launch
@ti.kernel
def predict_pose(io: Bundle[LocalizationIO]):
    """Move both filters to this step, take in DVL and pressure, and say where the vehicle is: the sonar's
    ping is noted there. Active rows only."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
            step = io.clock.step[env]
            motion = level_motion(env, io)
            if step > 0:
                jump = motion - io.localization.motion[env]
                between = motion - ti.static(1.0 - NEWEST_SHARE) * jump
                between[3] = motion[3] - 0.5 * jump[3]
                between -= leaning(env, io)
                move_on(env, between, jump, io)
                sink_on(env, between[2], jump[2], io)
            io.localization.motion[env] = motion
            if step % io.sensors_cfg.dvl.period_steps == 0 and io.ego.vel_valid[env] == 1:
                take_dvl(env, io)
            if step > 0:
                take_pressure(env, io)
            tell_pose(env, 0.0, io)


@quick_launch
@ti.kernel
def correct_pose(io: Bundle[LocalizationIO]):
    """Take in the walls of a scan that has just come. Active rows only."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1 and io.scan.fresh[env] == 1:
            before = io.localization.mean[env][2]
            take_walls(env, io)
            tell_pose(env, before, io)


# --------------------------------------------------------------------------------------------------- predict


@ti.func
def level_rotation(env, io: Bundle[LocalizationIO]):
    """Matrix from the body's axes to the level frame of the same yaw."""
    rpy = io.ego.rpy[env]
    return rotation_wb(quaternion_wb(rpy[0], rpy[1], 0.0))


@ti.func
def level_motion(env, io: Bundle[LocalizationIO]):
    """What the IMU says of the level body frame: acceleration ahead, to the left and upwards [m/s^2], without
    gravity, and rate of the yaw [rad/s]."""
    rpy, rate = io.ego.rpy[env], io.ego.rate_b[env]
    force = level_rotation(env, io) @ io.ego.specific_force_b[env]
    turning = (rate[1] * ti.sin(rpy[0]) + rate[2] * ti.cos(rpy[0])) / ti.cos(rpy[1])
    return ti.Vector([force[0], force[1], force[2] - io.vehicle_cfg.gravity_m_s2, turning])


@ti.func
def leaning(env, io: Bundle[LocalizationIO]):
    """Error of ``level_motion`` beyond the accelerometer's as the filters have it: along the axes of the
    body, which leans, less along those of the level frame."""
    bias = ti.Vector(
        [io.localization.mean[env][7], io.localization.mean[env][8], io.localization.depth[env][3]]
    )
    level = level_rotation(env, io) @ bias
    return ti.Vector([level[0] - bias[0], level[1] - bias[1], level[2] - bias[2], 0.0])


@ti.func
def move_on(env, motion, jump, io: Bundle[LocalizationIO]):
    """Predict the horizontal filter by one control step of the mean ``motion`` (of ``level_motion``), which
    changed by ``jump`` in it."""
    dt = ti.static(io.episode_cfg.control_dt_s)
    mean, cov, turn = io.localization.mean[env], io.localization.cov[env], dt * motion[3]
    yaw = io.ego.rpy[env][2] + mean[2] - 0.5 * turn  # half-way through the step
    spin, ahead = ti.Vector([ti.cos(turn), ti.sin(turn)]), ti.Vector([dt * ti.cos(yaw), dt * ti.sin(yaw)])
    way = ti.Vector([0.0, 0.0])
    moved = carried(mean, way, ahead, spin, dt)
    moved[3] += dt * (motion[0] + 0.5 * turn * motion[1])  # the frame turns under the acceleration too
    moved[4] += dt * (motion[1] - 0.5 * turn * motion[0])
    u, v = 0.5 * (mean[3] + moved[3]), 0.5 * (mean[4] + moved[4])
    way = ti.Vector([ahead[0] * u - ahead[1] * v, ahead[1] * u + ahead[0] * v])
    moved[0], moved[1] = mean[0] + way[0], mean[1] + way[1]
    half = ti.Matrix.zero(ti.f32, _N, _N)
    for j in ti.static(range(_N)):
        column = carried(
            ti.Vector([cov[ti.static(place(i, j, _N))] for i in range(_N)]), way, ahead, spin, dt
        )
        for i in ti.static(range(_N)):
            half[i, j] = column[i]
    for i in ti.static(range(_N)):
        row = carried(ti.Vector([half[i, j] for j in range(_N)]), way, ahead, spin, dt)
        for j in ti.static(range(i, _N)):
            cov[ti.static(place(i, j, _N))] = row[j]
    cov[ti.static(place(2, 2, _N))] += ti.static(io.sensors_cfg.imu.gyro_noise_rad_s_rthz**2) * dt
    for axis in ti.static((3, 4)):
        cov[ti.static(place(axis, axis, _N))] += won_variance(jump[axis - 3], io)
    io.localization.mean[env] = moved
    io.localization.cov[env] = cov


@ti.func
def carried(u, way, ahead, spin, dt):
    """A small change of the horizontal filter's numbers one step of dt later: ``way`` the step's displacement
    (2), ``ahead`` its direction ahead times dt, ``spin`` cosine and sine of the turn."""
    fore = spin[0] * u[3] + spin[1] * u[4] - dt * u[7]
    side = spin[0] * u[4] - spin[1] * u[3] - dt * u[8]
    mid_fore, mid_side = 0.5 * (u[3] + fore), 0.5 * (u[4] + side)
    return ti.Vector(
        [
            u[0] - way[1] * u[2] + ahead[0] * mid_fore - ahead[1] * mid_side,
            u[1] + way[0] * u[2] + ahead[1] * mid_fore + ahead[0] * mid_side,
            u[2] + dt * u[5],
            fore,
            side,
            u[5],
            u[6],
            u[7],
            u[8],
        ]
    )


@ti.func
def won_variance(jump, io: Bundle[LocalizationIO]):
    """[m^2/s^2] by which a velocity becomes less sure in one step in which its acceleration changed by
    ``jump`` [m/s^2]."""
    missed = jump * ti.static(JUMP_SHARE * io.episode_cfg.control_dt_s)
    return missed * missed + ti.static(
        accel_variance(io.episode_cfg.control_dt_s, io.sensors_cfg, io.vehicle_cfg)
    )


def accel_variance(dt, sensors_cfg, vehicle_cfg):
    """[m^2/s^2] The same of a steady acceleration: noise of the accelerometer and of the attitude, by which
    gravity leaks into the level axes; plain Python."""
    leak = vehicle_cfg.gravity_m_s2 * sensors_cfg.imu.attitude_sigma_rad
    return (sensors_cfg.imu.accel_sigma_m_s2**2 + leak**2) * dt**2 + ACCEL_DENSITY * dt


@ti.func
def sink_on(env, accel, jump, io: Bundle[LocalizationIO]):
    """Predict the depth's filter by one control step of mean vertical acceleration ``accel`` [m/s^2], which
    changed by ``jump`` in it."""
    dt = ti.static(io.episode_cfg.control_dt_s)
    mean, cov = sunk(io.localization.depth[env], dt), io.localization.depth_cov[env]
    mean[0] += 0.5 * dt * dt * accel
    mean[1] += dt * accel
    half = ti.Matrix.zero(ti.f32, _D, _D)
    for j in ti.static(range(_D)):
        column = sunk(ti.Vector([cov[ti.static(place(i, j, _D))] for i in range(_D)]), dt)
        for i in ti.static(range(_D)):
            half[i, j] = column[i]
    for i in ti.static(range(_D)):
        row = sunk(ti.Vector([half[i, j] for j in range(_D)]), dt)
        for j in ti.static(range(i, _D)):
            cov[ti.static(place(i, j, _D))] = row[j]
    cov[ti.static(place(1, 1, _D))] += won_variance(jump, io)
    io.localization.depth[env], io.localization.depth_cov[env] = mean, cov


@ti.func
def sunk(u, dt):
    """The depth's numbers one step of dt later, without acceleration."""
    return ti.Vector([u[0] + dt * u[1] - 0.5 * dt * dt * u[3], u[1] - dt * u[3], u[2], u[3]])


# --------------------------------------------------------------------------------------------------- correct


@ti.func
def take_dvl(env, io: Bundle[LocalizationIO]):
    """A fresh reading of the DVL: (1 + scale error) x velocity, turned level."""
    variance = ti.static(max(io.sensors_cfg.dvl.sigma_m_s, _LEAST_SPEED_SIGMA_M_S) ** 2)
    reading = level_rotation(env, io) @ io.ego.vel_b[env]
    mean, cov = io.localization.mean[env], io.localization.cov[env]
    for axis in range(2):
        h = ti.Vector([0.0] * _N)
        h[3 + axis], h[6] = 1.0 + mean[6], mean[3 + axis]
        residual = reading[axis] - (1.0 + mean[6]) * mean[3 + axis]
        moved, shrunk = measured(mean, cov, h, residual, variance)
        mean, cov = moved, shrunk
    io.localization.mean[env], io.localization.cov[env] = mean, cov
    depth, depth_cov = measured(
        io.localization.depth[env],
        io.localization.depth_cov[env],
        ti.Vector([0.0, 1.0, 0.0, 0.0]),
        reading[2] - io.localization.depth[env][1],
        variance,
    )
    io.localization.depth[env], io.localization.depth_cov[env] = depth, depth_cov


@ti.func
def take_pressure(env, io: Bundle[LocalizationIO]):
    """A reading of the pressure sensor: -z + what the first reading was off."""
    depth, depth_cov = measured(
        io.localization.depth[env],
        io.localization.depth_cov[env],
        ti.Vector([-1.0, 0.0, 1.0, 0.0]),
        io.ego.depth_m[env] + io.localization.depth[env][0] - io.localization.depth[env][2],
        ti.static(max(io.sensors_cfg.pressure.sigma_m, _LEAST_DEPTH_SIGMA_M) ** 2),
    )
    io.localization.depth[env], io.localization.depth_cov[env] = depth, depth_cov


@ti.func
def take_walls(env, io: Bundle[LocalizationIO]):
    """The newest scan: pose at the ping by its ranges, velocity by their Doppler."""
    mean, cov = io.localization.mean[env], io.localization.cov[env]
    late = (io.clock.step[env] - io.scan.ping_step[env]) * ti.static(io.episode_cfg.control_dt_s)
    overdue = io.clock.step[env] - io.scan.ping_step[env] - ti.static(io.sensors_cfg.sonar.latency_steps)
    drifted = ti.max(overdue, 0) * ti.static(io.episode_cfg.control_dt_s)  # 0 in a simulator's own loop
    back_x = late * ti.cos(io.scan.ping_yaw[env])
    back_y = late * ti.sin(io.scan.ping_yaw[env])
    speed_cov = ti.Vector([cov[ti.static(place(i, j, _N))] for i, j in ti.static(((3, 3), (3, 4), (4, 4)))])
    speed = level_rotation(env, io) @ io.scan.ping_vel_b[env]  # roll and pitch hardly change meanwhile
    fix = seen_walls(env, place_cov(cov, back_x, back_y), speed, speed_cov, io)
    rows, found = ti.Matrix.zero(ti.f32, 5, _N), ti.Vector([0.0] * 5)
    root, seen = halved(fix.pose, fix.pose_part)
    for k in ti.static(range(3)):
        a, b = root[0, k], root[1, k]
        rows[k, 0], rows[k, 1], rows[k, 2], found[k] = a, b, root[2, k], seen[k]
        rows[k, 3], rows[k, 4] = -a * back_x - b * back_y, a * back_y - b * back_x
        rows[k, 7], rows[k, 8] = 0.5 * drifted * rows[k, 3], 0.5 * drifted * rows[k, 4]
    won = ti.static(accel_variance(io.episode_cfg.control_dt_s, io.sensors_cfg, io.vehicle_cfg))
    info, part = blurred(fix.velocity, fix.velocity_part, won * (io.clock.step[env] - io.scan.ping_step[env]))
    half, slip = halved(info, part)
    for k in ti.static(range(2)):
        rows[3 + k, 3], rows[3 + k, 4], found[3 + k] = half[0, k], half[1, k], slip[k]
        rows[3 + k, 7], rows[3 + k, 8] = drifted * half[0, k], drifted * half[1, k]
    now = mean + 0.0
    for k in range(5):  # not unrolled, so that it is compiled once
        h = ti.Vector([rows[k, j] for j in range(_N)])
        moved, shrunk = measured(now, cov, h, found[k] - h.dot(now - mean), 1.0)
        now, cov = moved, shrunk
    io.localization.mean[env], io.localization.cov[env] = now, cov


@ti.func
def blurred(info, part, variance):
    """Information (upper triangle, vector) on two numbers that have wandered by ``variance`` each since they
    were measured."""
    # (J^-1 + w I)^-1 = (I + w J)^-1 J, and the same factor for the vector; for w > 0 and J >= 0 there is no
    # division by zero
    xx, xy, yy = 1.0 + variance * info[0], variance * info[1], 1.0 + variance * info[2]
    det = xx * yy - xy * xy
    spread_out = ti.Vector(
        [
            (yy * info[0] - xy * info[1]) / det,
            (yy * info[1] - xy * info[2]) / det,
            (xx * info[2] - xy * info[1]) / det,
        ]
    )
    return spread_out, ti.Vector([yy * part[0] - xy * part[1], xx * part[1] - xy * part[0]]) / det


@ti.func
def place_cov(cov, back_x, back_y):
    """Covariance (upper triangle) of x, y and heading at the ping, where the pose is off by that of now less
    the latency times the velocity's error."""
    # the products H P, then H P H' of them
    reach = ti.Matrix.zero(ti.f32, 3, _N)
    for j in ti.static(range(_N)):
        u, v = cov[ti.static(place(3, j, _N))], cov[ti.static(place(4, j, _N))]
        reach[0, j] = cov[ti.static(place(0, j, _N))] - back_x * u + back_y * v
        reach[1, j] = cov[ti.static(place(1, j, _N))] - back_y * u - back_x * v
        reach[2, j] = cov[ti.static(place(2, j, _N))]
    out = ti.Vector([0.0] * 6)
    for i in ti.static(range(3)):
        along = ti.Vector(
            [
                reach[i, 0] - back_x * reach[i, 3] + back_y * reach[i, 4],
                reach[i, 1] - back_y * reach[i, 3] - back_x * reach[i, 4],
                reach[i, 2],
            ]
        )
        for j in ti.static(range(i, 3)):
            out[ti.static(place(i, j, 3))] = along[j]
    return out


# ------------------------------------------------------------------------------------------------------ tell


@ti.func
def tell_pose(env, before, io: Bundle[LocalizationIO]):
    """Write what the stack takes for the own pose, its covariance, and the velocity, which is valid where it
    is sure enough, whether the DVL has a reading or not.

    ``before``: the heading's correction that ``ego.rpy`` already has in it.
    """
    mean, cov, rpy = io.localization.mean[env], io.localization.cov[env], io.ego.rpy[env]
    io.ego.pos_w[env] = ti.Vector([mean[0], mean[1], io.localization.depth[env][0]])
    io.ego.rpy[env] = ti.Vector([rpy[0], rpy[1], wrapped_angle(rpy[2] + mean[2] - before)])
    for i in ti.static(range(3)):
        for j in ti.static(range(i, 3)):
            io.ego.pose_cov[env][ti.static(place(i, j, 3))] = cov[ti.static(place(i, j, _N))]
    io.ego.pose_cov[env][5] += ti.static(io.sensors_cfg.imu.attitude_sigma_rad**2)
    io.ego.z_var[env] = io.localization.depth_cov[env][0]
    level = ti.Vector([mean[3], mean[4], io.localization.depth[env][1]])
    io.ego.vel_b[env] = level_rotation(env, io).transpose() @ level
    unsure = ti.max(cov[ti.static(place(3, 3, _N))], cov[ti.static(place(4, 4, _N))])
    unsure = ti.max(unsure, io.localization.depth_cov[env][ti.static(place(1, 1, _D))])
    io.ego.vel_valid[env] = ti.cast(unsure < ti.static(io.localization_cfg.sure_speed_m_s**2), ti.i32)
