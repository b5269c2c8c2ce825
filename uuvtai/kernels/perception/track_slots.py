"""Which slot holds which body: lost tracks end, new ones begin, beams get the names of their tracks (part of the tracking stage)."""

import taichi as ti

from uuvtai.config import ElevationConfig, EpisodeConfig, SonarConfig, TankConfig, TrackingConfig
from uuvtai.kernels.core.geometry import FAR_M, TWO_PI, wrapped_angle
from uuvtai.kernels.core.kalman import born
from uuvtai.kernels.core.lanes import f16x
from uuvtai.kernels.core.signature import Const, In, Out
from uuvtai.kernels.perception.clustering import split_distance
from uuvtai.kernels.perception.elevation import begin_height, weigh_seen, weigh_unseen
from uuvtai.kernels.perception.sighting import bearing_vector, centre_sight, centre_variances, radius_variance
from uuvtai.kernels.perception.track_update import CONFIRMED, DOPPLER_SIGMAS
from uuvtai.state import ClusterState, SonarScan, TrackState

SEEN_THROUGH = 1
BLOCKED = 2

_MISS_S = 0.1
"""One "miss" of the config: a nominal 10 Hz scan."""

_SPOTTED_S = 0.3
"""[s] a body that the camera showed this lately is there, though beams pass above or below it."""

_PEEKING_RADIUS_M = 0.2
"""Least radius given to a body first seen past something nearer: half the size of the design's typical body."""


@ti.func
def clear_track(env, track, tracks: Out[TrackState]):
    tracks.alive[env, track] = 0
    tracks.moving[env, track] = 0
    tracks.state[env, track] = ti.zero(tracks.state[env, track])
    tracks.cov[env, track] = ti.zero(tracks.cov[env, track])
    tracks.z_m[env, track] = 0.0
    tracks.radius_m[env, track] = 0.0
    tracks.radius_var[env, track] = 0.0
    tracks.turn_rate[env, track] = 0.0
    tracks.turn_cov[env, track] = ti.zero(tracks.turn_cov[env, track])
    tracks.doppler_m_s[env, track] = 0.0
    tracks.doppler_var[env, track] = 0.0
    tracks.shift_w[env, track] = ti.zero(tracks.shift_w[env, track])
    tracks.sight_w[env, track] = 0.0
    tracks.sweep[env, track] = 0.0
    tracks.age[env, track] = 0
    tracks.misses[env, track] = 0
    tracks.seen_step[env, track] = 0
    tracks.pick[env, track] = -1
    tracks.pick_cost[env, track] = 0.0
    tracks.height[env, track, 0] = f16x(0.0)
    tracks.present[env, track] = 0.0
    tracks.spot_step[env, track] = -1


# --------------------------------------------------------------------------------------------------------------------- prune


@ti.func
def prune_tracks(
    env,
    dt,
    tracks: Out[TrackState],
    scan: In[SonarScan],
    tracking: Const[TrackingConfig],
    elevation: Const[ElevationConfig],
    sonar: Const[SonarConfig],
    tank: Const[TankConfig],
    rules: Const[EpisodeConfig],
):
    """Weigh how high moving bodies may be, and end unmatched tracks that are not where they are expected, or doubled a matched one."""
    for track in range(tracks.alive.shape[1]):
        if tracks.alive[env, track] == 1:
            remembered = ti.static(elevation.memory_s > 0) and tracks.moving[env, track] == 1
            if tracks.misses[env, track] == 0:
                if remembered:
                    weigh_seen(env, track, scan.ping_pos_w[env], tracks, elevation, sonar, tank)
            elif is_double(env, track, tracks):
                clear_track(env, track, tracks)
            else:
                sight = sight_of(env, track, tracks, scan, tracking, sonar)
                gone = 0
                if remembered:
                    gone = is_forgotten(env, track, sight, dt, tracks, scan, elevation, sonar, tank)
                else:
                    gone = is_lost(env, track, sight, tracks, scan, tracking, rules)
                if gone == 1:
                    clear_track(env, track, tracks)


@ti.func
def is_forgotten(
    env,
    track,
    sight,
    dt,
    tracks: Out[TrackState],
    scan: In[SonarScan],
    elevation: Const[ElevationConfig],
    sonar: Const[SonarConfig],
    tank: Const[TankConfig],
):
    """1 where a moving body is hardly where it is expected any more: seen through within the fan, or unseen for long."""
    if sight == SEEN_THROUGH:
        weigh_unseen(env, track, scan.ping_pos_w[env], dt, tracks, elevation, sonar, tank)
    tracks.present[env, track] *= ti.exp(-dt * ti.static(1.0 / max(elevation.memory_s, 1e-3)))
    return ti.cast(tracks.present[env, track] < elevation.gone_share, ti.i32)


