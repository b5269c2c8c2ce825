"""Tracking: from clusters of beams to tracks of moving bodies. Sees sensor data and its own memory only.

One scan: label beams - find clusters - predict - associate - update - prune - spawn - name beams. One Kalman filter per track on position
and mean Doppler; all states refer to the ping of the newest tracked scan (``scan_step``). Static obstacles get tracks too, which must never
be called moving: motion needs a speed and, as evidence, Doppler averaged over beams and time or a displacement seen between unhidden edges.
"""

import math

import taichi as ti

from uuvtai.config import ElevationConfig, EpisodeConfig, ForecastConfig, SonarConfig, TankConfig, TrackingConfig
from uuvtai.kernels.core.kalman import predicted
from uuvtai.kernels.core.signature import Const, In, Out, quick_launch, spread
from uuvtai.kernels.perception.association import associate
from uuvtai.kernels.perception.clustering import HELD_SIGMA_M_S, find_clusters, label_beams
from uuvtai.kernels.perception.habits import coasted, expected_turn_rate
from uuvtai.kernels.perception.track_slots import carry_names, clear_track, name_beams, prune_tracks, spawn_tracks
from uuvtai.kernels.perception.track_update import update_tracks
from uuvtai.state import ClockState, ClusterState, HabitState, SonarScan, TrackState


