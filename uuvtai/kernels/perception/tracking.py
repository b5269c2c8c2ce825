"""Tracking: from clusters of beams to tracks of moving bodies. Sees sensor data and its own memory only.

One scan: label beams - find clusters - predict - associate - update - prune - spawn - name beams. One Kalman
filter per track on position and mean Doppler; all states refer to the ping of the newest tracked scan
(``scan_step``). Static obstacles get tracks too, which must never be called moving: motion needs a speed and,
as evidence, Doppler averaged over beams and time or a displacement seen between unhidden edges.
"""

import math

import taichi as ti

from uuvtai.kernels.core.kalman import predicted
from uuvtai.kernels.core.signature import Bundle, spread
from uuvtai.kernels.perception.association import associate
from uuvtai.kernels.perception.bundles import TrackingIO
from uuvtai.kernels.perception.clustering import HELD_SIGMA_M_S, find_clusters, label_beams
from uuvtai.kernels.perception.habits import coasted, expected_turn_rate
from uuvtai.kernels.perception.track_slots import (
    SEEN_THROUGH,
    carry_names,
    clear_track,
    name_beams,
    prune_tracks,
    sight_of,
    spawn_tracks,
)
from uuvtai.kernels.perception.track_update import update_tracks
from uuvtai.kernels.perception.unseen import turn_back_rate, turned_back
from uuvtai.native.launch import quick_launch, with_cse


@quick_launch
@ti.kernel
def reset_tracks(io: Bundle[TrackingIO]):
    """Forget everything about the awake rows."""
    n = ti.static(io.clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and io.clock.awake[env] == 1:
            io.tracks.scan_step[env] = -1
            io.clusters.scan_step[env] = -1
            io.clusters.slip_w[env] = ti.zero(io.clusters.slip_w[env])
            io.clusters.own_sigma_m_s[env] = HELD_SIGMA_M_S
            io.clusters.fresh[env] = 0
            io.clusters.count[env] = 0
            for track in range(io.tracks.alive.shape[1]):
                clear_track(env, track, io.tracks)
            for ray in range(io.tracks.beam_track.shape[1]):
                io.tracks.beam_track[env, ray] = -1


def tracked_period_s(tracking, sonar, rules):
    """[s] between two tracked scans: the first multiple of the sonar's period that is no shorter than the
    tracking's own."""
    return sonar.period_steps * math.ceil(tracking.period_steps / sonar.period_steps) * rules.control_dt_s


def track_bodies(io: TrackingIO) -> None:
    """Bring the tracks of the awake rows to the newest scan, where one has come and the last tracked one is
    ``period_steps`` old.

    Four kernels, launched in turn: as one they compile three times as long, for the compiler's time grows
    faster than a kernel's size.
    """
    take_scan(io)
    cluster_beams(io)
    follow_bodies(io)
    keep_slots(io)


@quick_launch
@with_cse()
@ti.kernel
def take_scan(io: Bundle[TrackingIO]):
    """See whether a scan is due, and which of its beams may have hit a body."""
    n = ti.static(io.clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and io.clock.awake[env] == 1:
            io.clusters.fresh[env] = is_due(env, io)
            if io.clusters.fresh[env] == 1:
                io.clusters.scan_step[env] = io.scan.ping_step[env]
                io.clusters.scan_yaw[env] = io.scan.ping_yaw[env]
                label_beams(env, io)


@quick_launch
@ti.kernel
def cluster_beams(io: Bundle[TrackingIO]):
    """Gather the beams into clusters."""
    n = ti.static(io.clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and io.clock.awake[env] == 1 and io.clusters.fresh[env] == 1:
            find_clusters(env, io)


@quick_launch
@ti.kernel
def follow_bodies(io: Bundle[TrackingIO]):
    """Predict the tracks to the new ping, match them with clusters and correct them."""
    n = ti.static(io.clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and io.clock.awake[env] == 1 and io.clusters.fresh[env] == 1:
            dt = predict_tracks(env, io)
            associate(env, dt, io)
            update_tracks(env, dt, io)


@quick_launch
@ti.kernel
def keep_slots(io: Bundle[TrackingIO]):
    """End lost tracks, begin new ones, and name the beams."""
    n = ti.static(io.clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and io.clock.awake[env] == 1 and io.clusters.fresh[env] == 1:
            prune_tracks(env, ti.static(tracked_period_s(io.tracking_cfg, io.sonar_cfg, io.episode_cfg)), io)
            spawn_tracks(env, io)
            name_beams(env, io)
        if pad == 0 and io.clock.awake[env] == 1 and io.clusters.fresh[env] == 0 and io.scan.fresh[env] == 1:
            carry_names(env, io)


# ------------------------------------------------------------------------------------------------------ clock


@ti.func
def is_due(env, io: Bundle[TrackingIO]):
    """1 where a scan has come that is to be tracked."""
    last = io.clusters.scan_step[env]
    return ti.cast(
        io.scan.fresh[env] == 1
        and (last < 0 or io.scan.ping_step[env] - last >= io.tracking_cfg.period_steps),
        ti.i32,
    )


# ---------------------------------------------------------------------------------------------------- predict


@ti.func
def moved_on(env, track, dt, io: Bundle[TrackingIO]):
    """State, covariance and link to the turn rate of a track ``dt`` [s] later; one that is not seen may coast
    along its habits or turn back."""
    mean, cov, link = predicted(
        io.tracks.state[env, track],
        io.tracks.cov[env, track],
        io.tracks.turn_rate[env, track],
        io.tracks.turn_cov[env, track],
        dt,
        io.tracking_cfg.accel_density,
        io.tracking_cfg.turn_density,
    )
    unseen = io.tracks.moving[env, track] == 1 and io.tracks.misses[env, track] > 0
    if unseen and expected_turn_rate(env, track, io.tracks, io.forecast_cfg, io.tracking_cfg) == 0.0:
        if ti.static(io.forecast_cfg.use_coasting):
            mean = coasted(
                env,
                track,
                io.tracks.state[env, track],
                dt,
                io.habits,
                io.tracks,
                io.forecast_cfg,
                io.tank_cfg,
            )
        if ti.static(io.forecast_cfg.use_turning_back):
            if sight_of(env, track, io) == SEEN_THROUGH:  # what is hidden may be level
                rate = turn_back_rate(env, track, dt, io)
                mean, cov, link = turned_back(mean, cov, link, rate, dt)
    return mean, cov, link


@ti.func
def predict_tracks(env, io: Bundle[TrackingIO]):
    """Move every track to the time of the new ping; returns the time since the last one [s]."""
    dt = 0.0
    if io.tracks.scan_step[env] >= 0:
        dt = (io.clusters.scan_step[env] - io.tracks.scan_step[env]) * io.episode_cfg.control_dt_s
    io.tracks.scan_step[env] = io.clusters.scan_step[env]
    for track in range(io.tracks.alive.shape[1]):
        io.tracks.pick[env, track] = -1
        if io.tracks.alive[env, track] == 1:
            mean, cov, link = moved_on(env, track, dt, io)
            io.tracks.state[env, track] = mean
            io.tracks.cov[env, track] = cov
            io.tracks.turn_cov[env, track] = link
            io.tracks.age[env, track] += 1
            io.tracks.misses[env, track] += 1
    return dt