@ti.func
def is_lost(env, track, sight, tracks: In[TrackState], scan: In[SonarScan], tracking: Const[TrackingConfig], rules: Const[EpisodeConfig]):
    """1 where an unmatched track is seen through, or was unseen for too long (longer where hidden)."""
    unseen = (scan.ping_step[env] - tracks.seen_step[env, track]) * rules.control_dt_s
    longest = ti.select(sight == BLOCKED, tracking.hidden_s, ti.static(tracking.max_misses * _MISS_S))
    if tracks.spot_step[env, track] >= 0:  # the camera shows it
        unseen = ti.min(unseen, (scan.ping_step[env] - tracks.spot_step[env, track]) * rules.control_dt_s)
    spotted = tracks.spot_step[env, track] >= 0 and unseen < _SPOTTED_S
    through = sight == SEEN_THROUGH and not spotted and (tracks.age[env, track] < CONFIRMED or unseen >= tracking.see_through_s)
    return ti.cast(through or unseen > longest, ti.i32)


@ti.func
def sight_of(env, track, tracks: In[TrackState], scan: In[SonarScan], tracking: Const[TrackingConfig], sonar: Const[SonarConfig]):
    """What most beams through the middle of the predicted body say: SEEN_THROUGH, BLOCKED by something nearer, or 0 = neither."""
    step = ti.static(TWO_PI / sonar.n_ray)
    own, mean, radius = scan.ping_pos_w[env], tracks.state[env, track], tracks.radius_m[env, track]
    dx, dy = mean[0] - own[0], mean[1] - own[1]
    distance = ti.sqrt(dx * dx + dy * dy)
    middle = ti.cast(ti.floor((ti.atan2(dy, dx) - scan.ping_yaw[env]) / step + 0.5), ti.i32)
    half = ti.cast(0.5 * radius / (ti.max(distance, radius) * step), ti.i32)
    slack = radius + split_distance(distance, tracking, sonar)
    through, before = 0, 0
    for k in range(-half, half + 1):
        ray = (middle + k + 2 * sonar.n_ray) % sonar.n_ray
        past = scan.hit[env, ray] == 0 or scan.range_m[env, ray] > distance + slack
        through += ti.cast(past, ti.i32)
        before += ti.cast(scan.hit[env, ray] == 1 and scan.range_m[env, ray] < distance - slack, ti.i32)
    return ti.select(2 * through > 2 * half + 1, SEEN_THROUGH, ti.select(2 * before > 2 * half + 1, BLOCKED, 0))


@ti.func
def is_double(env, track, tracks: In[TrackState]):
    """Whether a matched track sits where this unmatched one is expected."""
    out = False
    here = tracks.state[env, track]
    for other in range(tracks.alive.shape[1]):
        if tracks.alive[env, other] == 1 and tracks.misses[env, other] == 0:
            there = tracks.state[env, other]
            apart = 0.5 * (tracks.radius_m[env, track] + tracks.radius_m[env, other])
            out = out or (here[0] - there[0]) ** 2 + (here[1] - there[1]) ** 2 < apart * apart
    return out


# --------------------------------------------------------------------------------------------------------------------- spawn


@ti.func
def spawn_tracks(
    env,
    tracks: Out[TrackState],
    clusters: Out[ClusterState],
    scan: In[SonarScan],
    tracking: Const[TrackingConfig],
    elevation: Const[ElevationConfig],
    sonar: Const[SonarConfig],
):
    """Begin a track for every unmatched cluster, unless it is a splinter of a body that is tracked already."""
    for c in range(clusters.count[env]):
        if clusters.match[env, c] < 0:
            owner = owner_of(env, c, tracks, clusters, tracking, sonar)
            if owner < 0:
                owner = free_slot(env, c, tracks, clusters, scan, tracking)
                if owner >= 0:
                    begin_track(env, owner, c, tracks, clusters, scan, tracking, elevation, sonar)
            clusters.match[env, c] = owner


@ti.func
def owner_of(env, c, tracks: In[TrackState], clusters: In[ClusterState], tracking: Const[TrackingConfig], sonar: Const[SonarConfig]):
    """A track seen in this scan whose outline and Doppler cover this cluster, -1 = none."""
    out = -1
    here = clusters.pos_w[env, c]
    for track in range(tracks.alive.shape[1]):
        if tracks.alive[env, track] == 1 and tracks.misses[env, track] == 0:
            there, reach = tracks.state[env, track], tracks.radius_m[env, track] + tracking.min_radius_m
            close = (here[0] - there[0]) ** 2 + (here[1] - there[1]) ** 2 < reach * reach
            swing = ti.abs(clusters.doppler_m_s[env, c] - tracks.doppler_m_s[env, track])
            if close and swing < ti.static(tracking.split_doppler_m_s + 3 * sonar.doppler_sigma_m_s):
                out = track
    return out


