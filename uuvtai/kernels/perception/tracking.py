"""Tracking: from clusters of beams to tracks of moving obstacles. Sees sensor data and its own memory only.

One scan: label beams - find clusters - predict - associate - update - prune - spawn - name beams. One Kalman
filter per track on position and mean Doppler; all states refer to the ping of the newest tracked scan
(``scan_step``). Static obstacles get tracks too, which must never be called moving: motion needs a speed and,
as evidence, Doppler averaged over beams and time or a displacement seen between unhidden edges.
"""

import math

import taichi as ti

from uuvtai.compile.launch import quick_launch, with_cse
from uuvtai.kernels.core.beams import beam_bearing, beam_there, beam_towards
from uuvtai.kernels.core.geometry import FAR_M, wrapped_angle
from uuvtai.kernels.core.kalman import born, predicted
from uuvtai.kernels.core.simd import f16x
from uuvtai.kernels.core.stage import Bundle, Out, n_envs
from uuvtai.kernels.perception.clustering import (
    HELD_SIGMA_M_S,
    SPLIT_DOPPLER_M_S,
    find_clusters,
    label_beams,
    split_distance,
)
from uuvtai.kernels.perception.height import begin_height, weigh_seen, weigh_unseen
from uuvtai.kernels.perception.io import TrackingIO
from uuvtai.kernels.perception.prediction import coasted, expected_turn_rate
from uuvtai.kernels.perception.track_filter import (
    CONFIRMED,
    DOPPLER_SIGMAS,
    MOVING_DOPPLER_M_S,
    bearing_vector,
    centre_sight,
    centre_variances,
    pair_surprise,
    radius_variance,
    turn_back_rate,
    turned_back,
    update_tracks,
)
from uuvtai.state import TrackState

# ------------------------------------------------------------------------------------------------------------
# Which slot holds which obstacle: lost tracks end, new ones begin, beams get the names of their tracks (part
# of the tracking stage).


SEEN_THROUGH = 1
BLOCKED = 2

SIGHT_DOPPLER_M_S = 0.2
_SIGHT_SIGMAS = 6.0
_SIGHT_BEAMS = 3
"""What is moving at first sight: a mean Doppler of so much, and so many standard deviations, over so many
beams (EC)."""

GONE_SHARE = 0.25
"""Below this probability of being where it is expected, an obstacle is forgotten (EC)."""

_MISS_S = 0.1
"""One "miss" of the config: a nominal 10 Hz scan."""

_SPOTTED_S = 0.3
"""[s] an obstacle that the camera showed this lately is there, though beams pass above or below it."""

_PEEKING_RADIUS_M = 0.2
"""Least radius given to an obstacle first seen past something nearer: half the size of the design's typical
body."""


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


# ------------------------------------------------------------------------------------------------------ prune


@ti.func
def prune_tracks(env, dt, io: Bundle[TrackingIO]):
    """Weigh how high moving obstacles may be, and end unmatched tracks that are not where they are expected,
    or doubled a matched one."""
    for track in range(io.tracks.alive.shape[1]):
        if io.tracks.alive[env, track] == 1:
            remembered = ti.static(io.height_cfg.memory_s > 0) and io.tracks.moving[env, track] == 1
            if io.tracks.misses[env, track] == 0:
                if remembered:
                    weigh_seen(env, track, io.scan.ping_pos_w[env], io)
            elif is_double(env, track, io):
                clear_track(env, track, io.tracks)
            else:
                sight = sight_of(env, track, io)
                gone = 0
                if remembered:
                    gone = is_forgotten(env, track, sight, dt, io)
                else:
                    gone = is_lost(env, track, sight, io)
                if gone == 1:
                    clear_track(env, track, io.tracks)


@ti.func
def is_forgotten(env, track, sight, dt, io: Bundle[TrackingIO]):
    """1 where a moving obstacle is hardly where it is expected any more: seen through within the fan, or
    unseen for long."""
    if sight == SEEN_THROUGH:
        weigh_unseen(env, track, io.scan.ping_pos_w[env], dt, io)
    io.tracks.present[env, track] *= ti.exp(-dt * ti.static(1.0 / max(io.height_cfg.memory_s, 1e-3)))
    return ti.cast(io.tracks.present[env, track] < GONE_SHARE, ti.i32)


