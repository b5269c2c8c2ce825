"""What a matched cluster does to its track: radius, filter, evidence of motion, turn rate (part of the
tracking stage)."""

import taichi as ti

from uuvtai.config import TrafficConfig
from uuvtai.kernels.core.geometry import FAR_M, wrapped_angle
from uuvtai.kernels.core.kalman import (
    AT,
    corrected,
    largest_position_variance,
    position_variance,
    velocity_variance,
)
from uuvtai.kernels.core.stage import Bundle, Const
from uuvtai.kernels.perception.clustering import ARC
from uuvtai.kernels.perception.io import TrackingIO
from uuvtai.kernels.perception.prediction import BEGIN_SEEN, STRAIGHT_ODDS, next_turn

# ------------------------------------------------------------------------------------------------------------
# What a cluster says about an obstacle of known radius: where its centre is, how surely, how well it fits a
# track (part of tracking).


_CROSS_SIGMA_M = 0.02  # Error of a centre across the beam beside that of its edges (EC).

_EDGE_SIGMA = 0.25
"""Error of the middle of two edges, in beam spacings: each is uniform within one spacing, sqrt(1 / 24) = 0.2,
plus grazing loss."""


MOVING_M_S, MOVING_DOPPLER_M_S = 0.08, 0.03
"""An obstacle moves if it is faster, and its Doppler is larger (EC)."""

MOVING_SHIFT_M, SHIFT_S = 0.12, 0.5
"""Or by a displacement from this length and age on: motion across the beams (EC)."""

SHIFT_MEMORY_S, DOPPLER_MEMORY_S = 2.0, 0.5
"""Time constants with which displacement and mean Doppler are forgotten (EC)."""


@ti.func
def bearing_vector(bearing):
    return ti.Vector([ti.cos(bearing), ti.sin(bearing)])


@ti.func
def centre_sight(env, c, radius, io: Bundle[TrackingIO]):
    """(bearing [rad], distance [m], half-angle [rad]) of the centre of an obstacle of known radius; the open
    edge stands in for a hidden one."""
    distance = io.clusters.range_m[env, c] + ARC * radius
    half = radius / distance
    distance /= 1.0 - half * half / 6.0
    spare = half - 0.5 * ti.static(io.sonar_cfg.beam_step_rad) * io.clusters.span[env, c]
    bearing = io.clusters.bearing_w[env, c]
    if io.clusters.hidden[env, c] == 1:
        bearing -= ti.max(spare, 0.0)
    if io.clusters.hidden[env, c] == 2:
        bearing += ti.max(spare, 0.0)
    return bearing, distance, half


@ti.func
def missing_width(env, c, radius, radius_var, io: Bundle[TrackingIO]):
    """[m] by which a cluster with two free edges is narrower on one side than an obstacle of known radius,
    beyond what noise explains.

    An obstacle leaves the sonar's fan by its nearest part first: what is left of it are its two sides, and
    one of them says no more than that the centre is this near.
    """
    missing = 0.0
    if ti.static(io.tracking_cfg.partial_sigmas > 0):
        distance = io.clusters.range_m[env, c] + ARC * radius
        seen = distance * ti.sin(0.5 * ti.static(io.sonar_cfg.beam_step_rad) * io.clusters.span[env, c])
        slack = io.tracking_cfg.partial_sigmas * ti.sqrt(radius_var + radius_variance(env, c, io))
        missing = ti.select(io.clusters.hidden[env, c] == 0, ti.max(radius - seen - slack, 0.0), 0.0)
    return missing


@ti.func
def centre_variances(env, c, radius, radius_var, io: Bundle[TrackingIO]):
    """Variances [m^2] of a cluster's centre along and across the beam, larger where an edge is hidden or a
    part is missing."""
    edge = _EDGE_SIGMA * ti.static(io.sonar_cfg.beam_step_rad) * io.clusters.range_m[env, c]
    radial = io.clusters.range_var[env, c] + ARC * ARC * radius_var
    cross = edge * edge + _CROSS_SIGMA_M * _CROSS_SIGMA_M
    missing = missing_width(env, c, radius, radius_var, io)
    radial += missing * missing
    cross += missing * missing
    if io.clusters.hidden[env, c] > 0:
        radial += 0.09 * radius * radius
        cross += 0.25 * radius * radius + radius_var
    return radial, cross


