"""What a matched cluster does to its track: radius, filter, evidence of motion, turn rate (part of the
tracking stage)."""

import taichi as ti

from uuvtai.kernels.core.geometry import wrapped_angle
from uuvtai.kernels.core.kalman import corrected, largest_position_variance
from uuvtai.kernels.core.signature import Bundle
from uuvtai.kernels.perception.bundles import TrackingIO
from uuvtai.kernels.perception.sighting import (
    bearing_vector,
    centre_sight,
    centre_variances,
    missing_width,
    pair_surprise,
    radius_variance,
)

CONFIRMED = 3
"""Scans after which a track is old enough to move, and to survive one scan of being seen through."""

_RADIUS_DRIFT = 4.0e-4
"""[m^2/s] growth of the radius's variance: boxes turn their width, spheres leave the beam's plane."""

DOPPLER_SIGMAS = 4.0
"""A mean Doppler of this many standard deviations is motion."""

_SETTLED = 0.2
"""A turn rate is estimated where the velocity's variance is below this share of its square."""

_CORNER = 0.5
"""[rad] a larger change of course within one scan is a corner"""

_FASTEST_TURN = 4.0
"""[rad/s] bound of the turn rate"""


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
        known = 1.0 / (io.tracks.doppler_var[env, track] * (1.0 + dt / io.tracking_cfg.doppler_memory_s))
        new = 1.0 / io.clusters.doppler_var[env, c]
        io.tracks.doppler_m_s[env, track] = (
            known * io.tracks.doppler_m_s[env, track] + new * io.clusters.doppler_m_s[env, c]
        ) / (known + new)
        io.tracks.doppler_var[env, track] = 1.0 / (known + new)
    shift = io.tracks.shift_w[env, track] / (1.0 + dt / io.tracking_cfg.shift_memory_s)
    if io.clusters.hidden[env, c] == 0:
        after = io.tracks.state[env, track]
        shift += ti.Vector([after[0] - before[0] + dt * before[2], after[1] - before[1] + dt * before[3]])
    io.tracks.shift_w[env, track] = shift
    turned = wrapped_angle(io.clusters.bearing_w[env, c] - io.tracks.sight_w[env, track])
    io.tracks.sweep[env, track] = (
        io.tracks.sweep[env, track] / (1.0 + dt / io.tracking_cfg.shift_memory_s) + turned
    )
    io.tracks.sight_w[env, track] = io.clusters.bearing_w[env, c]


@ti.func
def is_moving(env, track, c, dt, io: Bundle[TrackingIO]):
    """1 where the track moves: fast enough and with evidence to begin with, until it is slow and there is
    none."""
    mean = io.tracks.state[env, track]
    fast = mean[2] * mean[2] + mean[3] * mean[3] > io.tracking_cfg.moving_speed_m_s**2
    shown = has_shifted(env, track, c, dt, io)
    if ti.static(io.sonar_cfg.doppler):
        doppler = ti.max(
            io.tracking_cfg.moving_doppler_m_s, DOPPLER_SIGMAS * ti.sqrt(io.tracks.doppler_var[env, track])
        )
        shown = shown or ti.abs(io.tracks.doppler_m_s[env, track]) > doppler
    begins = fast and shown and io.tracks.age[env, track] >= CONFIRMED - 1
    goes_on = io.tracks.moving[env, track] == 1 and (fast or shown)
    return ti.cast(begins or goes_on, ti.i32)


@ti.func
def has_shifted(env, track, c, dt, io: Bundle[TrackingIO]):
    """Whether the displacement shows motion: larger than noise and than what a turned view of a resting box
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
    reach = io.tracking_cfg.moving_shift_m + feigned + 2.0 * noise
    length = ti.sqrt(shift.dot(shift))
    forward = shift[0] * mean[2] + shift[1] * mean[3] > 0.8 * length * ti.sqrt(
        mean[2] * mean[2] + mean[3] * mean[3]
    )
    return length > reach and forward and io.tracks.age[env, track] * dt > io.tracking_cfg.shift_s


@ti.func
def update_turn_rate(env, track, before, io: Bundle[TrackingIO]):
    """Estimate the turn rate of a moving body from when its velocity is settled until that jumps: corners
    tell nothing about it.

    Without it the filter lags behind bodies on circles by a third of their speed.
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