@quick_launch
@ti.kernel
def reset_tracks(tracks: Out[TrackState], clusters: Out[ClusterState], clock: In[ClockState]):
    """Forget everything about the awake rows."""
    n = ti.static(clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and clock.awake[env] == 1:
            tracks.scan_step[env] = -1
            clusters.scan_step[env] = -1
            clusters.slip_w[env] = ti.zero(clusters.slip_w[env])
            clusters.own_sigma_m_s[env] = HELD_SIGMA_M_S
            clusters.fresh[env] = 0
            clusters.count[env] = 0
            for track in range(tracks.alive.shape[1]):
                clear_track(env, track, tracks)
            for ray in range(tracks.beam_track.shape[1]):
                tracks.beam_track[env, ray] = -1


def tracked_period_s(tracking, sonar, rules):
    """[s] between two tracked scans: the first multiple of the sonar's period that is no shorter than the tracking's own."""
    return sonar.period_steps * math.ceil(tracking.period_steps / sonar.period_steps) * rules.control_dt_s


def track_bodies(
    tracks: TrackState,
    clusters: ClusterState,
    habits: HabitState,
    scan: SonarScan,
    clock: ClockState,
    tracking: TrackingConfig,
    forecast_cfg: ForecastConfig,
    elevation: ElevationConfig,
    sonar: SonarConfig,
    tank: TankConfig,
    rules: EpisodeConfig,
):
    """Bring the tracks of the awake rows to the newest scan, where one has come and the last tracked one is ``period_steps`` old.

    Four kernels, launched in turn: as one they compile three times as long, for the compiler's time grows faster than a kernel's size.
    """
    take_scan(clusters, scan, clock, tracking, sonar, tank)
    cluster_beams(clusters, scan, clock, tracking, sonar)
    follow_bodies(tracks, clusters, habits, scan, clock, tracking, forecast_cfg, sonar, tank, rules)
    keep_slots(tracks, clusters, scan, clock, tracking, elevation, sonar, tank, rules)


@quick_launch
@ti.kernel
def take_scan(
    clusters: Out[ClusterState],
    scan: In[SonarScan],
    clock: In[ClockState],
    tracking: Const[TrackingConfig],
    sonar: Const[SonarConfig],
    tank: Const[TankConfig],
):
    """See whether a scan is due, and which of its beams may have hit a body."""
    n = ti.static(clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and clock.awake[env] == 1:
            clusters.fresh[env] = is_due(env, clusters, scan, tracking)
            if clusters.fresh[env] == 1:
                clusters.scan_step[env] = scan.ping_step[env]
                clusters.scan_yaw[env] = scan.ping_yaw[env]
                label_beams(env, clusters, scan, tracking, sonar, tank)


@quick_launch
@ti.kernel
def cluster_beams(
    clusters: Out[ClusterState], scan: In[SonarScan], clock: In[ClockState], tracking: Const[TrackingConfig], sonar: Const[SonarConfig]
):
    """Gather the beams into clusters."""
    n = ti.static(clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and clock.awake[env] == 1 and clusters.fresh[env] == 1:
            find_clusters(env, clusters, scan, tracking, sonar)


@quick_launch
@ti.kernel
def follow_bodies(
    tracks: Out[TrackState],
    clusters: Out[ClusterState],
    habits: In[HabitState],
    scan: In[SonarScan],
    clock: In[ClockState],
    tracking: Const[TrackingConfig],
    forecast_cfg: Const[ForecastConfig],
    sonar: Const[SonarConfig],
    tank: Const[TankConfig],
    rules: Const[EpisodeConfig],
):
    """Predict the tracks to the new ping, match them with clusters and correct them."""
    n = ti.static(clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and clock.awake[env] == 1 and clusters.fresh[env] == 1:
            dt = predict_tracks(env, tracks, clusters, habits, tracking, forecast_cfg, tank, rules)
            associate(env, dt, tracks, clusters, tracking, sonar)
            update_tracks(env, dt, tracks, clusters, scan, tracking, sonar, rules)


@quick_launch
@ti.kernel
def keep_slots(
    tracks: Out[TrackState],
    clusters: Out[ClusterState],
    scan: In[SonarScan],
    clock: In[ClockState],
    tracking: Const[TrackingConfig],
    elevation: Const[ElevationConfig],
    sonar: Const[SonarConfig],
    tank: Const[TankConfig],
    rules: Const[EpisodeConfig],
):
    """End lost tracks, begin new ones, and name the beams."""
    n = ti.static(clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and clock.awake[env] == 1 and clusters.fresh[env] == 1:
            prune_tracks(env, ti.static(tracked_period_s(tracking, sonar, rules)), tracks, scan, tracking, elevation, sonar, tank, rules)
            spawn_tracks(env, tracks, clusters, scan, tracking, elevation, sonar)
            name_beams(env, tracks, clusters)
        if pad == 0 and clock.awake[env] == 1 and clusters.fresh[env] == 0 and scan.fresh[env] == 1:
            carry_names(env, tracks, clusters, scan, tracking, sonar)


# --------------------------------------------------------------------------------------------------------------------- clock


@ti.func
def is_due(env, clusters: In[ClusterState], scan: In[SonarScan], tracking: Const[TrackingConfig]):
    """1 where a scan has come that is to be tracked."""
    last = clusters.scan_step[env]
    return ti.cast(scan.fresh[env] == 1 and (last < 0 or scan.ping_step[env] - last >= tracking.period_steps), ti.i32)


# ------------------------------------------------------------------------------------------------------------------- predict


@ti.func
def predict_tracks(
    env,
    tracks: Out[TrackState],
    clusters: In[ClusterState],
    habits: In[HabitState],
    tracking: Const[TrackingConfig],
    forecast_cfg: Const[ForecastConfig],
    tank: Const[TankConfig],
    rules: Const[EpisodeConfig],
):
    """Move every track to the time of the new ping; returns the time since the last one [s]."""
    dt = 0.0
    if tracks.scan_step[env] >= 0:
        dt = (clusters.scan_step[env] - tracks.scan_step[env]) * rules.control_dt_s
    tracks.scan_step[env] = clusters.scan_step[env]
    for track in range(tracks.alive.shape[1]):
        tracks.pick[env, track] = -1
        if tracks.alive[env, track] == 1:
            mean, cov, link = predicted(
                tracks.state[env, track],
                tracks.cov[env, track],
                tracks.turn_rate[env, track],
                tracks.turn_cov[env, track],
                dt,
                tracking.accel_density,
                tracking.turn_density,
            )
            if ti.static(forecast_cfg.use_coasting):
                unseen = tracks.moving[env, track] == 1 and tracks.misses[env, track] > 0
                if unseen and expected_turn_rate(env, track, tracks, forecast_cfg, tracking) == 0.0:
                    mean = coasted(env, track, tracks.state[env, track], dt, habits, tracks, forecast_cfg, tank)
            tracks.state[env, track] = mean
            tracks.cov[env, track] = cov
            tracks.turn_cov[env, track] = link
            tracks.age[env, track] += 1
            tracks.misses[env, track] += 1
    return dt