@ti.func
def radius_variance(env, c, io: Bundle[TrackingIO]):
    """Variance [m^2] of a cluster's radius: half of two edges, each uniform within one beam spacing."""
    edge = _EDGE_SIGMA * ti.static(io.sonar_cfg.beam_step_rad) * io.clusters.range_m[env, c]
    return edge * edge + _CROSS_SIGMA_M * _CROSS_SIGMA_M


@ti.func
def pair_surprise(env, track, c, offset, io: Bundle[TrackingIO]):
    """(squared normalised innovation of range, cross range and, where it is measured, Doppler; product of
    their variances; the part of the position alone)."""
    mean, cov = io.tracks.state[env, track], io.tracks.cov[env, track]
    along = bearing_vector(io.clusters.bearing_w[env, c])
    across = ti.Vector([-along[1], along[0]])
    radial_var, cross_var = centre_variances(
        env, c, io.tracks.radius_m[env, track], io.tracks.radius_var[env, track], io
    )
    s_radial = position_variance(cov, along) + radial_var
    s_cross = position_variance(cov, across) + cross_var
    radial, cross = offset.dot(along), offset.dot(across)
    near = radial * radial / s_radial + cross * cross / s_cross
    surprise, volume = near + 0.0, s_radial * s_cross
    if ti.static(io.sonar_cfg.doppler):
        s_doppler = velocity_variance(cov, along) + io.clusters.doppler_var[env, c]
        swing = io.clusters.doppler_m_s[env, c] - (mean[2] * along[0] + mean[3] * along[1])
        surprise = near + swing * swing / s_doppler
        volume = s_radial * s_cross * s_doppler
    return surprise, volume, near


# ------------------------------------------------------------------------------------------------------------


CONFIRMED = 3
"""Scans after which a track is old enough to move, and to survive one scan of being seen through."""

_RADIUS_DRIFT = 4.0e-4
"""[m^2/s] growth of the radius's variance: boxes turn their width, spheres leave the beam's plane."""

DOPPLER_SIGMAS = 4.0
"""A mean Doppler of this many standard deviations is motion."""

_SETTLED = 0.2  # A turn rate is estimated where the velocity's variance is below this share of its square.

_CORNER = 0.5  # [rad] a larger change of course within one scan is a corner

_FASTEST_TURN = 4.0  # [rad/s] bound of the turn rate


@ti.func
def update_tracks(env, dt, io: Bundle[TrackingIO]):
    """Feed every matched track its cluster."""
    for track in range(io.tracks.alive.shape[1]):
        c = io.tracks.pick[env, track]
        if c >= 0:
            before = io.tracks.state[env, track]
            update_radius(env, track, c, dt, io)
            update_filter(env, track, c, io)
            since = dt
            if ti.static(io.sonar_cfg.mechanical):  # the head has come round since
                since = (
                    io.scan.ping_step[env] - io.tracks.seen_step[env, track]
                ) * io.episode_cfg.control_dt_s
            update_evidence(env, track, c, since, before, io)
            io.tracks.z_m[env, track] = io.scan.ping_pos_w[env][2]
            io.tracks.seen_step[env, track] = io.scan.ping_step[env]
            io.tracks.misses[env, track] = 0
            io.tracks.moving[env, track] = is_moving(env, track, c, dt, io)
            update_turn_rate(env, track, before, io)