@ti.func
def is_lost(env, track, sight, io: Bundle[TrackingIO]):
    """1 where an unmatched track is seen through, or was unseen for too long (longer where hidden)."""
    unseen = (io.scan.ping_step[env] - io.tracks.seen_step[env, track]) * io.episode_cfg.control_dt_s
    longest = ti.select(
        sight == BLOCKED,
        ti.static(io.tracking_cfg.hidden_s + 2.0 * io.sonar_cfg.sweep_s),
        ti.static(io.tracking_cfg.max_misses * _MISS_S + 2.0 * io.sonar_cfg.sweep_s),
    )
    if io.tracks.spot_step[env, track] >= 0:  # the camera shows it
        unseen = ti.min(
            unseen, (io.scan.ping_step[env] - io.tracks.spot_step[env, track]) * io.episode_cfg.control_dt_s
        )
    spotted = io.tracks.spot_step[env, track] >= 0 and unseen < _SPOTTED_S
    through = (
        sight == SEEN_THROUGH
        and not spotted
        and (io.tracks.age[env, track] < CONFIRMED or unseen >= io.tracking_cfg.see_through_s)
    )
    if ti.static(io.sonar_cfg.mechanical):  # where it has gone to may be looked at only later in the sweep
        through = False
    return ti.cast(through or unseen > longest, ti.i32)


@ti.func
def sight_of(env, track, io: Bundle[TrackingIO]):
    """What most beams through the middle of the predicted body say: SEEN_THROUGH, BLOCKED by something
    nearer or because no beam looks there, or 0 = neither."""
    step = ti.static(io.sonar_cfg.beam_step_rad)
    own, mean, radius = io.scan.ping_pos_w[env], io.tracks.state[env, track], io.tracks.radius_m[env, track]
    dx, dy = mean[0] - own[0], mean[1] - own[1]
    distance = ti.sqrt(dx * dx + dy * dy)
    middle = beam_towards(ti.atan2(dy, dx) - io.scan.ping_yaw[env], io.sonar_cfg)
    half = ti.cast(0.5 * radius / (ti.max(distance, radius) * step), ti.i32)
    slack = radius + split_distance(distance, io)
    through, before = 0, 0
    for k in range(-half, half + 1):
        ray = beam_there(middle + k, io.sonar_cfg)
        looks = True
        if ti.static(io.sonar_cfg.mechanical):
            looks = looks_now(env, track, ti.max(ray, 0), 2 * half + 2, io)
        if ti.static(not io.sonar_cfg.is_ring) and ray < 0:
            before += 1
        elif not looks:
            before += 1
        else:
            past = io.scan.hit[env, ray] == 0 or io.scan.range_m[env, ray] > distance + slack
            through += ti.cast(past, ti.i32)
            before += ti.cast(
                io.scan.hit[env, ray] == 1 and io.scan.range_m[env, ray] < distance - slack, ti.i32
            )
    return ti.select(
        2 * through > 2 * half + 1, SEEN_THROUGH, ti.select(2 * before > 2 * half + 1, BLOCKED, 0)
    )


@ti.func
def looks_now(env, track, ray, beams, io: Bundle[TrackingIO]):
    """Whether a mechanical beam looked there after it saw the track, no longer ago than it takes for so many
    beams and one tracked scan."""
    then = io.echoes.step[env, ray]
    ago = (io.scan.ping_step[env] - then) * io.episode_cfg.control_dt_s
    lately = beams * ti.static(io.sonar_cfg.step_us / 1e6) + ti.static(
        (io.tracking_cfg.period_steps + 1) * io.episode_cfg.control_dt_s
    )
    return then > io.tracks.seen_step[env, track] and ago <= lately


@ti.func
def is_double(env, track, io: Bundle[TrackingIO]):
    """Whether a matched track sits where this unmatched one is expected."""
    out = False
    here = io.tracks.state[env, track]
    for other in range(io.tracks.alive.shape[1]):
        if io.tracks.alive[env, other] == 1 and io.tracks.misses[env, other] == 0:
            there = io.tracks.state[env, other]
            apart = 0.5 * (io.tracks.radius_m[env, track] + io.tracks.radius_m[env, other])
            out = out or (here[0] - there[0]) ** 2 + (here[1] - there[1]) ** 2 < apart * apart
    return out


# ------------------------------------------------------------------------------------------------------ spawn


@ti.func
def spawn_tracks(env, io: Bundle[TrackingIO]):
    """Begin a track for every unmatched cluster, unless it is a splinter of an obstacle that is tracked
    already."""
    for c in range(io.clusters.count[env]):
        if io.clusters.match[env, c] < 0:
            owner = owner_of(env, c, io)
            if owner < 0:
                owner = free_slot(env, c, io)
                if owner >= 0:
                    begin_track(env, owner, c, io)
            io.clusters.match[env, c] = owner


