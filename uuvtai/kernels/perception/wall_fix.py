"""What the beams that end on a known wall say of the own pose and velocity (part of the pose stage).

A beam along the unit vector u meets a wall of inward normal n at the range r: the point where it ends lies
e = c (range - r), c = -u'n, off the wall, and that is n'(error of the position) + r n'v (error of the
heading), v = u turned to the left by a right angle. The wall does not move, so its Doppler is -u'(own
velocity). Each beam adds its part to an information matrix and vector; bodies before a wall, ghosts and
clutter lie outside the gate.
"""

import math

import taichi as ti

from uuvtai.kernels.core.geometry import TWO_PI
from uuvtai.kernels.core.lanes import LANES, f16x
from uuvtai.kernels.core.signature import Bundle
from uuvtai.kernels.perception.bundles import PoseIO

Beams = ti.types.struct(ahead=f16x, left=f16x, range_m=f16x, doppler_m_s=f16x, hit=f16x)
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
def seen_walls(env, place_cov, speed, speed_cov, io: Bundle[PoseIO]):
    """Fix from the newest scan. ``place_cov`` (6) and ``speed_cov`` (3): covariance of the pose at the ping
    and of the velocity, their upper triangles, for the gates; ``speed`` (2) the velocity."""
    pos, yaw = io.scan.ping_pos_w[env], io.scan.ping_yaw[env]
    c, s = ti.cos(yaw), ti.sin(yaw)
    fix = Fix(pose=0.0, pose_part=0.0, velocity=0.0, velocity_part=0.0)
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
            + lever * lever * ti.static(aim_variance(io.sensors_cfg, io.pose_cfg))
            + ti.static(io.pose_cfg.wall_sigma_m**2)
        )
        gate = var + form3(place_cov, nx, ny, lever)
        near = r + io.pose_cfg.gate_sigmas * ti.sqrt(along) < ti.static(surest_range(io.sensors_cfg))
        fits = e * e < ti.static(io.pose_cfg.gate_sigmas**2) * gate
        good = beams.hit * ti.select(near & fits, 1.0, 0.0)
        weight = good / (var * io.pose_cfg.inflation)
        wx, wy, wt = weight * nx, weight * ny, weight * lever
        fix.pose += ti.Vector(
            [
                (wx * nx).sum(), (wx * ny).sum(), (wx * lever).sum(),
                (wy * ny).sum(), (wy * lever).sum(), (wt * lever).sum(),
            ]
        )  # fmt: skip
        fix.pose_part += ti.Vector([(wx * e).sum(), (wy * e).sum(), (wt * e).sum()])
        slip = beams.doppler_m_s + speed[0] * beams.ahead + speed[1] * beams.left
        swing = ti.static(doppler_variance(io.sensors_cfg)) + form2(speed_cov, beams.ahead, beams.left)
        still = good * ti.select(slip * slip < ti.static(io.pose_cfg.gate_sigmas**2) * swing, 1.0, 0.0)
        trust = still * ti.static(1.0 / (io.pose_cfg.inflation * doppler_variance(io.sensors_cfg)))
        va, vl = trust * beams.ahead, trust * beams.left
        fix.velocity += ti.Vector(
            [(va * beams.ahead).sum(), (va * beams.left).sum(), (vl * beams.left).sum()]
        )
        fix.velocity_part -= ti.Vector([(va * slip).sum(), (vl * slip).sum()])
    return fix


@ti.func
def read_beams(env, packet, io: Bundle[PoseIO]):
    """Sixteen beams; ranges without the mean of their one-sided error."""
    turn = packet * ti.static(LANES * TWO_PI / io.sensors_cfg.sonar.n_ray)
    c, s = ti.cos(turn), ti.sin(turn)
    ahead, left = f16x(0.0), f16x(0.0)
    range_m, doppler, hit = f16x(0.0), f16x(0.0), f16x(0.0)
    for i in ti.static(range(LANES)):
        ci = ti.cast(ti.static(math.cos(i * TWO_PI / io.sensors_cfg.sonar.n_ray)), ti.f32)
        si = ti.cast(ti.static(math.sin(i * TWO_PI / io.sensors_cfg.sonar.n_ray)), ti.f32)
        ahead[i] = c * ci - s * si
        left[i] = s * ci + c * si
        range_m[i] = io.scan.range_m[env, packet * LANES + i] - io.sensors_cfg.sonar.range_jitter_m
        doppler[i] = io.scan.doppler_m_s[env, packet * LANES + i]
        hit[i] = ti.cast(io.scan.hit[env, packet * LANES + i], ti.f32)
    return Beams(ahead=ahead, left=left, range_m=range_m, doppler_m_s=doppler, hit=hit)


@ti.func
def expected_wall(x, y, ux, uy, io: Bundle[PoseIO]):
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
def range_variance(range_m, io: Bundle[PoseIO]):
    """Variance [m^2] of one beam's range."""
    sigma = io.sensors_cfg.sonar.range_sigma_m + io.sensors_cfg.sonar.range_sigma_slope * range_m
    return sigma * sigma + ti.static(
        io.sensors_cfg.sonar.range_jitter_m**2 + io.sensors_cfg.sonar.range_quantum_m**2 / 12.0
    )


def surest_range(sensors_cfg):
    """[m] beyond which errors push returns out of the sonar's reach: of such walls only the returns that came
    out too short are seen. Plain Python."""
    return sensors_cfg.sonar.max_range_m - sensors_cfg.sonar.range_jitter_m


def aim_variance(sensors_cfg, pose_cfg):
    """[rad^2] of a beam's direction; plain Python."""
    return pose_cfg.bearing_sigma_rad**2 + sensors_cfg.imu.attitude_sigma_rad**2


def doppler_variance(sensors_cfg):
    """[m^2/s^2] of one beam; plain Python."""
    return max(sensors_cfg.sonar.doppler_sigma_m_s, 0.01) ** 2


@ti.func
def form3(cov, a, b, c):
    """h'P h of h = (a, b, c) in lanes, P by its upper triangle."""
    across = 2.0 * (cov[1] * a * b + cov[2] * a * c + cov[4] * b * c)
    return cov[0] * a * a + cov[3] * b * b + cov[5] * c * c + across


@ti.func
def form2(cov, a, b):
    """h'P h of h = (a, b) in lanes, P by its upper triangle."""
    return cov[0] * a * a + 2.0 * cov[1] * a * b + cov[2] * b * b
