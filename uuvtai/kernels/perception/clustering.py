"""From one sonar scan to clusters: runs of neighbouring beams that hit the same body (part of the tracking
stage).

Returns from the known walls are left out, runs split at jumps of range or Doppler, a missed or false beam
inside an obstacle is bridged, and runs wider than an obstacle is expected to be are dropped. An obstacle's
outline is taken for a circle: its half-angle a gives the radius R = d sin a, and the mean range of the
visible arc, d - (pi / 4) R for small angles, gives the centre at the distance d.
"""

import math

import taichi as ti

from uuvtai.kernels.core.beams import beam_lanes, beam_there
from uuvtai.kernels.core.geometry import turned_z
from uuvtai.kernels.core.simd import LANES, f16x
from uuvtai.kernels.core.stage import Bundle
from uuvtai.kernels.perception.io import TrackingIO

ARC = 0.25 * math.pi
"""Mean over the beams of a far circle's visible arc of sqrt(1 - x^2): how many radii its mean range lies
before the centre."""

_CANDIDATE = 1 << 20  # Label of a beam that may belong to an obstacle and is in no cluster yet.

_BRIDGE = 3  # A run may step this many beams at once: over one beam of any kind, or over two without return.

SPLIT_M, SPLIT_SLOPE = 0.18, 0.03
"""Jump of range [m], and more per metre of it, that ends an obstacle (EC, tuned)."""

SPLIT_DOPPLER_M_S = 0.3
"""Neighbouring beams whose Doppler differs by more (plus 6 sigma) belong to different obstacles (EC)."""

_MODEL_SIGMA_M = 0.01
"""What remains of a range's error however many beams are averaged: obstacles are not circles (EC)."""

HELD_SIGMA_M_S = 1.0
"""Trust in the own velocity's last reading while the DVL has lost the bottom: it may be off by as much as the
vehicle can change (EC)."""

NO_DOPPLER_VAR = 1.0e6
"""[m^2/s^2] variance of the Doppler of a sonar that measures none: it says nothing."""

_SLIP_SIGMA_M_S = 0.01
"""What remains of a Doppler's error however many beams are averaged: the own velocity's error (EC)."""


@ti.func
def range_variance(range_m, io: Bundle[TrackingIO]):
    """Variance of one beam's range [m^2]."""
    sigma = io.sonar_cfg.range_sigma_m + io.sonar_cfg.range_sigma_slope * range_m
    return sigma * sigma + ti.static(io.sonar_cfg.range_jitter_m**2 + io.sonar_cfg.range_quantum_m**2 / 12)


@ti.func
def split_distance(range_m, io: Bundle[TrackingIO]):
    """Jump of range [m] between two beams that ends an obstacle: the design's rule, or what noise alone can
    do."""
    return ti.max(SPLIT_M + SPLIT_SLOPE * range_m, 4.0 * ti.sqrt(range_variance(range_m, io)))


@ti.func
def find_clusters(env, io: Bundle[TrackingIO]):
    """Fill ``clusters`` from the labelled beams of this env (``label_beams`` first)."""
    start = quiet_beam(env, io)
    io.clusters.count[env] = 0
    k = 0
    while k < io.sonar_cfg.n_ray:
        if io.clusters.beam_cluster[env, (start + k) % io.sonar_cfg.n_ray] == _CANDIDATE:
            last, sums = walk_run(env, start, k, io)
            store_run(env, start, k, last, sums, io)
            k = last
        k += 1


# ------------------------------------------------------------------------------------------------------ beams


