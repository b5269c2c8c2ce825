"""From one sonar scan to clusters: runs of neighbouring beams that hit the same body (part of the tracking stage).

Returns from the known walls are left out, runs split at jumps of range or Doppler, a missed or false beam inside a body is bridged, and
runs wider than a body is expected to be are dropped. A body's outline is taken for a circle: its half-angle a gives the radius R = d sin a,
and the mean range of the visible arc, d - (pi / 4) R for small angles, gives the centre at the distance d.
"""

import math

import taichi as ti

from uuvtai.config import SonarConfig, TankConfig, TrackingConfig
from uuvtai.kernels.core.geometry import TWO_PI, turned_z
from uuvtai.kernels.core.lanes import LANES, f16x
from uuvtai.kernels.core.signature import Const, In, Out
from uuvtai.state import ClusterState, SonarScan

ARC = 0.25 * math.pi
"""Mean over the beams of a far circle's visible arc of sqrt(1 - x^2): how many radii its mean range lies before the centre."""

_CANDIDATE = 1 << 20
"""Label of a beam that may belong to a body and is in no cluster yet."""

_BRIDGE = 3
"""A run may step this many beams at once: over one beam of any kind, or over two without return."""

_MODEL_SIGMA_M = 0.01
"""What remains of a range's error however many beams are averaged: bodies are not circles (EC)."""

HELD_SIGMA_M_S = 1.0
"""Trust in the own velocity's last reading while the DVL has lost the bottom: it may be off by as much as the vehicle can change (EC)."""

_SLIP_SIGMA_M_S = 0.01
"""What remains of a Doppler's error however many beams are averaged: the own velocity's error (EC)."""


@ti.func
def range_variance(range_m, sonar: Const[SonarConfig]):
    """Variance of one beam's range [m^2]."""
    sigma = sonar.range_sigma_m + sonar.range_sigma_slope * range_m
    return sigma * sigma + ti.static(sonar.range_jitter_m**2 + sonar.range_quantum_m**2 / 12)


@ti.func
def split_distance(range_m, tracking: Const[TrackingConfig], sonar: Const[SonarConfig]):
    """Jump of range [m] between two beams that ends a body: the design's rule, or what noise alone can do."""
    return ti.max(tracking.split_m + tracking.split_slope * range_m, 4.0 * ti.sqrt(range_variance(range_m, sonar)))


@ti.func
def find_clusters(env, clusters: Out[ClusterState], scan: In[SonarScan], tracking: Const[TrackingConfig], sonar: Const[SonarConfig]):
    """Fill ``clusters`` from the labelled beams of this env (``label_beams`` first)."""
    start = quiet_beam(env, clusters, scan, tracking, sonar)
    clusters.count[env] = 0
    k = 0
    while k < sonar.n_ray:
        if clusters.beam_cluster[env, (start + k) % sonar.n_ray] == _CANDIDATE:
            last, sums = walk_run(env, start, k, clusters, scan, tracking, sonar)
            store_run(env, start, k, last, sums, clusters, scan, tracking, sonar)
            k = last
        k += 1


# ---------------------------------------------------------------------------------------------------------------------- beams


