"""What the beams that end on a known wall say of the own pose and velocity (part of the pose stage).

A beam along the unit vector u meets a wall of inward normal n at the range r: the point where it ends lies
e = c (range - r), c = -u'n, off the wall, and that is n'(error of the position) + r n'v (error of the
heading), v = u turned to the left by a right angle. The wall does not move, so its Doppler is -u'(own
velocity). Each beam adds its part to an information matrix and vector; bodies before a wall, ghosts and
clutter lie outside the gate, or outside that of a few neighbouring beams together. What passes all the same
makes every beam count less, as much as the sonar's rates of wrong returns and the returns before the walls
say. A sonar without Doppler says nothing of the velocity.
"""

import math
from typing import Any

import taichi as ti

from uuvtai.kernels.core.beams import beam_lanes
from uuvtai.kernels.core.lanes import LANES, f16x, lane_bits
from uuvtai.kernels.core.signature import Bundle, Out
from uuvtai.kernels.perception.bundles import PoseIO
from uuvtai.kernels.perception.echoes import is_new

_BESIDE = 2
"""Beams on either side that are looked at together with one: most bodies are wider."""

_MOST_WRONG = 0.5
"""No sonar is taken to be worse."""

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
def seen_walls(env, place_cov, speed, speed_cov, io: Bundle[PoseIO]):
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
            + lever * lever * ti.static(aim_variance(io.sensors_cfg, io.pose_cfg))
            + ti.static(io.pose_cfg.wall_sigma_m**2)
        )
        doubt = form3(place_cov, nx, ny, lever)
        near = r + io.pose_cfg.gate_sigmas * ti.sqrt(along) < ti.static(surest_range(io.sensors_cfg))
        fits = e * e < ti.static(io.pose_cfg.gate_sigmas**2) * (var + doubt)
        good = beams.hit * ti.select(near & fits, 1.0, 0.0)
        n = ti.max(beside(good), 1.0)
        mean = beside(good * e) / n
        together = mean * mean < ti.static(io.pose_cfg.gate_sigmas**2) * (var / n + doubt)
        good *= ti.select(together, 1.0, 0.0)
        seen += good.sum()
        short += (beams.hit * ti.select(near & (e < 0.0) & ~fits, 1.0, 0.0)).sum()
        weight = good / (var * ti.static(gated(wrong_ranges(io.sensors_cfg, io.pose_cfg), io.pose_cfg)))
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
    together = 1.0 / (1.0 + share * ti.static(unseen_returns(io.sensors_cfg, io.pose_cfg)))
    fix.pose *= together
    fix.pose_part *= together
    if ti.static(io.sensors_cfg.sonar.doppler):
        add_dopplers(env, fix, kept, speed, speed_cov, io)
    return fix


@ti.func
def add_dopplers(env, fix: Out[Any], kept, speed, speed_cov, io: Bundle[PoseIO]):
    """What the Doppler of the beams that end on a wall says of the velocity; ``kept``: a bit for each of
    them, by packet. A loop of its own: both together need more registers than a GPU's thread has."""
    for packet in range(ti.static(io.sensors_cfg.sonar.n_ray // LANES)):
        ahead, left = beam_lanes(0.0, packet * LANES, io.sensors_cfg.sonar)
        good, doppler = f16x(0.0), f16x(0.0)
        for i in ti.static(range(LANES)):
            good[i] = ti.cast((kept[packet] >> i) & 1, ti.f32)
            doppler[i] = io.scan.doppler_m_s[env, packet * LANES + i]
        slip = doppler + speed[0] * ahead + speed[1] * left
        swing = ti.static(doppler_variance(io.sensors_cfg)) + form2(speed_cov, ahead, left)
        still = good * ti.select(slip * slip < ti.static(io.pose_cfg.gate_sigmas**2) * swing, 1.0, 0.0)
        trust = still * ti.static(
            1.0
            / gated(wrong_dopplers(io.sensors_cfg, io.pose_cfg), io.pose_cfg)
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
def read_beams(env, packet, io: Bundle[PoseIO]):
    """Sixteen beams; ranges without the mean of their one-sided error. What a mechanical beam heard before
    was used then: it counts as no return."""
    ahead, left = beam_lanes(0.0, packet * LANES, io.sensors_cfg.sonar)
    range_m, hit = f16x(0.0), f16x(0.0)
    for i in ti.static(range(LANES)):
        range_m[i] = io.scan.range_m[env, packet * LANES + i] - io.sensors_cfg.sonar.range_jitter_m
        hit[i] = ti.cast(io.scan.hit[env, packet * LANES + i], ti.f32)
        if ti.static(io.sensors_cfg.sonar.mechanical):
            if not is_new(env, packet * LANES + i, io.scan, io.sensors_cfg.sonar):
                hit[i] = 0.0
    return Beams(ahead=ahead, left=left, range_m=range_m, hit=hit)


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


def middle_sigma(sensors_cfg):
    """[m] standard deviation of a range half as long as the sonar's reach; plain Python."""
    sonar = sensors_cfg.sonar
    normal = sonar.range_sigma_m + sonar.range_sigma_slope * 0.5 * sonar.max_range_m
    return math.sqrt(normal**2 + sonar.range_jitter_m**2 + sonar.range_quantum_m**2 / 12.0)


def wrong_ranges(sensors_cfg, pose_cfg):
    """Share of the beams that pass the gate and do not come from the wall: clutter and ghosts are anywhere in
    reach; plain Python."""
    sonar = sensors_cfg.sonar
    width = 2.0 * pose_cfg.gate_sigmas * middle_sigma(sensors_cfg)
    return min((sonar.false_return + sonar.ghost) * width / sonar.max_range_m, _MOST_WRONG)


def wrong_dopplers(sensors_cfg, pose_cfg):
    """The same of their Doppler; plain Python."""
    sonar = sensors_cfg.sonar
    if sonar.doppler_outlier_m_s == 0.0:
        return 0.0
    width = pose_cfg.gate_sigmas * math.sqrt(doppler_variance(sensors_cfg))
    return min(sonar.doppler_outlier * min(width / sonar.doppler_outlier_m_s, 1.0), _MOST_WRONG)


def gated(wrong, pose_cfg):
    """How many times larger the variance of a gated measurement is, of which a share ``wrong`` is anywhere in
    the gate: that of an M-estimator that leaves out what lies beyond the gate (P. Huber, Robust Statistics,
    1981, section 3.2), for as many as pass; plain Python."""
    g = pose_cfg.gate_sigmas
    inside = math.erf(g / math.sqrt(2.0))
    slope = (1.0 - wrong) * (inside - 2.0 * g * math.exp(-0.5 * g * g) / math.sqrt(2.0 * math.pi))
    square = slope + wrong * g * g / 3.0
    return ((1.0 - wrong) * inside + wrong) * square / slope**2


def unseen_returns(sensors_cfg, pose_cfg):
    """Returns that err together, times the share of the water before a wall in which a body passes for the
    wall, half the sonar's reach away. The deeper that water, the longer a body stays in it; plain Python."""
    deep = pose_cfg.gate_sigmas * middle_sigma(sensors_cfg) / math.sqrt(2 * _BESIDE + 1)
    return pose_cfg.body_returns_per_m * deep * deep / (0.5 * sensors_cfg.sonar.max_range_m)


def aim_variance(sensors_cfg, pose_cfg):
    """[rad^2] of a beam's direction, which a wide beam has anywhere in its width; plain Python."""
    width = sensors_cfg.sonar.half_width_rad
    return pose_cfg.bearing_sigma_rad**2 + sensors_cfg.imu.attitude_sigma_rad**2 + width**2


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
