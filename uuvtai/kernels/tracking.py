"""Tracking: from clusters of beams to tracks of moving bodies, and where they will be. Sees sensor data and its own memory only.

One scan: predict - find clusters - associate - update - prune - spawn - name the beams. One Kalman filter per track on position and mean Doppler;
all states refer to the ping of the newest tracked scan (``scan_step``). Static obstacles get tracks too, which must never be called moving:
motion needs a speed and, as evidence, either Doppler (averaged over beams and time) or a displacement seen between unhidden edges.
"""

import taichi as ti

from uuvtai.config import EpisodeConfig, SonarConfig, TankConfig, TrackingConfig
from uuvtai.kernels.clustering import ARC, find_clusters, split_distance
from uuvtai.kernels.geometry import FAR_M, TWO_PI, turned_z, wrapped_angle
from uuvtai.kernels.kalman import born, corrected, largest_position_variance, position_variance, predicted, velocity_variance
from uuvtai.kernels.signature import Const, In, Out, spread
from uuvtai.state import ClockState, ClusterState, ForecastState, SonarScan, TrackState

SEEN_THROUGH = 1
BLOCKED = 2

_MISS_S = 0.1
"""One "miss" of the config: a nominal 10 Hz scan."""

_CONFIRMED = 3
"""Scans after which a track is old enough to move, and to survive one scan of being seen through."""

_CROSS_SIGMA_M = 0.02
"""Error of a centre across the beam beside that of its edges (EC)."""

_EDGE_SIGMA = 0.25
"""Error of the middle of two edges, in beam spacings: each is uniform within one spacing, sqrt(1 / 24) = 0.2, plus grazing loss."""

_PEEKING_RADIUS_M = 0.2
"""Least radius given to a body first seen past something nearer: half the size of the design's typical body."""

_RADIUS_DRIFT = 4.0e-4
"""[m^2/s] growth of the radius's variance: boxes turn their width, spheres leave the beam's plane."""

_REACH_M = 2.0
"""No match is looked for beyond this; saves the arithmetic."""

_DOPPLER_SIGMAS = 4.0
"""A mean Doppler of this many standard deviations is motion."""

_TURN_MEMORY_S = 0.5
_SETTLED = 0.2
"""A turn rate is learnt where the velocity's variance is below this share of its square."""

_CORNER = 0.5
"""[rad] a larger change of course within one scan is a corner"""

_FASTEST_TURN = 4.0
"""[rad/s] bound of the turn rate"""