@ti.func
def update_radius(env, track, c, dt, io: Bundle[TrackingIO]):
    """Average the radius over time; a partly hidden body only tells that it is at least as large as what is
    seen."""
    seen, known = io.clusters.radius_m[env, c], io.tracks.radius_m[env, track]
    var = io.tracks.radius_var[env, track] + _RADIUS_DRIFT * dt
    missing = missing_width(env, c, known, var, io)
    noise = radius_variance(env, c, io) + missing * missing
    if io.clusters.hidden[env, c] == 0 or seen > known:
        known += (seen - known) * var / (var + noise)
        var = var * noise / (var + noise)
    io.tracks.radius_m[env, track] = known
    io.tracks.radius_var[env, track] = ti.min(var, ti.static(io.tracking_cfg.min_radius_m**2))


@ti.func
def update_filter(env, track, c, io: Bundle[TrackingIO]):
    """Correct position and velocity by range, cross range and Doppler; what surprises has turned: its
    velocity is opened up first."""
    bearing, distance, half = centre_sight(env, c, io.tracks.radius_m[env, track], io)
    along = bearing_vector(bearing)
    across = ti.Vector([-along[1], along[0]])
    own = io.scan.ping_pos_w[env]
    centre = ti.Vector([own[0], own[1]]) + distance * along
    radial_var, cross_var = centre_variances(
        env, c, io.tracks.radius_m[env, track], io.tracks.radius_var[env, track], io
    )
    mean, cov = io.tracks.state[env, track], io.tracks.cov[env, track]
    offset = centre - ti.Vector([mean[0], mean[1]])
    surprise, _, _ = pair_surprise(env, track, c, offset, io)
    if surprise > io.tracking_cfg.turn_gate:
        speed = ti.sqrt(mean[2] * mean[2] + mean[3] * mean[3])
        cov[7] += ti.max(speed, 0.5) ** 2
        cov[9] += ti.max(speed, 0.5) ** 2
    # Three numbers one after another, which is exact as their errors are independent: range (h = along on
    # the position), cross range, Doppler (h = along on the velocity). The mean Doppler over the visible half
    # angle a is v'along times the mean cosine, sin(a) / a = 1 - a^2 / 6. Without Doppler: the first two.
    h = ti.Vector([along[0], along[1], 0.0, 0.0])
    rate, link = io.tracks.turn_rate[env, track], io.tracks.turn_cov[env, track]
    mean_r, cov_r, rate_r, link_r = corrected(mean, cov, rate, link, h, offset.dot(along), radial_var)
    left = centre - ti.Vector([mean_r[0], mean_r[1]])
    h_cross = ti.Vector([across[0], across[1], 0.0, 0.0])
    mean_c, cov_c, rate_c, link_c = corrected(
        mean_r, cov_r, rate_r, link_r, h_cross, left.dot(across), cross_var
    )
    if ti.static(io.sonar_cfg.doppler):
        shrink = 1.0 - half * half / 6.0
        h_doppler = ti.Vector([0.0, 0.0, shrink * along[0], shrink * along[1]])
        swing = io.clusters.doppler_m_s[env, c] - shrink * (mean_c[2] * along[0] + mean_c[3] * along[1])
        mean_d, cov_d, rate_d, link_d = corrected(
            mean_c, cov_c, rate_c, link_c, h_doppler, swing, io.clusters.doppler_var[env, c]
        )
        put_filter(env, track, mean_d, cov_d, rate_d, link_d, io)
    else:
        put_filter(env, track, mean_c, cov_c, rate_c, link_c, io)


@ti.func
def put_filter(env, track, mean, cov, rate, link, io: Bundle[TrackingIO]):
    """Write a track's filter."""
    io.tracks.state[env, track] = mean
    io.tracks.cov[env, track] = cov
    io.tracks.turn_rate[env, track] = rate
    io.tracks.turn_cov[env, track] = link