@ti.func
def label_beams(env, io: Bundle[TrackingIO]):
    """Label every beam _CANDIDATE or -1, compensate its Doppler, and learn the own velocity's error from the
    walls: they do not move. Without Doppler a measured velocity is taken as it is.

    ``normal`` = (sum ux ux, sum ux uy, sum uy uy, sum ux e, sum uy e) over the walls' beams, u = beam, e =
    compensated Doppler.
    """
    pos, yaw = io.scan.ping_pos_w[env], io.scan.ping_yaw[env]
    vel = turned_z(io.scan.ping_vel_b[env], yaw)
    normal = ti.Vector([0.0, 0.0, 0.0, 0.0, 0.0])
    for packet in range(io.sonar_cfg.n_ray // LANES):
        ux, uy, _x, _y = beam_lanes(yaw, packet * LANES, io.sonar_cfg)
        range_m, hit = f16x(0.0), f16x(0.0)
        for i in ti.static(range(LANES)):
            range_m[i] = io.scan.range_m[env, packet * LANES + i]
            hit[i] = ti.cast(io.scan.hit[env, packet * LANES + i], ti.f32)
        margin = io.tracking_cfg.wall_margin_m + 2.0 * ti.sqrt(range_variance(range_m, io))
        if ti.static(io.sonar_cfg.half_width_rad > 0):
            margin += ti.static(io.sonar_cfg.half_width_rad) * range_m
        free = wall_distance(pos[0] + range_m * ux, pos[1] + range_m * uy, io) - margin
        wall = ti.select(free < 0.0, hit, f16x(0.0))
        obstacle = hit - wall
        if ti.static(io.sonar_cfg.doppler):
            still = vel[0] * ux + vel[1] * uy
            for i in ti.static(range(LANES)):
                still[i] += io.scan.doppler_m_s[env, packet * LANES + i]
                io.clusters.beam_doppler[env, packet * LANES + i] = still[i]
            error = wall * still
            wx = wall * ux
            wy = wall * uy
            normal += ti.Vector(
                [(wx * ux).sum(), (wx * uy).sum(), (wy * uy).sum(), (error * ux).sum(), (error * uy).sum()]
            )
        for i in ti.static(range(LANES)):
            io.clusters.beam_cluster[env, packet * LANES + i] = ti.select(obstacle[i] > 0.5, _CANDIDATE, -1)
    slip_w, sigma = ti.Vector([0.0, 0.0]), ti.select(io.scan.ping_vel_valid[env] == 1, 0.0, HELD_SIGMA_M_S)
    if ti.static(io.sonar_cfg.doppler):
        slip_w, sigma = velocity_slip(normal, io.scan.ping_vel_valid[env], io)
    io.clusters.slip_w[env] = slip_w
    io.clusters.own_sigma_m_s[env] = sigma
    if ti.static(io.sonar_cfg.mechanical):
        leave_told(env, io)


@ti.func
def leave_told(env, io: Bundle[TrackingIO]):
    """Of a mechanical beam's returns only those are candidates that the tracking has not had yet, and not the
    body on which the head is still."""
    n = ti.static(io.sonar_cfg.n_ray)
    for beam in range(n):
        if io.clusters.beam_cluster[env, beam] == _CANDIDATE:
            if io.echoes.told[env, io.echoes.shown[env, beam]] == 1:
                io.clusters.beam_cluster[env, beam] = -1
    newest = (io.scan.new_from[env] + io.scan.new_count[env] - 1 + n) % n
    for way in ti.static((-1, 1)):
        at = newest
        while at >= 0:
            at = next_open(env, at, way, io)
    for beam in range(n):
        if io.clusters.beam_cluster[env, beam] == _CANDIDATE:
            io.echoes.told[env, io.echoes.shown[env, beam]] = 1


@ti.func
def next_open(env, at, way, io: Bundle[TrackingIO]):
    """The next candidate, ``way`` from this beam, of the obstacle on which the head still is; it is none from
    then on. -1 = there is none."""
    found = -1
    for k in range(_BRIDGE + 1):
        beam = beam_there(at + way * k, io.sonar_cfg)
        if found < 0 and beam >= 0:
            if io.clusters.beam_cluster[env, beam] == _CANDIDATE and may_be_one(env, at, beam, io):
                io.clusters.beam_cluster[env, beam] = -1
                found = beam
    return found


@ti.func
def may_be_one(env, a, b, io: Bundle[TrackingIO]):
    """Whether the ranges of two beams allow that they lie on one obstacle; one without return allows all."""
    jump = ti.abs(io.scan.range_m[env, b] - io.scan.range_m[env, a])
    return io.scan.hit[env, a] == 0 or jump <= split_distance(io.scan.range_m[env, a], io)


@ti.func
def wall_distance(x, y, io: Bundle[TrackingIO]):
    """Distance [m] from the nearest side wall, positive inside; lanes."""
    out = ti.min(
        ti.min(x - io.tank_cfg.x_m[0], io.tank_cfg.x_m[1] - x),
        ti.min(y - io.tank_cfg.y_m[0], io.tank_cfg.y_m[1] - y),
    )
    if ti.static(io.tank_cfg.shape == "circle"):
        dx = x - ti.static(0.5 * (io.tank_cfg.x_m[0] + io.tank_cfg.x_m[1]))
        dy = y - ti.static(0.5 * (io.tank_cfg.y_m[0] + io.tank_cfg.y_m[1]))
        out = ti.static(io.tank_cfg.radius_m) - ti.sqrt(dx * dx + dy * dy)
    return out


@ti.func
def velocity_slip(normal, valid, io: Bundle[TrackingIO]):
    """Error of the own measured velocity [m/s, world] by which known walls would move: least squares with the
    own measurement as prior.

    Also the standard deviation [m/s] of what is left of it along the worst direction; 0 where the measurement
    is ``valid``. A reading that is only held is hardly trusted: the walls decide, as far as they are seen.
    """
    # Least d of sum (e - u'd)^2 / sigma^2 + |d|^2 / prior sigma^2: (sum u u' + prior I) d = sum u e, by
    # Cramer's rule. Its covariance is sigma^2 times the inverse of that matrix: worst along the smallest
    # eigenvalue.
    sigma = ti.static(max(io.sonar_cfg.doppler_sigma_m_s, 0.01))
    prior = ti.select(
        valid == 1,
        ti.static((sigma / io.tracking_cfg.own_speed_sigma_m_s) ** 2),
        ti.static((sigma / HELD_SIGMA_M_S) ** 2),
    )
    xx, xy, yy = normal[0] + prior, normal[1], normal[2] + prior
    det = xx * yy - xy * xy
    slip_w = ti.Vector([yy * normal[3] - xy * normal[4], xx * normal[4] - xy * normal[3]]) / det
    smallest_eigenvalue = 0.5 * (xx + yy) - ti.sqrt(0.25 * (xx - yy) * (xx - yy) + xy * xy)
    return slip_w, ti.select(valid == 1, 0.0, sigma / ti.sqrt(ti.max(smallest_eigenvalue, prior)))


# ------------------------------------------------------------------------------------------------------- runs


@ti.func
def joined(env, a, b, io: Bundle[TrackingIO]):
    """Whether two beams may lie on one obstacle."""
    out = False
    if (
        io.clusters.beam_cluster[env, a] == _CANDIDATE
        or io.clusters.beam_cluster[env, a] == io.clusters.count[env]
    ):
        if io.clusters.beam_cluster[env, b] == _CANDIDATE:
            jump = ti.abs(io.scan.range_m[env, b] - io.scan.range_m[env, a])
            out = jump <= split_distance(io.scan.range_m[env, a], io)
            if ti.static(io.sonar_cfg.doppler):
                swing = ti.abs(io.clusters.beam_doppler[env, b] - io.clusters.beam_doppler[env, a])
                out = out and swing <= ti.static(SPLIT_DOPPLER_M_S + 6 * io.sonar_cfg.doppler_sigma_m_s)
    return out


@ti.func
def next_beam(env, beam, io: Bundle[TrackingIO]):
    """Beams from this one to the next of the same run, 0 = the run ends here."""
    n = ti.static(io.sonar_cfg.n_ray)
    out = 0
    step = 1
    last = ti.select(io.scan.hit[env, (beam + 1) % n] + io.scan.hit[env, (beam + 2) % n] == 0, _BRIDGE, 2)
    while out == 0 and step <= last:
        if joined(env, beam, (beam + step) % n, io):
            out = step
        step += 1
    return out


@ti.func
def quiet_beam(env, io: Bundle[TrackingIO]):
    """A beam that no run crosses, so that runs through beam 0 stay whole; 0 if there is none, and of a fan,
    whose ends do not meet."""
    n = ti.static(io.sonar_cfg.n_ray)
    out = -1
    if ti.static(not io.sonar_cfg.is_ring):
        out = 0
    s = 0
    while out < 0 and s < n:
        crossed = False
        for back in range(1, _BRIDGE + 1):
            beam = (s + n - back) % n
            if io.clusters.beam_cluster[env, beam] == _CANDIDATE:
                crossed = crossed or next_beam(env, beam, io) >= back
        if not crossed:
            out = s
        s += 1
    return ti.max(out, 0)


@ti.func
def walk_run(env, start, first, io: Bundle[TrackingIO]):
    """Follow a run from offset ``first``; returns its last offset and (beams, sum of range, sum of Doppler).
    Labels its beams."""
    label = io.clusters.count[env]
    k = first
    sums = ti.Vector([0.0, 0.0, 0.0])
    going = True
    while going:
        beam = (start + k) % io.sonar_cfg.n_ray
        io.clusters.beam_cluster[env, beam] = label
        sums += ti.Vector([1.0, io.scan.range_m[env, beam], io.clusters.beam_doppler[env, beam]])
        ahead = next_beam(env, beam, io)
        going = ahead > 0 and k + ahead < io.sonar_cfg.n_ray
        if going:
            for skipped in range(1, ahead):
                io.clusters.beam_cluster[env, (beam + skipped) % io.sonar_cfg.n_ray] = -1
            k += ahead
    return k, sums


@ti.func
def store_run(env, start, first, last, sums, io: Bundle[TrackingIO]):
    """Keep a run as a cluster if it can be an obstacle; else take the label off its beams."""
    c = io.clusters.count[env]
    a, b = (start + first) % io.sonar_cfg.n_ray, (start + last) % io.sonar_cfg.n_ray
    range_m = sums[1] / sums[0] - io.sonar_cfg.range_jitter_m
    hidden = open_edges(env, a, b, io)
    expected = io.tracking_cfg.min_radius_m / (ti.max(range_m, 0.1) * ti.static(io.sonar_cfg.beam_step_rad))
    if (
        c < io.clusters.match.shape[1]
        and is_narrow(env, a, b, last - first, io)
        and (hidden > 0 or sums[0] >= expected)
    ):
        io.clusters.first_beam[env, c] = a
        io.clusters.span[env, c] = last - first + 1
        io.clusters.n_beam[env, c] = ti.cast(sums[0], ti.i32)
        io.clusters.hidden[env, c] = hidden
        io.clusters.match[env, c] = -1
        place_cluster(env, c, range_m, io)
        io.clusters.doppler_m_s[env, c], io.clusters.doppler_var[env, c] = 0.0, NO_DOPPLER_VAR
        if ti.static(io.sonar_cfg.doppler):
            weigh_doppler(env, c, sums, io)
        io.clusters.count[env] = c + 1
    else:
        for k in range(first, last + 1):
            io.clusters.beam_cluster[env, (start + k) % io.sonar_cfg.n_ray] = -1


@ti.func
def is_narrow(env, a, b, steps, io: Bundle[TrackingIO]):
    """Whether the chord between the end beams can belong to a obstacle."""
    ra, rb = io.scan.range_m[env, a], io.scan.range_m[env, b]
    half_circle = ti.static(io.sonar_cfg.circle_beams // 2)
    half = ti.sin(ti.min(steps, half_circle) * ti.static(0.5 * io.sonar_cfg.beam_step_rad))
    slack = ti.max(io.tracking_cfg.max_width_m, 4.0 * ti.sqrt(range_variance(ra, io)))
    return (
        steps < half_circle
        and 4.0 * ra * rb * half * half < io.tracking_cfg.max_width_m**2
        and ti.abs(ra - rb) < slack
    )


@ti.func
def open_edges(env, a, b, io: Bundle[TrackingIO]):
    """Bit set of the edges (1 = first, 2 = last) that border a nearer return or the end of the fan, or go on
    as something else at the same range."""
    return edge_open(env, a, -1, io) + 2 * edge_open(env, b, 1, io)


@ti.func
def edge_open(env, edge, way, io: Bundle[TrackingIO]):
    """1 where the first return beyond this edge, within two beams, is nearer or continues it, or where no
    beam looks there."""
    out = 0
    looking = True
    for step in ti.static((1, 2)):
        beam = beam_there(edge + way * step, io.sonar_cfg)
        if ti.static(not io.sonar_cfg.is_ring):
            if looking and beam < 0:
                looking = False
                out = 1
            beam = ti.max(beam, 0)
        if looking and io.scan.hit[env, beam] == 1:
            looking = False
            beyond = io.scan.range_m[env, beam] - io.scan.range_m[env, edge]
            touching = 0.1 + 3.0 * ti.sqrt(range_variance(io.scan.range_m[env, edge], io))
            out = ti.cast(beyond < touching, ti.i32)
    return out


@ti.func
def place_cluster(env, c, range_m, io: Bundle[TrackingIO]):
    """Circle through the visible arc: bearing, radius, centre, and the variance of the mean range."""
    step = ti.static(io.sonar_cfg.beam_step_rad)
    half = 0.5 * step * io.clusters.span[env, c]
    bearing = (io.scan.ping_yaw[env] + ti.static(io.sonar_cfg.first_beam_rad)) + step * (
        io.clusters.first_beam[env, c] + 0.5 * (io.clusters.span[env, c] - 1)
    )
    # The outermost beams touch the circle: sin(half) = radius / distance. The mean range lies ARC radii
    # before the centre, distance = range + ARC radius; together radius = range sin(half) / (1 - ARC
    # sin(half)).
    radius = ti.math.clamp(
        range_m * ti.sin(half) / (1.0 - ARC * ti.sin(half)),
        io.tracking_cfg.min_radius_m,
        0.5 * io.tracking_cfg.max_width_m,
    )
    distance = range_m + ARC * radius
    pos = io.scan.ping_pos_w[env]
    io.clusters.bearing_w[env, c] = bearing
    io.clusters.radius_m[env, c] = radius
    io.clusters.range_m[env, c] = range_m
    io.clusters.range_var[env, c] = range_variance(range_m, io) / io.clusters.n_beam[env, c] + ti.static(
        _MODEL_SIGMA_M**2
    )
    io.clusters.pos_w[env, c] = ti.Vector(
        [pos[0] + distance * ti.cos(bearing), pos[1] + distance * ti.sin(bearing)]
    )


@ti.func
def weigh_doppler(env, c, sums, io: Bundle[TrackingIO]):
    """Mean compensated Doppler of a cluster, outliers pulled in where the sonar is known to have them, and
    its variance."""
    mean = sums[2] / sums[0]
    spread_m_s = ti.static(max(io.sonar_cfg.doppler_sigma_m_s, 0.01))
    if ti.static(io.sonar_cfg.doppler_outlier > 0):
        mean = clipped_mean(env, c, mean, 3.0 * spread_m_s, io)
    bearing, slip_w = io.clusters.bearing_w[env, c], io.clusters.slip_w[env]
    io.clusters.doppler_m_s[env, c] = mean - (slip_w[0] * ti.cos(bearing) + slip_w[1] * ti.sin(bearing))
    wild = ti.static(io.sonar_cfg.doppler_outlier * (3.0 * max(io.sonar_cfg.doppler_sigma_m_s, 0.01)) ** 2)
    io.clusters.doppler_var[env, c] = (spread_m_s**2 + wild) / sums[0] + ti.static(_SLIP_SIGMA_M_S**2)


@ti.func
def clipped_mean(env, c, centre, bound, io: Bundle[TrackingIO]):
    """Mean Doppler of a cluster's beams, each pulled to within ``bound`` of ``centre``."""
    total = 0.0
    for k in range(io.clusters.span[env, c]):
        beam = (io.clusters.first_beam[env, c] + k) % io.sonar_cfg.n_ray
        if io.clusters.beam_cluster[env, beam] == c:
            total += ti.math.clamp(io.clusters.beam_doppler[env, beam], centre - bound, centre + bound)
    return total / io.clusters.n_beam[env, c]