@ti.func
def free_slot(env, c, tracks: In[TrackState], clusters: In[ClusterState], scan: In[SonarScan], tracking: Const[TrackingConfig]):
    """A dead slot; else that of the least useful resting track: lost ones first, then the farthest if it is farther than the newcomer.

    A newcomer with clear Doppler displaces any resting track. -1 = none.
    """
    own = scan.ping_pos_w[env]
    moves = ti.abs(clusters.doppler_m_s[env, c]) > ti.max(
        tracking.moving_doppler_m_s, DOPPLER_SIGMAS * ti.sqrt(clusters.doppler_var[env, c])
    )
    out = -1
    worst = ti.select(moves, -1.0, clusters.range_m[env, c] + clusters.radius_m[env, c])
    for track in range(tracks.alive.shape[1]):
        mean = tracks.state[env, track]
        away = ti.sqrt((mean[0] - own[0]) ** 2 + (mean[1] - own[1]) ** 2)
        score = away + 100.0 * tracks.misses[env, track]
        if tracks.alive[env, track] == 0:
            score = FAR_M
        if score > worst and tracks.moving[env, track] == 0:
            out, worst = track, score
    return out


@ti.func
def begin_track(
    env,
    track,
    c,
    tracks: Out[TrackState],
    clusters: Out[ClusterState],
    scan: In[SonarScan],
    tracking: Const[TrackingConfig],
    elevation: Const[ElevationConfig],
    sonar: Const[SonarConfig],
):
    """A new track from one cluster: velocity along the bearing from the Doppler, unknown across. Displaces whoever had the slot."""
    if tracks.alive[env, track] == 1 and tracks.pick[env, track] >= 0:
        clusters.match[env, tracks.pick[env, track]] = -1
    clear_track(env, track, tracks)
    radius, radius_var = clusters.radius_m[env, c], radius_variance(env, c, clusters, sonar)
    if clusters.hidden[env, c] > 0:
        radius, radius_var = ti.max(radius, _PEEKING_RADIUS_M), ti.static(tracking.min_radius_m**2)
    bearing, distance, _ = centre_sight(env, c, radius, clusters, sonar)
    along, own = bearing_vector(bearing), scan.ping_pos_w[env]
    centre = ti.Vector([own[0], own[1]]) + distance * along
    radial_var, cross_var = centre_variances(env, c, radius, radius_var, clusters, sonar)
    cross_speed_var = ti.static(tracking.birth_speed_sigma_m_s**2)
    mean, cov = born(centre, along, radial_var, cross_var, clusters.doppler_m_s[env, c], clusters.doppler_var[env, c], cross_speed_var)
    tracks.alive[env, track] = 1
    tracks.state[env, track] = mean
    tracks.cov[env, track] = cov
    tracks.z_m[env, track] = own[2]
    tracks.radius_m[env, track] = radius
    tracks.radius_var[env, track] = radius_var
    tracks.sight_w[env, track] = clusters.bearing_w[env, c]
    tracks.doppler_m_s[env, track] = clusters.doppler_m_s[env, c]
    tracks.doppler_var[env, track] = clusters.doppler_var[env, c]
    tracks.seen_step[env, track] = scan.ping_step[env]
    begin_height(env, track, tracks, elevation)


@ti.func
def name_beams(env, tracks: Out[TrackState], clusters: In[ClusterState]):
    """Write into every beam of a tracked scan which track it hit."""
    for ray in range(tracks.beam_track.shape[1]):
        c = clusters.beam_cluster[env, ray]
        tracks.beam_track[env, ray] = -1
        if c >= 0:
            tracks.beam_track[env, ray] = clusters.match[env, c]


@ti.func
def carry_names(
    env,
    tracks: Out[TrackState],
    clusters: In[ClusterState],
    scan: In[SonarScan],
    tracking: Const[TrackingConfig],
    sonar: Const[SonarConfig],
):
    """Name the beams of a scan that is not tracked after the last one that was: same bearing, and a range at which that body can be."""
    step = ti.static(TWO_PI / sonar.n_ray)
    shift = ti.cast(ti.floor(wrapped_angle(scan.ping_yaw[env] - clusters.scan_yaw[env]) / step + 0.5), ti.i32)
    for ray in range(sonar.n_ray):
        c = clusters.beam_cluster[env, (ray + shift + sonar.n_ray) % sonar.n_ray]
        name = -1
        if c >= 0 and scan.hit[env, ray] == 1:
            range_m = scan.range_m[env, ray]
            if ti.abs(range_m - clusters.range_m[env, c]) < clusters.radius_m[env, c] + split_distance(range_m, tracking, sonar):
                name = clusters.match[env, c]
        tracks.beam_track[env, ray] = name