@ti.func
def update_evidence(env, track, c, dt, before, io: Bundle[TrackingIO]):
    """Fading mean of the Doppler and fading displacement. ``before`` = mean predicted for this scan."""
    if ti.static(io.sonar_cfg.doppler):
        known = 1.0 / (io.tracks.doppler_var[env, track] * (1.0 + dt / DOPPLER_MEMORY_S))
        new = 1.0 / io.clusters.doppler_var[env, c]
        io.tracks.doppler_m_s[env, track] = (
            known * io.tracks.doppler_m_s[env, track] + new * io.clusters.doppler_m_s[env, c]
        ) / (known + new)
        io.tracks.doppler_var[env, track] = 1.0 / (known + new)
    shift = io.tracks.shift_w[env, track] / (1.0 + dt / SHIFT_MEMORY_S)
    if io.clusters.hidden[env, c] == 0:
        after = io.tracks.state[env, track]
        shift += ti.Vector([after[0] - before[0] + dt * before[2], after[1] - before[1] + dt * before[3]])
    io.tracks.shift_w[env, track] = shift
    turned = wrapped_angle(io.clusters.bearing_w[env, c] - io.tracks.sight_w[env, track])
    io.tracks.sweep[env, track] = io.tracks.sweep[env, track] / (1.0 + dt / SHIFT_MEMORY_S) + turned
    io.tracks.sight_w[env, track] = io.clusters.bearing_w[env, c]


@ti.func
def is_moving(env, track, c, dt, io: Bundle[TrackingIO]):
    """1 where the track moves: fast enough and with evidence to begin with, until it is slow and there is
    none."""
    mean = io.tracks.state[env, track]
    fast = mean[2] * mean[2] + mean[3] * mean[3] > MOVING_M_S**2
    shown = has_shifted(env, track, c, dt, io)
    if ti.static(io.sonar_cfg.doppler):
        doppler = ti.max(MOVING_DOPPLER_M_S, DOPPLER_SIGMAS * ti.sqrt(io.tracks.doppler_var[env, track]))
        shown = shown or ti.abs(io.tracks.doppler_m_s[env, track]) > doppler
    begins = fast and shown and io.tracks.age[env, track] >= CONFIRMED - 1
    goes_on = io.tracks.moving[env, track] == 1 and (fast or shown)
    return ti.cast(begins or goes_on, ti.i32)


@ti.func
def has_shifted(env, track, c, dt, io: Bundle[TrackingIO]):
    """Whether the displacement shows motion: larger than noise and than what a turned view of a static box
    feigns, and along the velocity.

    A box shows other faces as the bearing turns: its apparent centre moves by up to its half-extent times
    that angle.
    """
    mean, shift = io.tracks.state[env, track], io.tracks.shift_w[env, track]
    _, cross_var = centre_variances(
        env, c, io.tracks.radius_m[env, track], io.tracks.radius_var[env, track], io
    )
    noise = ti.sqrt(largest_position_variance(io.tracks.cov[env, track], 0.0) + cross_var)
    feigned = 0.5 * io.tracking_cfg.max_width_m * ti.abs(io.tracks.sweep[env, track])
    reach = MOVING_SHIFT_M + feigned + 2.0 * noise
    length = ti.sqrt(shift.dot(shift))
    forward = shift[0] * mean[2] + shift[1] * mean[3] > 0.8 * length * ti.sqrt(
        mean[2] * mean[2] + mean[3] * mean[3]
    )
    return length > reach and forward and io.tracks.age[env, track] * dt > SHIFT_S


@ti.func
def update_turn_rate(env, track, before, io: Bundle[TrackingIO]):
    """Estimate the turn rate of a moving obstacle from when its velocity is settled until that jumps: corners
    tell nothing about it.

    Without it the filter lags behind obstacles on circles by a third of their speed.
    """
    after, cov = io.tracks.state[env, track], io.tracks.cov[env, track]
    unsettled = (cov[7] + cov[9]) / (_SETTLED * (after[2] * after[2] + after[3] * after[3]))
    turned = ti.atan2(
        before[2] * after[3] - before[3] * after[2], before[2] * after[2] + before[3] * after[3]
    )
    if io.tracks.moving[env, track] == 0 or unsettled >= 1.0 or ti.abs(turned) >= _CORNER:
        io.tracks.turn_rate[env, track] = 0.0
        io.tracks.turn_cov[env, track] = ti.zero(io.tracks.turn_cov[env, track])
    elif io.tracks.turn_cov[env, track][4] == 0.0:
        io.tracks.turn_cov[env, track] = ti.Vector(
            [0.0, 0.0, 0.0, 0.0, ti.static(io.tracking_cfg.turn_rate_sigma_rad_s**2)]
        )
    io.tracks.turn_rate[env, track] = ti.math.clamp(
        io.tracks.turn_rate[env, track], -_FASTEST_TURN, _FASTEST_TURN
    )