@ti.func
def owner_of(env, c, io: Bundle[TrackingIO]):
    """A track seen in this scan whose outline and Doppler cover this cluster, -1 = none."""
    out = -1
    here = io.clusters.pos_w[env, c]
    for track in range(io.tracks.alive.shape[1]):
        if io.tracks.alive[env, track] == 1 and io.tracks.misses[env, track] == 0:
            there, reach = (
                io.tracks.state[env, track],
                io.tracks.radius_m[env, track] + io.tracking_cfg.min_radius_m,
            )
            close = (here[0] - there[0]) ** 2 + (here[1] - there[1]) ** 2 < reach * reach
            swing = ti.abs(io.clusters.doppler_m_s[env, c] - io.tracks.doppler_m_s[env, track])
            if close and swing < ti.static(SPLIT_DOPPLER_M_S + 3 * io.sonar_cfg.doppler_sigma_m_s):
                out = track
    return out


@ti.func
def free_slot(env, c, io: Bundle[TrackingIO]):
    """A dead slot; else that of the least useful static track: lost ones first, then the farthest if it is
    farther than the newcomer.

    A newcomer with clear Doppler displaces any static track. -1 = none.
    """
    own = io.scan.ping_pos_w[env]
    moves = ti.abs(io.clusters.doppler_m_s[env, c]) > ti.max(
        MOVING_DOPPLER_M_S, DOPPLER_SIGMAS * ti.sqrt(io.clusters.doppler_var[env, c])
    )
    out = -1
    worst = ti.select(moves, -1.0, io.clusters.range_m[env, c] + io.clusters.radius_m[env, c])
    for track in range(io.tracks.alive.shape[1]):
        mean = io.tracks.state[env, track]
        away = ti.sqrt((mean[0] - own[0]) ** 2 + (mean[1] - own[1]) ** 2)
        score = away + 100.0 * io.tracks.misses[env, track]
        if io.tracks.alive[env, track] == 0:
            score = FAR_M
        if score > worst and io.tracks.moving[env, track] == 0:
            out, worst = track, score
    return out


@ti.func
def begin_track(env, track, c, io: Bundle[TrackingIO]):
    """A new track from one cluster: velocity along the bearing from the Doppler where it is measured, unknown
    across. Displaces whoever had the slot."""
    if io.tracks.alive[env, track] == 1 and io.tracks.pick[env, track] >= 0:
        io.clusters.match[env, io.tracks.pick[env, track]] = -1
    clear_track(env, track, io.tracks)
    radius, radius_var = io.clusters.radius_m[env, c], radius_variance(env, c, io)
    if io.clusters.hidden[env, c] > 0:
        radius, radius_var = ti.max(radius, _PEEKING_RADIUS_M), ti.static(io.tracking_cfg.min_radius_m**2)
    bearing, distance, _ = centre_sight(env, c, radius, io)
    along, own = bearing_vector(bearing), io.scan.ping_pos_w[env]
    centre = ti.Vector([own[0], own[1]]) + distance * along
    radial_var, cross_var = centre_variances(env, c, radius, radius_var, io)
    cross_speed_var = ti.static(io.tracking_cfg.birth_speed_sigma_m_s**2)
    mean, cov = born(
        centre,
        along,
        radial_var,
        cross_var,
        io.clusters.doppler_m_s[env, c],
        io.clusters.doppler_var[env, c] if ti.static(io.sonar_cfg.doppler) else cross_speed_var,
        cross_speed_var,
    )
    io.tracks.alive[env, track] = 1
    io.tracks.state[env, track] = mean
    io.tracks.cov[env, track] = cov
    io.tracks.z_m[env, track] = own[2]
    io.tracks.radius_m[env, track] = radius
    io.tracks.radius_var[env, track] = radius_var
    io.tracks.sight_w[env, track] = io.clusters.bearing_w[env, c]
    io.tracks.doppler_m_s[env, track] = io.clusters.doppler_m_s[env, c]
    io.tracks.doppler_var[env, track] = io.clusters.doppler_var[env, c]
    io.tracks.seen_step[env, track] = io.scan.ping_step[env]
    begin_height(env, track, io.tracks, io.height_cfg)
    io.tracks.moving[env, track] = moves_at_sight(env, c, io)


@ti.func
def moves_at_sight(env, c, io: Bundle[TrackingIO]):
    """1 where the first scan's Doppler alone shows motion: for this, several beams must agree, and it must be
    far beyond what noise and the own velocity's error can feign."""
    bar = ti.max(SIGHT_DOPPLER_M_S, _SIGHT_SIGMAS * ti.sqrt(io.clusters.doppler_var[env, c]))
    several = io.clusters.n_beam[env, c] >= _SIGHT_BEAMS
    return ti.cast(several and ti.abs(io.clusters.doppler_m_s[env, c]) > bar, ti.i32)