@ti.kernel
def reset_tracks(tracks: Out[TrackState], clusters: Out[ClusterState], forecast: Out[ForecastState], clock: In[ClockState]):
    """Forget everything about the awake rows."""
    n = ti.static(clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and clock.awake[env] == 1:
            tracks.scan_step[env] = -1
            clusters.scan_step[env] = -1
            clusters.fresh[env] = 0
            clusters.count[env] = 0
            for track in range(tracks.alive.shape[1]):
                clear_track(env, track, tracks)
                clear_forecast(env, track, forecast)
            for ray in range(tracks.beam_track.shape[1]):
                tracks.beam_track[env, ray] = -1


@ti.kernel
def track_bodies(
    tracks: Out[TrackState],
    clusters: Out[ClusterState],
    scan: In[SonarScan],
    clock: In[ClockState],
    tracking: Const[TrackingConfig],
    sonar: Const[SonarConfig],
    tank: Const[TankConfig],
    rules: Const[EpisodeConfig],
):
    """Bring the tracks of the awake rows to the newest scan, where one has come and the last tracked one is ``period_steps`` old."""
    n = ti.static(clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and clock.awake[env] == 1:
            clusters.fresh[env] = is_due(env, clusters, scan, tracking)
            if clusters.fresh[env] == 1:
                clusters.scan_step[env] = scan.ping_step[env]
                find_clusters(env, clusters, scan, tracking, sonar, tank)
                dt = predict_tracks(env, tracks, clusters, tracking, rules)
                associate(env, dt, tracks, clusters, tracking, sonar)
                update_tracks(env, dt, tracks, clusters, scan, tracking, sonar, rules)
                prune_tracks(env, tracks, scan, tracking, sonar, rules)
                spawn_tracks(env, tracks, clusters, scan, tracking, sonar)
                name_beams(env, tracks, clusters)


@ti.kernel
def forecast_tracks(
    forecast: Out[ForecastState], tracks: In[TrackState], clock: In[ClockState], tracking: Const[TrackingConfig], rules: Const[EpisodeConfig]
):
    """Constant velocity from now to the horizon, for the moving tracks of the awake rows; the others get a negative radius.

    The radius grows by ``growth_sigmas`` standard deviations of the predicted position along its worst axis, as the filter knows it today:
    turns to come are not in it (the planner's own growing margin is for them). At most ``max_growth_m``.
    """
    n = ti.static(clock.awake.shape[0])
    n_track = ti.static(tracks.alive.shape[1])
    for env, track, pad in ti.ndrange(n, n_track, ti.static(spread(n * n_track))):
        if pad == 0 and clock.awake[env] == 1:
            if tracks.alive[env, track] * tracks.moving[env, track] == 1:
                extrapolate(env, track, forecast, tracks, clock, tracking, rules)
            else:
                clear_forecast(env, track, forecast)


# ---------------------------------------------------------------------------------------------------------- clock and forgetting


@ti.func
def is_due(env, clusters: In[ClusterState], scan: In[SonarScan], tracking: Const[TrackingConfig]):
    """1 where a scan has come that is to be tracked."""
    last = clusters.scan_step[env]
    return ti.cast(scan.fresh[env] == 1 and (last < 0 or scan.ping_step[env] - last >= tracking.period_steps), ti.i32)


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


@ti.func
def clear_forecast(env, track, forecast: Out[ForecastState]):
    for k in range(forecast.radius_m.shape[2]):
        forecast.radius_m[env, track, k] = -1.0


@ti.func
def extrapolate(
    env, track, forecast: Out[ForecastState], tracks: In[TrackState], clock: In[ClockState], tracking: Const[TrackingConfig], rules: Const[EpisodeConfig]
):
    mean, cov = tracks.state[env, track], tracks.cov[env, track]
    late = (clock.step[env] - tracks.scan_step[env]) * rules.control_dt_s
    for k in range(forecast.radius_m.shape[2]):
        ahead = late + k * tracking.forecast_dt_s
        growth = tracking.growth_sigmas * ti.sqrt(largest_position_variance(cov, ahead))
        forecast.pos_w[env, track, k] = ti.Vector([mean[0] + ahead * mean[2], mean[1] + ahead * mean[3]])
        forecast.radius_m[env, track, k] = tracks.radius_m[env, track] + ti.min(growth, tracking.max_growth_m)


# ------------------------------------------------------------------------------------------------------------------- predict


@ti.func
def predict_tracks(env, tracks: Out[TrackState], clusters: In[ClusterState], tracking: Const[TrackingConfig], rules: Const[EpisodeConfig]):
    """Move every track to the time of the new ping; returns the time since the last one [s]."""
    dt = 0.0
    if tracks.scan_step[env] >= 0:
        dt = (clusters.scan_step[env] - tracks.scan_step[env]) * rules.control_dt_s
    tracks.scan_step[env] = clusters.scan_step[env]
    for track in range(tracks.alive.shape[1]):
        tracks.pick[env, track] = -1
        if tracks.alive[env, track] == 1:
            course = turned_course(tracks.state[env, track], 0.5 * dt * tracks.turn_rate[env, track])
            mean, cov = predicted(course, tracks.cov[env, track], dt, tracking.accel_density)
            tracks.state[env, track] = turned_course(mean, 0.5 * dt * tracks.turn_rate[env, track])
            tracks.cov[env, track] = cov
            tracks.age[env, track] += 1
            tracks.misses[env, track] += 1
    return dt


@ti.func
def turned_course(mean, angle):
    """Mean with its velocity turned."""
    vel = turned_z(ti.Vector([mean[2], mean[3]]), angle)
    return ti.Vector([mean[0], mean[1], vel[0], vel[1]])


# ----------------------------------------------------------------------------------------------------------------- associate


@ti.func
def associate(env, dt, tracks: Out[TrackState], clusters: Out[ClusterState], tracking: Const[TrackingConfig], sonar: Const[SonarConfig]):
    """Pair tracks and clusters, cheapest pair first.

    Each track asks for its cheapest cluster; a cluster keeps the cheapest of the tracks that ask, and who is turned away asks for its next.
    With a cost both sides agree on, that ends in the pairs of the greedy rule, without sorting (Gale and Shapley).
    """
    for track in range(tracks.alive.shape[1]):
        tracks.pick_cost[env, track] = -FAR_M
        asking = ti.select(tracks.alive[env, track] == 1, track, -1)
        while asking >= 0:
            ask_next(env, asking, dt, tracks, clusters, tracking, sonar)
            wanted = tracks.pick[env, asking]
            if wanted < 0:
                asking = -1
            else:
                holder = clusters.match[env, wanted]
                if holder < 0 or tracks.pick_cost[env, asking] < tracks.pick_cost[env, holder]:
                    clusters.match[env, wanted] = asking
                    asking = holder


@ti.func
def ask_next(env, track, dt, tracks: Out[TrackState], clusters: In[ClusterState], tracking: Const[TrackingConfig], sonar: Const[SonarConfig]):
    """Set ``pick`` to the cheapest cluster that costs more than the last one asked for, -1 = none."""
    best, best_cost = -1, FAR_M
    for c in range(clusters.count[env]):
        cost = pair_cost(env, track, c, dt, tracks, clusters, tracking, sonar)
        if cost > tracks.pick_cost[env, track] and cost < best_cost:
            best, best_cost = c, cost
    tracks.pick[env, track] = best
    tracks.pick_cost[env, track] = best_cost


@ti.func
def pair_cost(env, track, c, dt, tracks: In[TrackState], clusters: In[ClusterState], tracking: Const[TrackingConfig], sonar: Const[SonarConfig]):
    """-2 log likelihood (up to a constant) of the cluster being this track's body; FAR_M outside the gate."""
    cost = FAR_M
    mean = tracks.state[env, track]
    offset = clusters.pos_w[env, c] - ti.Vector([mean[0], mean[1]])
    square = offset.dot(offset)
    if square < _REACH_M * _REACH_M:
        surprise, volume, near = pair_surprise(env, track, c, offset, tracks, clusters, sonar)
        free = tracking.gate_m + dt * ti.sqrt(mean[2] * mean[2] + mean[3] * mean[3])
        if near < tracking.turn_gate or square < free * free:
            cost = surprise + ti.log(volume)
    return cost


@ti.func
def pair_surprise(env, track, c, offset, tracks: In[TrackState], clusters: In[ClusterState], sonar: Const[SonarConfig]):
    """(squared normalised innovation of range, cross range and Doppler; product of their variances; the part of the position alone)."""
    mean, cov = tracks.state[env, track], tracks.cov[env, track]
    along = bearing_vector(clusters.bearing_w[env, c])
    across = ti.Vector([-along[1], along[0]])
    radial_var, cross_var = centre_variances(env, c, tracks.radius_m[env, track], tracks.radius_var[env, track], clusters, sonar)
    s_radial = position_variance(cov, along) + radial_var
    s_cross = position_variance(cov, across) + cross_var
    s_doppler = velocity_variance(cov, along) + clusters.doppler_var[env, c]
    radial, cross = offset.dot(along), offset.dot(across)
    swing = clusters.doppler_m_s[env, c] - (mean[2] * along[0] + mean[3] * along[1])
    near = radial * radial / s_radial + cross * cross / s_cross
    return near + swing * swing / s_doppler, s_radial * s_cross * s_doppler, near


@ti.func
def centre_variances(env, c, radius, radius_var, clusters: In[ClusterState], sonar: Const[SonarConfig]):
    """Variances [m^2] of a cluster's centre along and across the beam, larger where an edge is hidden."""
    edge = _EDGE_SIGMA * ti.static(TWO_PI / sonar.n_ray) * clusters.range_m[env, c]
    radial = clusters.range_var[env, c] + ARC * ARC * radius_var
    cross = edge * edge + _CROSS_SIGMA_M * _CROSS_SIGMA_M
    if clusters.hidden[env, c] > 0:
        radial += 0.09 * radius * radius
        cross += 0.25 * radius * radius + radius_var
    return radial, cross


@ti.func
def bearing_vector(bearing):
    return ti.Vector([ti.cos(bearing), ti.sin(bearing)])


# -------------------------------------------------------------------------------------------------------------------- update


@ti.func
def update_tracks(
    env, dt, tracks: Out[TrackState], clusters: In[ClusterState], scan: In[SonarScan], tracking: Const[TrackingConfig], sonar: Const[SonarConfig],
    rules: Const[EpisodeConfig],
):
    """Feed every matched track its cluster."""
    for track in range(tracks.alive.shape[1]):
        c = tracks.pick[env, track]
        if c >= 0:
            before = tracks.state[env, track]
            update_radius(env, track, c, dt, tracks, clusters, tracking, sonar)
            update_filter(env, track, c, tracks, clusters, scan, tracking, sonar)
            update_evidence(env, track, c, dt, before, tracks, clusters, tracking)
            tracks.z_m[env, track] = scan.ping_pos_w[env][2]
            tracks.seen_step[env, track] = scan.ping_step[env]
            tracks.misses[env, track] = 0
            tracks.moving[env, track] = is_moving(env, track, c, dt, tracks, clusters, tracking, sonar)
            update_turn_rate(env, track, dt, before, tracks)


@ti.func
def radius_variance(env, c, clusters: In[ClusterState], sonar: Const[SonarConfig]):
    """Variance [m^2] of a cluster's radius: half of two edges, each uniform within one beam spacing."""
    edge = _EDGE_SIGMA * ti.static(TWO_PI / sonar.n_ray) * clusters.range_m[env, c]
    return edge * edge + _CROSS_SIGMA_M * _CROSS_SIGMA_M


@ti.func
def update_radius(env, track, c, dt, tracks: Out[TrackState], clusters: In[ClusterState], tracking: Const[TrackingConfig], sonar: Const[SonarConfig]):
    """Average the radius over time; a partly hidden body only tells that it is at least as large as what is seen."""
    seen, known = clusters.radius_m[env, c], tracks.radius_m[env, track]
    var = tracks.radius_var[env, track] + _RADIUS_DRIFT * dt
    noise = radius_variance(env, c, clusters, sonar)
    if clusters.hidden[env, c] == 0 or seen > known:
        known += (seen - known) * var / (var + noise)
        var = var * noise / (var + noise)
    tracks.radius_m[env, track] = known
    tracks.radius_var[env, track] = ti.min(var, ti.static(tracking.min_radius_m**2))


@ti.func
def centre_sight(env, c, radius, clusters: In[ClusterState], sonar: Const[SonarConfig]):
    """(bearing [rad], distance [m], half-angle [rad]) of the centre of a body of known radius; a hidden edge is replaced by the other one."""
    distance = clusters.range_m[env, c] + ARC * radius
    half = radius / distance
    distance /= 1.0 - half * half / 6.0
    spare = half - 0.5 * ti.static(TWO_PI / sonar.n_ray) * clusters.span[env, c]
    bearing = clusters.bearing_w[env, c]
    if clusters.hidden[env, c] == 1:
        bearing -= ti.max(spare, 0.0)
    if clusters.hidden[env, c] == 2:
        bearing += ti.max(spare, 0.0)
    return bearing, distance, half


@ti.func
def update_filter(
    env, track, c, tracks: Out[TrackState], clusters: In[ClusterState], scan: In[SonarScan], tracking: Const[TrackingConfig], sonar: Const[SonarConfig]
):
    """Correct position and velocity by range, cross range and Doppler; a body that surprises has turned: its velocity is opened up first."""
    bearing, distance, half = centre_sight(env, c, tracks.radius_m[env, track], clusters, sonar)
    along = bearing_vector(bearing)
    across = ti.Vector([-along[1], along[0]])
    own = scan.ping_pos_w[env]
    centre = ti.Vector([own[0], own[1]]) + distance * along
    radial_var, cross_var = centre_variances(env, c, tracks.radius_m[env, track], tracks.radius_var[env, track], clusters, sonar)
    mean, cov = tracks.state[env, track], tracks.cov[env, track]
    offset = centre - ti.Vector([mean[0], mean[1]])
    surprise, _, _ = pair_surprise(env, track, c, offset, tracks, clusters, sonar)
    if surprise > tracking.turn_gate:
        speed = ti.sqrt(mean[2] * mean[2] + mean[3] * mean[3])
        cov[7] += ti.max(speed, 0.5) ** 2
        cov[9] += ti.max(speed, 0.5) ** 2
    h = ti.Vector([along[0], along[1], 0.0, 0.0])
    mean_r, cov_r = corrected(mean, cov, h, offset.dot(along), radial_var)
    left = centre - ti.Vector([mean_r[0], mean_r[1]])
    h_cross = ti.Vector([across[0], across[1], 0.0, 0.0])
    mean_c, cov_c = corrected(mean_r, cov_r, h_cross, left.dot(across), cross_var)
    shrink = 1.0 - half * half / 6.0
    h_doppler = ti.Vector([0.0, 0.0, shrink * along[0], shrink * along[1]])
    swing = clusters.doppler_m_s[env, c] - shrink * (mean_c[2] * along[0] + mean_c[3] * along[1])
    mean_d, cov_d = corrected(mean_c, cov_c, h_doppler, swing, clusters.doppler_var[env, c])
    tracks.state[env, track] = mean_d
    tracks.cov[env, track] = cov_d


@ti.func
def update_evidence(env, track, c, dt, before, tracks: Out[TrackState], clusters: In[ClusterState], tracking: Const[TrackingConfig]):
    """Fading mean of the Doppler and fading displacement. ``before`` = mean predicted for this scan."""
    known = 1.0 / (tracks.doppler_var[env, track] * (1.0 + dt / tracking.doppler_memory_s))
    new = 1.0 / clusters.doppler_var[env, c]
    tracks.doppler_m_s[env, track] = (known * tracks.doppler_m_s[env, track] + new * clusters.doppler_m_s[env, c]) / (known + new)
    tracks.doppler_var[env, track] = 1.0 / (known + new)
    shift = tracks.shift_w[env, track] / (1.0 + dt / tracking.shift_memory_s)
    if clusters.hidden[env, c] == 0:
        after = tracks.state[env, track]
        shift += ti.Vector([after[0] - before[0] + dt * before[2], after[1] - before[1] + dt * before[3]])
    tracks.shift_w[env, track] = shift
    turned = wrapped_angle(clusters.bearing_w[env, c] - tracks.sight_w[env, track])
    tracks.sweep[env, track] = tracks.sweep[env, track] / (1.0 + dt / tracking.shift_memory_s) + turned
    tracks.sight_w[env, track] = clusters.bearing_w[env, c]


@ti.func
def is_moving(env, track, c, dt, tracks: In[TrackState], clusters: In[ClusterState], tracking: Const[TrackingConfig], sonar: Const[SonarConfig]):
    """1 where the track moves: fast enough and with evidence to begin with, until it is slow and there is none."""
    mean = tracks.state[env, track]
    fast = mean[2] * mean[2] + mean[3] * mean[3] > tracking.moving_speed_m_s**2
    doppler = ti.max(tracking.moving_doppler_m_s, _DOPPLER_SIGMAS * ti.sqrt(tracks.doppler_var[env, track]))
    shown = ti.abs(tracks.doppler_m_s[env, track]) > doppler or has_shifted(env, track, c, dt, tracks, clusters, tracking, sonar)
    begins = fast and shown and tracks.age[env, track] >= _CONFIRMED - 1
    goes_on = tracks.moving[env, track] == 1 and (fast or shown)
    return ti.cast(begins or goes_on, ti.i32)


@ti.func
def has_shifted(env, track, c, dt, tracks: In[TrackState], clusters: In[ClusterState], tracking: Const[TrackingConfig], sonar: Const[SonarConfig]):
    """Whether the displacement shows motion: larger than noise and than what a turned view of a resting box feigns, and along the velocity.

    A box shows other faces as the bearing turns: its apparent centre moves by up to its half-extent times that angle.
    """
    mean, shift = tracks.state[env, track], tracks.shift_w[env, track]
    _, cross_var = centre_variances(env, c, tracks.radius_m[env, track], tracks.radius_var[env, track], clusters, sonar)
    noise = ti.sqrt(largest_position_variance(tracks.cov[env, track], 0.0) + cross_var)
    feigned = 0.5 * tracking.max_width_m * ti.abs(tracks.sweep[env, track])
    reach = tracking.moving_shift_m + feigned + 2.0 * noise
    length = ti.sqrt(shift.dot(shift))
    forward = shift[0] * mean[2] + shift[1] * mean[3] > 0.8 * length * ti.sqrt(mean[2] * mean[2] + mean[3] * mean[3])
    return length > reach and forward and tracks.age[env, track] * dt > tracking.shift_s


@ti.func
def update_turn_rate(env, track, dt, before, tracks: Out[TrackState]):
    """Learn the turn rate from what the filter turns the velocity beyond the prediction, as far as the velocity is settled.

    Without it the filter lags behind bodies on circles by a third of their speed. Corners and reversals reset it.
    """
    after, cov = tracks.state[env, track], tracks.cov[env, track]
    unsettled = (cov[7] + cov[9]) / (_SETTLED * (after[2] * after[2] + after[3] * after[3]))
    turned = ti.atan2(before[2] * after[3] - before[3] * after[2], before[2] * after[2] + before[3] * after[3])
    if tracks.moving[env, track] == 1 and unsettled < 1.0 and ti.abs(turned) < _CORNER:
        rate = tracks.turn_rate[env, track] + (1.0 - unsettled) * turned / (_TURN_MEMORY_S + dt)
        tracks.turn_rate[env, track] = ti.math.clamp(rate, -_FASTEST_TURN, _FASTEST_TURN)
    else:
        tracks.turn_rate[env, track] = 0.0


# --------------------------------------------------------------------------------------------------------------------- prune


@ti.func
def prune_tracks(env, tracks: Out[TrackState], scan: In[SonarScan], tracking: Const[TrackingConfig], sonar: Const[SonarConfig], rules: Const[EpisodeConfig]):
    """End unmatched tracks that are seen through, that doubled a matched one, or that were lost for too long (longer where hidden)."""
    for track in range(tracks.alive.shape[1]):
        if tracks.alive[env, track] == 1 and tracks.misses[env, track] > 0:
            unseen = (scan.ping_step[env] - tracks.seen_step[env, track]) * rules.control_dt_s
            sight = sight_of(env, track, tracks, scan, tracking, sonar)
            longest = ti.select(sight == BLOCKED, tracking.hidden_s, ti.static(tracking.max_misses * _MISS_S))
            gone = sight == SEEN_THROUGH and (tracks.age[env, track] < _CONFIRMED or unseen >= tracking.see_through_s)
            if gone or unseen > longest or is_double(env, track, tracks):
                clear_track(env, track, tracks)


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
    env, tracks: Out[TrackState], clusters: Out[ClusterState], scan: In[SonarScan], tracking: Const[TrackingConfig], sonar: Const[SonarConfig]
):
    """Begin a track for every unmatched cluster, unless it is a splinter of a body that is tracked already."""
    for c in range(clusters.count[env]):
        if clusters.match[env, c] < 0:
            owner = owner_of(env, c, tracks, clusters, tracking, sonar)
            if owner < 0:
                owner = free_slot(env, c, tracks, clusters, scan, tracking)
                if owner >= 0:
                    begin_track(env, owner, c, tracks, clusters, scan, tracking, sonar)
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
        tracking.moving_doppler_m_s, _DOPPLER_SIGMAS * ti.sqrt(clusters.doppler_var[env, c])
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
    env, track, c, tracks: Out[TrackState], clusters: Out[ClusterState], scan: In[SonarScan], tracking: Const[TrackingConfig], sonar: Const[SonarConfig]
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


@ti.func
def name_beams(env, tracks: Out[TrackState], clusters: In[ClusterState]):
    """Write into every beam which track it hit."""
    for ray in range(tracks.beam_track.shape[1]):
        c = clusters.beam_cluster[env, ray]
        tracks.beam_track[env, ray] = -1
        if c >= 0:
            tracks.beam_track[env, ray] = clusters.match[env, c]