@ti.func
def label_beams(
    env,
    clusters: Out[ClusterState],
    scan: In[SonarScan],
    tracking: Const[TrackingConfig],
    sonar: Const[SonarConfig],
    tank: Const[TankConfig],
):
    """Label every beam _CANDIDATE or -1, compensate its Doppler, and learn the own velocity's error from the walls: they do not move.

    ``normal`` = (sum ux ux, sum ux uy, sum uy uy, sum ux e, sum uy e) over the walls' beams, u = beam, e = compensated Doppler.
    """
    pos, yaw = scan.ping_pos_w[env], scan.ping_yaw[env]
    vel = turned_z(scan.ping_vel_b[env], yaw)
    normal = ti.Vector([0.0, 0.0, 0.0, 0.0, 0.0])
    for packet in range(sonar.n_ray // LANES):
        ux, uy = packet_directions(yaw + packet * ti.static(LANES * TWO_PI / sonar.n_ray), sonar)
        range_m, doppler, hit = f16x(0.0), f16x(0.0), f16x(0.0)
        for i in ti.static(range(LANES)):
            range_m[i] = scan.range_m[env, packet * LANES + i]
            doppler[i] = scan.doppler_m_s[env, packet * LANES + i]
            hit[i] = ti.cast(scan.hit[env, packet * LANES + i], ti.f32)
        own = vel[0] * ux + vel[1] * uy
        still = doppler + own
        margin = tracking.wall_margin_m + 2.0 * ti.sqrt(range_variance(range_m, sonar))
        free = wall_distance(pos[0] + range_m * ux, pos[1] + range_m * uy, tank) - margin
        wall = ti.select(free < 0.0, hit, f16x(0.0))
        error = wall * still
        body = hit - wall
        wx = wall * ux
        wy = wall * uy
        normal += ti.Vector([(wx * ux).sum(), (wx * uy).sum(), (wy * uy).sum(), (error * ux).sum(), (error * uy).sum()])
        for i in ti.static(range(LANES)):
            clusters.beam_doppler[env, packet * LANES + i] = still[i]
            clusters.beam_cluster[env, packet * LANES + i] = ti.select(body[i] > 0.5, _CANDIDATE, -1)
    slip_w, sigma = velocity_slip(normal, scan.ping_vel_valid[env], tracking, sonar)
    clusters.slip_w[env] = slip_w
    clusters.own_sigma_m_s[env] = sigma


@ti.func
def packet_directions(first_bearing, sonar: Const[SonarConfig]):
    """Unit vectors (x, y) of sixteen neighbouring beams, the first at this world bearing."""
    c, s = ti.cos(first_bearing), ti.sin(first_bearing)
    ahead, left = f16x(0.0), f16x(0.0)
    for i in ti.static(range(LANES)):
        ahead[i] = ti.cast(ti.static(math.cos(i * TWO_PI / sonar.n_ray)), ti.f32)
        left[i] = ti.cast(ti.static(math.sin(i * TWO_PI / sonar.n_ray)), ti.f32)
    return c * ahead - s * left, s * ahead + c * left


@ti.func
def wall_distance(x, y, tank: Const[TankConfig]):
    """Distance [m] from the nearest side wall, positive inside; lanes."""
    out = ti.min(ti.min(x - tank.x_m[0], tank.x_m[1] - x), ti.min(y - tank.y_m[0], tank.y_m[1] - y))
    if ti.static(tank.shape == "circle"):
        dx = x - ti.static(0.5 * (tank.x_m[0] + tank.x_m[1]))
        dy = y - ti.static(0.5 * (tank.y_m[0] + tank.y_m[1]))
        out = ti.static(tank.radius_m) - ti.sqrt(dx * dx + dy * dy)
    return out


@ti.func
def velocity_slip(normal, valid, tracking: Const[TrackingConfig], sonar: Const[SonarConfig]):
    """Error of the own measured velocity [m/s, world] by which known walls would move: least squares with the own measurement as prior.

    Also the standard deviation [m/s] of what is left of it along the worst direction; 0 where the measurement is ``valid``. A reading that
    is only held is hardly trusted: the walls decide, as far as they are seen.
    """
    sigma = ti.static(max(sonar.doppler_sigma_m_s, 0.01))
    prior = ti.select(valid == 1, ti.static((sigma / tracking.own_speed_sigma_m_s) ** 2), ti.static((sigma / HELD_SIGMA_M_S) ** 2))
    xx, xy, yy = normal[0] + prior, normal[1], normal[2] + prior
    det = xx * yy - xy * xy
    slip_w = ti.Vector([yy * normal[3] - xy * normal[4], xx * normal[4] - xy * normal[3]]) / det
    weakest = 0.5 * (xx + yy) - ti.sqrt(0.25 * (xx - yy) * (xx - yy) + xy * xy)
    return slip_w, ti.select(valid == 1, 0.0, sigma / ti.sqrt(ti.max(weakest, prior)))


# ----------------------------------------------------------------------------------------------------------------------- runs


@ti.func
def joined(env, a, b, clusters: In[ClusterState], scan: In[SonarScan], tracking: Const[TrackingConfig], sonar: Const[SonarConfig]):
    """Whether two beams may lie on one body."""
    out = False
    if clusters.beam_cluster[env, a] == _CANDIDATE or clusters.beam_cluster[env, a] == clusters.count[env]:
        if clusters.beam_cluster[env, b] == _CANDIDATE:
            jump = ti.abs(scan.range_m[env, b] - scan.range_m[env, a])
            swing = ti.abs(clusters.beam_doppler[env, b] - clusters.beam_doppler[env, a])
            out = jump <= split_distance(scan.range_m[env, a], tracking, sonar) and swing <= ti.static(
                tracking.split_doppler_m_s + 6 * sonar.doppler_sigma_m_s
            )
    return out


@ti.func
def next_beam(env, beam, clusters: In[ClusterState], scan: In[SonarScan], tracking: Const[TrackingConfig], sonar: Const[SonarConfig]):
    """Beams from this one to the next of the same run, 0 = the run ends here."""
    n = ti.static(sonar.n_ray)
    out = 0
    step = 1
    last = ti.select(scan.hit[env, (beam + 1) % n] + scan.hit[env, (beam + 2) % n] == 0, _BRIDGE, 2)
    while out == 0 and step <= last:
        if joined(env, beam, (beam + step) % n, clusters, scan, tracking, sonar):
            out = step
        step += 1
    return out


@ti.func
def quiet_beam(env, clusters: In[ClusterState], scan: In[SonarScan], tracking: Const[TrackingConfig], sonar: Const[SonarConfig]):
    """A beam that no run crosses, so that runs through beam 0 stay whole; 0 if there is none."""
    n = ti.static(sonar.n_ray)
    out = -1
    s = 0
    while out < 0 and s < n:
        crossed = False
        for back in range(1, _BRIDGE + 1):
            beam = (s + n - back) % n
            if clusters.beam_cluster[env, beam] == _CANDIDATE:
                crossed = crossed or next_beam(env, beam, clusters, scan, tracking, sonar) >= back
        if not crossed:
            out = s
        s += 1
    return ti.max(out, 0)


@ti.func
def walk_run(
    env, start, first, clusters: Out[ClusterState], scan: In[SonarScan], tracking: Const[TrackingConfig], sonar: Const[SonarConfig]
):
    """Follow a run from offset ``first``; returns its last offset and (beams, sum of range, sum of Doppler). Labels its beams."""
    label = clusters.count[env]
    k = first
    sums = ti.Vector([0.0, 0.0, 0.0])
    going = True
    while going:
        beam = (start + k) % sonar.n_ray
        clusters.beam_cluster[env, beam] = label
        sums += ti.Vector([1.0, scan.range_m[env, beam], clusters.beam_doppler[env, beam]])
        ahead = next_beam(env, beam, clusters, scan, tracking, sonar)
        going = ahead > 0 and k + ahead < sonar.n_ray
        if going:
            for skipped in range(1, ahead):
                clusters.beam_cluster[env, (beam + skipped) % sonar.n_ray] = -1
            k += ahead
    return k, sums


@ti.func
def store_run(
    env,
    start,
    first,
    last,
    sums,
    clusters: Out[ClusterState],
    scan: In[SonarScan],
    tracking: Const[TrackingConfig],
    sonar: Const[SonarConfig],
):
    """Keep a run as a cluster if it can be a body; else take the label off its beams."""
    c = clusters.count[env]
    a, b = (start + first) % sonar.n_ray, (start + last) % sonar.n_ray
    range_m = sums[1] / sums[0] - sonar.range_jitter_m
    hidden = open_edges(env, a, b, clusters, scan, tracking, sonar)
    expected = tracking.min_radius_m / (ti.max(range_m, 0.1) * ti.static(TWO_PI / sonar.n_ray))
    if c < clusters.match.shape[1] and is_narrow(env, a, b, last - first, scan, tracking, sonar) and (hidden > 0 or sums[0] >= expected):
        clusters.first_beam[env, c] = a
        clusters.span[env, c] = last - first + 1
        clusters.n_beam[env, c] = ti.cast(sums[0], ti.i32)
        clusters.hidden[env, c] = hidden
        clusters.match[env, c] = -1
        place_cluster(env, c, range_m, clusters, scan, tracking, sonar)
        weigh_doppler(env, c, sums, clusters, sonar)
        clusters.count[env] = c + 1
    else:
        for k in range(first, last + 1):
            clusters.beam_cluster[env, (start + k) % sonar.n_ray] = -1


@ti.func
def is_narrow(env, a, b, steps, scan: In[SonarScan], tracking: Const[TrackingConfig], sonar: Const[SonarConfig]):
    """Whether the chord between the end beams can belong to a body."""
    ra, rb = scan.range_m[env, a], scan.range_m[env, b]
    half = ti.sin(ti.min(steps, sonar.n_ray // 2) * ti.static(0.5 * TWO_PI / sonar.n_ray))
    slack = ti.max(tracking.max_width_m, 4.0 * ti.sqrt(range_variance(ra, sonar)))
    return steps < sonar.n_ray // 2 and 4.0 * ra * rb * half * half < tracking.max_width_m**2 and ti.abs(ra - rb) < slack


@ti.func
def open_edges(env, a, b, clusters: In[ClusterState], scan: In[SonarScan], tracking: Const[TrackingConfig], sonar: Const[SonarConfig]):
    """Bit set of the edges (1 = first, 2 = last) that border a nearer return or go on as something else at the same range."""
    return edge_open(env, a, -1, clusters, scan, tracking, sonar) + 2 * edge_open(env, b, 1, clusters, scan, tracking, sonar)


@ti.func
def edge_open(env, edge, way, clusters: In[ClusterState], scan: In[SonarScan], tracking: Const[TrackingConfig], sonar: Const[SonarConfig]):
    """1 where the first return beyond this edge, within two beams, is nearer or continues it."""
    out = 0
    looking = True
    for step in ti.static((1, 2)):
        beam = (edge + way * step + sonar.n_ray) % sonar.n_ray
        if looking and scan.hit[env, beam] == 1:
            looking = False
            beyond = scan.range_m[env, beam] - scan.range_m[env, edge]
            touching = 0.1 + 3.0 * ti.sqrt(range_variance(scan.range_m[env, edge], sonar))
            out = ti.cast(beyond < touching, ti.i32)
    return out


@ti.func
def place_cluster(
    env, c, range_m, clusters: Out[ClusterState], scan: In[SonarScan], tracking: Const[TrackingConfig], sonar: Const[SonarConfig]
):
    """Circle through the visible arc: bearing, radius, centre, and the variance of the mean range."""
    step = ti.static(TWO_PI / sonar.n_ray)
    half = 0.5 * step * clusters.span[env, c]
    bearing = scan.ping_yaw[env] + step * (clusters.first_beam[env, c] + 0.5 * (clusters.span[env, c] - 1))
    radius = ti.math.clamp(range_m * ti.sin(half) / (1.0 - ARC * ti.sin(half)), tracking.min_radius_m, 0.5 * tracking.max_width_m)
    distance = range_m + ARC * radius
    pos = scan.ping_pos_w[env]
    clusters.bearing_w[env, c] = bearing
    clusters.radius_m[env, c] = radius
    clusters.range_m[env, c] = range_m
    clusters.range_var[env, c] = range_variance(range_m, sonar) / clusters.n_beam[env, c] + ti.static(_MODEL_SIGMA_M**2)
    clusters.pos_w[env, c] = ti.Vector([pos[0] + distance * ti.cos(bearing), pos[1] + distance * ti.sin(bearing)])


@ti.func
def weigh_doppler(env, c, sums, clusters: Out[ClusterState], sonar: Const[SonarConfig]):
    """Mean compensated Doppler of a cluster, outliers pulled in where the sonar is known to have them, and its variance."""
    mean = sums[2] / sums[0]
    spread_m_s = ti.static(max(sonar.doppler_sigma_m_s, 0.01))
    if ti.static(sonar.doppler_outlier > 0):
        mean = clipped_mean(env, c, mean, 3.0 * spread_m_s, clusters, sonar)
    bearing, slip_w = clusters.bearing_w[env, c], clusters.slip_w[env]
    clusters.doppler_m_s[env, c] = mean - (slip_w[0] * ti.cos(bearing) + slip_w[1] * ti.sin(bearing))
    wild = ti.static(sonar.doppler_outlier * (3.0 * max(sonar.doppler_sigma_m_s, 0.01)) ** 2)
    clusters.doppler_var[env, c] = (spread_m_s**2 + wild) / sums[0] + ti.static(_SLIP_SIGMA_M_S**2)


@ti.func
def clipped_mean(env, c, centre, bound, clusters: In[ClusterState], sonar: Const[SonarConfig]):
    """Mean Doppler of a cluster's beams, each pulled to within ``bound`` of ``centre``."""
    total = 0.0
    for k in range(clusters.span[env, c]):
        beam = (clusters.first_beam[env, c] + k) % sonar.n_ray
        if clusters.beam_cluster[env, beam] == c:
            total += ti.math.clamp(clusters.beam_doppler[env, beam], centre - bound, centre + bound)
    return total / clusters.n_beam[env, c]