# ------------------------------------------------------------------------------------------------------------
# Obstacles above or below the fan may turn back: where they are then, and how uncertain that is (part of
# tracking).
#
# An obstacle that swims to and fro at constant speed and turns back at the rate h [1/s] has the velocity s(t)
# v with s = +-1: its mean is exp(-2ht) v, and the covariance of its velocity at two times falls as exp(-2h |t
# - t'|) (Kac's telegraph process). An Ornstein-Uhlenbeck velocity with the rate 2h and the same mean square
# has the same first and second moments at all times, so a Kalman filter can carry them: the mean slows down
# and stays ahead of the last sight by v / 2h, the variance along the way grows backwards as well as forwards.
# The mean square of the velocity, mean^2 + variance, is what such an obstacle keeps: its largest axis is the
# way, its root the speed.


_SLOWEST_M_S = 0.1  # A slower body is where it is, whichever way it turns.

_LEAST_SHARE = 1.0e-3  # Share of ways at least that an obstacle may still be on.

_ODD_SHARE = 0.05  # Share of ways that are longer than any expected: their length is exponential.


@ti.func
def way_of(mean, cov):
    """(unit vector along the way, mean square speed along it [m^2/s^2])."""
    xx, xy, yy = mean[2] * mean[2] + cov[7], mean[2] * mean[3] + cov[8], mean[3] * mean[3] + cov[9]
    half = 0.5 * (xx - yy)
    root = ti.sqrt(half * half + xy * xy)
    angle = 0.5 * ti.atan2(xy, half)
    c, s = ti.cos(angle), ti.sin(angle)
    ahead = ti.select(c * mean[2] + s * mean[3] < 0.0, -1.0, 1.0)
    return ti.Vector([ahead * c, ahead * s]), 0.5 * (xx + yy) + root


@ti.func
def turn_back_rate(env, track, dt, io: Bundle[TrackingIO]):
    """[1/s] at which an unseen obstacle turns back, from the length of way that it was seen to go straight; 0
    where its next turn is known."""
    mean = io.tracks.state[env, track]
    course, square = way_of(mean, io.tracks.cov[env, track])
    speed, pos = ti.sqrt(square), ti.Vector([mean[0], mean[1]])
    rate = 0.0
    if speed > _SLOWEST_M_S:
        turn = FAR_M + 0.0
        if ti.static(io.forecast_cfg.use_turn_history):
            turn, _ = next_turn(env, pos, course, io)
        if turn >= FAR_M:
            begun, known = 0.0, io.turn_history.run_kind[env, track] >= BEGIN_SEEN
            if io.turn_history.run_kind[env, track] > 0:
                begun = ti.max((pos - io.turn_history.run_from_w[env, track]).dot(course), 0.0)
            first = ti.max(longer_share(begun, known, io.traffic_cfg), _LEAST_SHARE)
            last = ti.max(longer_share(begun + speed * dt, known, io.traffic_cfg), _LEAST_SHARE)
            straight = straight_share(env, track, io)
            rate = straight * ti.log(first / last) / ti.max(dt, 1.0e-3)
    return rate


@ti.func
def longer_share(way_m, known, traffic_cfg: Const[TrafficConfig]):
    """S: share of straight ways that go on for more than ``way_m`` [m]; ``known``: counted from their begin,
    else from a place anywhere on them."""
    low, high = ti.static(traffic_cfg.leg_m)
    left = ti.math.clamp((high - way_m) * ti.static(1.0 / max(high - low, 1e-3)), 0.0, 1.0)
    if not known:
        middle = ti.static(0.5 * (low + high))
        beyond = ti.max(high - way_m, 0.0)
        curve = beyond * beyond * ti.static(0.5 / max(high - low, 1e-3) / (0.5 * (low + high)))
        left = ti.select(way_m < low, (middle - way_m) / middle, curve)
    return (1.0 - _ODD_SHARE) * left + _ODD_SHARE * ti.exp(-way_m * ti.static(1.0 / high))


