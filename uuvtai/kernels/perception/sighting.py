"""What a cluster says about a body of known radius: where its centre is, how surely, how well it fits a track
(part of tracking)."""

import taichi as ti

from uuvtai.kernels.core.kalman import position_variance, velocity_variance
from uuvtai.kernels.core.signature import Bundle
from uuvtai.kernels.perception.bundles import TrackingIO
from uuvtai.kernels.perception.clustering import ARC

_CROSS_SIGMA_M = 0.02
"""Error of a centre across the beam beside that of its edges (EC)."""

_EDGE_SIGMA = 0.25
"""Error of the middle of two edges, in beam spacings: each is uniform within one spacing, sqrt(1 / 24) = 0.2,
plus grazing loss."""


@ti.func
def bearing_vector(bearing):
    return ti.Vector([ti.cos(bearing), ti.sin(bearing)])


@ti.func
def centre_sight(env, c, radius, io: Bundle[TrackingIO]):
    """(bearing [rad], distance [m], half-angle [rad]) of the centre of a body of known radius; the open edge
    stands in for a hidden one."""
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
    """[m] by which a cluster with two free edges is narrower on one side than a body of known radius, beyond
    what noise explains.

    A body leaves the sonar's fan by its nearest part first: what is left of it are its two sides, and one
    of them says no more than that the centre is this near.
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