@ti.func
def name_beams(env, io: Bundle[TrackingIO]):
    """Write into every beam of a tracked scan which track it hit."""
    for ray in range(io.tracks.beam_track.shape[1]):
        c = io.clusters.beam_cluster[env, ray]
        io.tracks.beam_track[env, ray] = -1
        if c >= 0:
            io.tracks.beam_track[env, ray] = io.clusters.match[env, c]
    if ti.static(io.sonar_cfg.mechanical):
        name_by_place(env, io)


@ti.func
def name_by_place(env, io: Bundle[TrackingIO]):
    """Name the returns of a mechanical beam after the moving track that is expected there: only few of a
    body's beams are ever of one scan."""
    own = io.scan.ping_pos_w[env]
    for ray in range(io.sonar_cfg.n_ray):
        name = -1
        if io.scan.hit[env, ray] == 1:
            range_m = io.scan.range_m[env, ray]
            bearing = io.scan.ping_yaw[env] + beam_bearing(ray, io.sonar_cfg)
            x, y = own[0] + range_m * ti.cos(bearing), own[1] + range_m * ti.sin(bearing)
            name = mover_at(env, x, y, split_distance(range_m, io), io)
        io.tracks.beam_track[env, ray] = name


@ti.func
def mover_at(env, x, y, slack, io: Bundle[TrackingIO]):
    """The moving track whose outline is expected nearest to a point, within ``slack`` [m]; -1 = none."""
    late = (io.scan.ping_step[env] - io.tracks.scan_step[env]) * io.episode_cfg.control_dt_s
    name, nearest = -1, slack
    for track in range(io.tracks.alive.shape[1]):
        if io.tracks.alive[env, track] == 1 and io.tracks.moving[env, track] == 1:
            mean = io.tracks.state[env, track]
            off = ti.Vector([x - mean[0] - late * mean[2], y - mean[1] - late * mean[3]])
            gap = off.norm() - io.tracks.radius_m[env, track]
            if gap < nearest:
                name, nearest = track, gap
    return name


@ti.func
def carry_names(env, io: Bundle[TrackingIO]):
    """Name the beams of a scan that is not tracked after the last one that was: same bearing, and a range at
    which that obstacle can be."""
    if ti.static(io.sonar_cfg.mechanical):
        name_by_place(env, io)
    else:
        carry_over(env, io)


@ti.func
def carry_over(env, io: Bundle[TrackingIO]):
    """The names of beams that all come at once."""
    step = ti.static(io.sonar_cfg.beam_step_rad)
    shift = ti.cast(
        ti.floor(wrapped_angle(io.scan.ping_yaw[env] - io.clusters.scan_yaw[env]) / step + 0.5), ti.i32
    )
    for ray in range(io.sonar_cfg.n_ray):
        then = beam_there(ray + shift, io.sonar_cfg)
        c = io.clusters.beam_cluster[env, ti.max(then, 0)]
        if then < 0:
            c = -1
        name = -1
        if c >= 0 and io.scan.hit[env, ray] == 1:
            range_m = io.scan.range_m[env, ray]
            if ti.abs(range_m - io.clusters.range_m[env, c]) < io.clusters.radius_m[env, c] + split_distance(
                range_m, io
            ):
                name = io.clusters.match[env, c]
        io.tracks.beam_track[env, ray] = name


# ------------------------------------------------------------------------------------------------------------
# Which cluster of a scan is which track's body (part of the tracking stage).


_REACH_M = 2.0  # No match is looked for beyond this; saves the arithmetic.


@ti.func
def associate(env, dt, io: Bundle[TrackingIO]):
    """Pair tracks and clusters, cheapest pair first.

    Each track asks for its cheapest cluster; a cluster keeps the cheapest of the tracks that ask, and who is
    turned away asks for its next. With a cost both sides agree on, that ends in the pairs of the greedy rule,
    without sorting (Gale and Shapley).
    """
    for track in range(io.tracks.alive.shape[1]):
        io.tracks.pick_cost[env, track] = -FAR_M
        asking = ti.select(io.tracks.alive[env, track] == 1, track, -1)
        while asking >= 0:
            propose_next(env, asking, dt, io)
            wanted = io.tracks.pick[env, asking]
            if wanted < 0:
                asking = -1
            else:
                holder = io.clusters.match[env, wanted]
                if holder < 0 or io.tracks.pick_cost[env, asking] < io.tracks.pick_cost[env, holder]:
                    io.clusters.match[env, wanted] = asking
                    asking = holder