@ti.func
def straight_share(env, track, io: Bundle[TrackingIO]):
    """Probability that the obstacle goes straight rather than in a circle
    (``io.turn_history.expected_turn_rate``)."""
    share = 1.0
    if ti.static(io.forecast_cfg.use_turn_rate and io.tracking_cfg.turn_rate_sigma_rad_s > 0):
        rate, var = io.tracks.turn_rate[env, track], io.tracks.turn_cov[env, track][4]
        if var > 0.0:
            turns = ti.sqrt(var) * ti.static(1.0 / io.tracking_cfg.turn_rate_sigma_rad_s)
            turns *= ti.exp(ti.min(0.5 * rate * rate / var, 20.0))
            share = STRAIGHT_ODDS / (STRAIGHT_ODDS + turns)
    return share


@ti.func
def turned_back(mean, cov, link, rate, dt):
    """(mean, covariance, link) that went straight for dt [s], of an obstacle that turns back at ``rate``
    [1/s]."""
    course, square = way_of(mean, cov)
    x = 2.0 * rate * dt
    left = ti.exp(-x)
    short = dt * _lag(x)
    m = _along(mean, course, short, 1.0 - left)
    bound = _along(ti.Vector([link[0], link[1], link[2], link[3]]), course, short, 1.0 - left)
    half = ti.Matrix.zero(ti.f32, 4, 4)
    for j in ti.static(range(4)):
        column = _along(ti.Vector([cov[ti.static(AT[i][j])] for i in range(4)]), course, short, 1.0 - left)
        for i in ti.static(range(4)):
            half[i, j] = column[i]
    # noise of the Ornstein-Uhlenbeck velocity along the way; (1 - e)^2 / x^2 = (1 - lag)^2 to all orders
    gained = 1.0 - _lag(x)
    q = ti.Vector([dt * dt * _spread(x), dt * x * gained * gained, 1.0 - left * left]) * square
    grown = cov + 0.0
    for i in ti.static(range(4)):
        row = _along(ti.Vector([half[i, j] for j in range(4)]), course, short, 1.0 - left)
        for j in ti.static(range(i, 4)):
            noise = q[ti.static(i // 2 + j // 2)] * course[ti.static(i % 2)] * course[ti.static(j % 2)]
            grown[ti.static(AT[i][j])] = row[j] + noise
    return m, grown, ti.Vector([bound[0], bound[1], bound[2], bound[3], link[4]])


@ti.func
def _along(u, course, short, lost):
    """A small change of (x, y, vx, vy): along the way the velocity loses a share, the position what that
    would have driven."""
    gone = (u[2] * course[0] + u[3] * course[1]) * course
    return u - ti.Vector([short * gone[0], short * gone[1], lost * gone[0], lost * gone[1]])


@ti.func
def _lag(x):
    """1 - (1 - exp(-x)) / x."""
    series = x * (0.5 - x * (1.0 / 6.0 - x * (1.0 / 24.0 - x * (1.0 / 120.0))))
    return ti.select(x < 0.1, series, 1.0 - (1.0 - ti.exp(-x)) / ti.max(x, 0.1))


@ti.func
def _spread(x):
    """(2x - 3 + 4 exp(-x) - exp(-2x)) / x^2."""
    series = x * (2.0 / 3.0 - x * (0.5 - x * (7.0 / 30.0 - x * (1.0 / 12.0 - x * (31.0 / 1260.0)))))
    far = ti.max(x, 0.4)
    left = ti.exp(-far)
    return ti.select(x < 0.4, series, (2.0 * far - 3.0 + 4.0 * left - left * left) / (far * far))