@ti.func
def propose_next(env, track, dt, io: Bundle[TrackingIO]):
    """Set ``pick`` to the cheapest cluster that costs more than the last one asked for, -1 = none."""
    best, best_cost = -1, FAR_M
    for c in range(io.clusters.count[env]):
        cost = pair_cost(env, track, c, dt, io)
        if cost > io.tracks.pick_cost[env, track] and cost < best_cost:
            best, best_cost = c, cost
    io.tracks.pick[env, track] = best
    io.tracks.pick_cost[env, track] = best_cost


@ti.func
def pair_cost(env, track, c, dt, io: Bundle[TrackingIO]):
    """-2 log likelihood (up to a constant) of the cluster being this track's body; FAR_M outside the gate."""
    cost = FAR_M
    mean = io.tracks.state[env, track]
    offset = io.clusters.pos_w[env, c] - ti.Vector([mean[0], mean[1]])
    square = offset.dot(offset)
    if square < _REACH_M * _REACH_M:
        surprise, volume, near = pair_surprise(env, track, c, offset, io)
        free = io.tracking_cfg.gate_m + dt * ti.sqrt(mean[2] * mean[2] + mean[3] * mean[3])
        within = near < io.tracking_cfg.turn_gate or square < free * free
        if ti.static(io.sonar_cfg.mechanical):
            within = within and square < swept_reach(env, track, io) ** 2
        if within:
            cost = surprise + ti.log(volume)
    return cost


@ti.func
def swept_reach(env, track, io: Bundle[TrackingIO]):
    """[m] from where it is expected to where a track may be found by a mechanical beam: as far as obstacles
    get since it was seen, if the beam has looked there since; else it may still be there, and what is found
    elsewhere is another obstacle."""
    own, mean = io.scan.ping_pos_w[env], io.tracks.state[env, track]
    bearing = ti.atan2(mean[1] - own[1], mean[0] - own[0]) - io.scan.ping_yaw[env]
    beam = beam_there(beam_towards(bearing, io.sonar_cfg), io.sonar_cfg)
    then = io.tracks.seen_step[env, track]
    reach = io.tracking_cfg.gate_m + io.tracks.radius_m[env, track]
    if beam >= 0 and io.echoes.step[env, ti.max(beam, 0)] > then:
        since = (io.scan.ping_step[env] - then) * io.episode_cfg.control_dt_s
        reach += io.tracking_cfg.birth_speed_sigma_m_s * since
    return reach


# ------------------------------------------------------------------------------------------------------------


@quick_launch
@ti.kernel
def reset_tracks(io: Bundle[TrackingIO]):
    """Forget everything about the active rows."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
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


def track_obstacles(io: TrackingIO) -> None:
    """Bring the tracks of the active rows to the newest scan, where one has come and the last tracked one is
    ``period_steps`` old.

    Four kernels, launched in turn: as one they compile three times as long, for the compiler's time grows
    faster than a kernel's size.
    """
    take_scan(io)
    cluster_beams(io)
    follow_obstacles(io)
    keep_slots(io)


@quick_launch
@with_cse()
@ti.kernel
def take_scan(io: Bundle[TrackingIO]):
    """See whether a scan is due, and which of its beams may have hit a obstacle."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
            io.clusters.fresh[env] = is_due(env, io)
            if io.clusters.fresh[env] == 1:
                io.clusters.scan_step[env] = io.scan.ping_step[env]
                io.clusters.scan_yaw[env] = io.scan.ping_yaw[env]
                label_beams(env, io)


@quick_launch
@ti.kernel
def cluster_beams(io: Bundle[TrackingIO]):
    """Gather the beams into clusters."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1 and io.clusters.fresh[env] == 1:
            find_clusters(env, io)


@quick_launch
@ti.kernel
def follow_obstacles(io: Bundle[TrackingIO]):
    """Predict the tracks to the new ping, match them with clusters and correct them."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1 and io.clusters.fresh[env] == 1:
            dt = predict_tracks(env, io)
            associate(env, dt, io)
            update_tracks(env, dt, io)


@quick_launch
@ti.kernel
def keep_slots(io: Bundle[TrackingIO]):
    """End lost tracks, begin new ones, and name the beams."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1 and io.clusters.fresh[env] == 1:
            prune_tracks(env, ti.static(tracked_period_s(io.tracking_cfg, io.sonar_cfg, io.episode_cfg)), io)
            spawn_tracks(env, io)
            name_beams(env, io)
        if io.clock.active[env] == 1 and io.clusters.fresh[env] == 0 and io.scan.fresh[env] == 1:
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
    along its turn history or turn back."""
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
            mean = coasted(env, track, io.tracks.state[env, track], dt, io)
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
