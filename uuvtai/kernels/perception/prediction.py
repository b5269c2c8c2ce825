"""Forecast: where every moving track will be from now to the horizon, and how surely. Sees tracks only, never
the truth."""

import math

import taichi as ti

from uuvtai.compile.launch import quick_launch
from uuvtai.config import ForecastConfig, TankConfig, TrackingConfig
from uuvtai.kernels.core.geometry import FAR_M, turned_z
from uuvtai.kernels.core.kalman import largest_position_variance
from uuvtai.kernels.core.simd import LANES, f16x
from uuvtai.kernels.core.stage import Bundle, Const, In, n_envs, shares
from uuvtai.kernels.perception.io import TrackingIO
from uuvtai.state import TrackState, TurnHistory

# ------------------------------------------------------------------------------------------------------------
# Turn history of moving obstacles, learnt within the episode: places where one turned, from which course to
# which. Sees tracks only.
#
# An obstacle on a line turns back at the same two ends, one on a loop turns at the same corners; who reaches
# a remembered turn on its course will turn there again. The memory belongs to the env, not to a track: an
# obstacle that was lost and found again, or one never seen to turn while it was tracked, is known by where it
# goes. Circles need no memory, their turn rate is in the filter.
#
# A turn is what lies between two straight legs of one track. Their ends p0, p1 [m], unit courses d0, d1 and
# the way L = speed x time between give the corner p0 + a d0 = p1 - b d1 by least squares along d0 - d1 under
# a + b = L: the speed is kept through a turn, which is what places a reversal, where both legs lie on one
# line.


TURN_X, TURN_Y, IN_X, IN_Y, OUT_X, OUT_Y, WEIGHT = range(7)
"""what is remembered of a turn: rows of ``TurnHistory.turn``"""

_STRAIGHT_SIGMA = 0.4
"""[rad/s] an obstacle is on a straight leg where its turn rate is known to this and less than its standard
deviation."""

_SETTLED = 0.05  # ... and where its velocity's variance is below this share of its square.

_TURNED_COS = 0.9  # Cosine of the change of course that makes a turn: 26 deg.

_ALIKE_COS = 0.94  # Cosine within which two courses are the same: 20 deg.

BEGIN_SEEN, CORNER_SEEN = 2, 3
"""``run_kind`` of a way that began with a turn that was seen: back, or a corner."""

_LONGEST_S = 4.0  # Two legs farther apart in time than this do not make one turn.

_MISFIT_M = 0.3  # Two legs whose lines and way do not meet within this had more than one turn between them.

_SAME_M = 0.4  # Turns closer than this, on the same courses, are one.

_MOST_WEIGHT = 4.0  # A remembered turn moves by at least a quarter of what is seen anew.

ACROSS_M, ACROSS_SLOPE = 0.25, 0.1
"""A course leads to a remembered turn that it passes within this, and within so much more per metre ahead
(EC)."""

OVERDUE_M, PASSED_M = 0.15, 0.5
"""A turn so far behind may still come, for the filter lags; one so far behind did not come (EC)."""

STRAIGHT_ODDS = 4.0
"""Prior odds that an obstacle goes straight: a turn rate is used where its evidence against 0 outweighs them
(EC)."""

MAX_GROWTH_M = 0.5
"""A forecast's radius grows no further: beyond, nothing would be free (EC)."""


@ti.func
def forget_turns(env, io: Bundle[TrackingIO]):
    io.turn_history.next_slot[env] = 0
    for packet in range(io.turn_history.turn.shape[2]):
        io.turn_history.turn[env, TURN_X, packet] = ti.zero(io.turn_history.turn[env, TURN_X, packet])
        io.turn_history.turn[env, TURN_Y, packet] = ti.zero(io.turn_history.turn[env, TURN_Y, packet])
        io.turn_history.turn[env, IN_X, packet] = ti.zero(io.turn_history.turn[env, IN_X, packet])
        io.turn_history.turn[env, IN_Y, packet] = ti.zero(io.turn_history.turn[env, IN_Y, packet])
        io.turn_history.turn[env, OUT_X, packet] = ti.zero(io.turn_history.turn[env, OUT_X, packet])
        io.turn_history.turn[env, OUT_Y, packet] = ti.zero(io.turn_history.turn[env, OUT_Y, packet])
        io.turn_history.turn[env, WEIGHT, packet] = ti.zero(io.turn_history.turn[env, WEIGHT, packet])
    for track in range(io.turn_history.leg_step.shape[1]):
        io.turn_history.leg[env, track] = ti.zero(io.turn_history.leg[env, track])
        io.turn_history.leg_step[env, track] = -1
        io.turn_history.run_from_w[env, track] = ti.Vector([0.0, 0.0])
        io.turn_history.run_kind[env, track] = 0


# ------------------------------------------------------------------------------------------------------ learn


@ti.func
def learn_turn(env, track, io: Bundle[TrackingIO]):
    """Where a track is on a straight leg: remember the turn since its last one, and forget a turn that it
    went past."""
    if io.tracks.alive[env, track] == 0 or io.tracks.age[env, track] == 0:
        io.turn_history.leg_step[env, track] = -1
        io.turn_history.run_kind[env, track] = 0
    elif (
        io.tracks.moving[env, track] == 1
        and io.tracks.misses[env, track] == 0
        and on_straight_leg(env, track, io)
    ):
        now, leg = io.tracks.state[env, track], io.turn_history.leg[env, track]
        time = (io.tracks.scan_step[env] - io.turn_history.leg_step[env, track]) * io.episode_cfg.control_dt_s
        begin, kind = io.turn_history.run_from_w[env, track], io.turn_history.run_kind[env, track]
        if kind == 0 or time >= _LONGEST_S:
            begin, kind = ti.Vector([now[0], now[1]]), 1
        if io.turn_history.leg_step[env, track] >= 0 and time < _LONGEST_S:
            speed, leg_speed = ti.sqrt(now[2] ** 2 + now[3] ** 2), ti.sqrt(leg[2] ** 2 + leg[3] ** 2)
            course = ti.Vector([now[2] / speed, now[3] / speed])
            leg_course = ti.Vector([leg[2] / leg_speed, leg[3] / leg_speed])
            if course.dot(leg_course) < _TURNED_COS:
                way = 0.5 * time * (speed + leg_speed)
                begin, kind = place_turn(
                    env, ti.Vector([leg[0], leg[1]]), leg_course, ti.Vector([now[0], now[1]]), course, way, io
                )
            else:
                drop_passed(env, ti.Vector([now[0], now[1]]), course, speed * time, io)
        io.turn_history.leg[env, track] = now
        io.turn_history.leg_step[env, track] = io.tracks.scan_step[env]
        io.turn_history.run_from_w[env, track], io.turn_history.run_kind[env, track] = begin, kind


@ti.func
def on_straight_leg(env, track, io: Bundle[TrackingIO]):
    """Whether course and speed are known well and the course does not turn."""
    mean, cov = io.tracks.state[env, track], io.tracks.cov[env, track]
    rate, rate_var = io.tracks.turn_rate[env, track], io.tracks.turn_cov[env, track][4]
    known = 0.0 < rate_var < ti.static(_STRAIGHT_SIGMA**2)
    return known and rate * rate <= rate_var and cov[7] + cov[9] < _SETTLED * (mean[2] ** 2 + mean[3] ** 2)


@ti.func
def place_turn(env, p0, d0, p1, d1, way, io: Bundle[TrackingIO]):
    """Remember the turn between two legs, unless they do not meet. Returns where the second leg began as far
    as is known, and its ``run_kind``."""
    # With a = (L + u) / 2 and b = (L - u) / 2 the legs' ends p0 + a d0 and p1 - b d1 differ by p0 - p1 + L
    # (d0 + d1) / 2 + u (d0 - d1) / 2; ``uneven`` is the u that makes this least.
    fold = d0 - d1
    uneven = 2.0 * (p1 - p0 - 0.5 * way * (d0 + d1)).dot(fold) / fold.norm_sqr()
    before, after = 0.5 * (way + uneven), 0.5 * (way - uneven)
    corner = p0 + before * d0
    misfit = (p1 - after * d1 - corner).norm()
    begin, kind = p1, 1
    if ti.min(before, after) > -_MISFIT_M and misfit < _MISFIT_M:
        begin, kind = 0.5 * (corner + p1 - after * d1), BEGIN_SEEN
        if d0.dot(d1) > -_ALIKE_COS:
            kind = CORNER_SEEN
        store_turn(env, begin, d0, d1, io)
    return begin, kind


@ti.func
def store_turn(env, pos, d0, d1, io: Bundle[TrackingIO]):
    """Average with the same turn seen before; else a new one in the place of the oldest."""
    turn, n_packet = ti.static(io.turn_history.turn, io.turn_history.turn.shape[2])
    slot, weight = io.turn_history.next_slot[env], 1.0
    known = 0
    for packet in range(n_packet):
        for lane in range(LANES):
            if known == 0 and turn[env, WEIGHT, packet][lane] > 0.0:
                off = ti.Vector([turn[env, TURN_X, packet][lane], turn[env, TURN_Y, packet][lane]]) - pos
                came = turn[env, IN_X, packet][lane] * d0[0] + turn[env, IN_Y, packet][lane] * d0[1]
                went = turn[env, OUT_X, packet][lane] * d1[0] + turn[env, OUT_Y, packet][lane] * d1[1]
                if came > _ALIKE_COS and went > _ALIKE_COS and off.norm_sqr() < ti.static(_SAME_M**2):
                    known, slot = 1, packet * LANES + lane
    packet, lane = slot // LANES, slot % LANES
    if known == 1:
        weight = ti.min(turn[env, WEIGHT, packet][lane] + 1.0, _MOST_WEIGHT)
    else:
        io.turn_history.next_slot[env] = (slot + 1) % ti.static(LANES * n_packet)
    keep, gain = 1.0 - 1.0 / weight, 1.0 / weight
    before = ti.Vector([turn[env, IN_X, packet][lane], turn[env, IN_Y, packet][lane]])
    d_in = (keep * known * before + gain * d0).normalized()
    after = ti.Vector([turn[env, OUT_X, packet][lane], turn[env, OUT_Y, packet][lane]])
    d_out = (keep * known * after + gain * d1).normalized()
    turn[env, TURN_X, packet][lane] = keep * turn[env, TURN_X, packet][lane] * known + gain * pos[0]
    turn[env, TURN_Y, packet][lane] = keep * turn[env, TURN_Y, packet][lane] * known + gain * pos[1]
    turn[env, IN_X, packet][lane], turn[env, IN_Y, packet][lane] = d_in[0], d_in[1]
    turn[env, OUT_X, packet][lane], turn[env, OUT_Y, packet][lane] = d_out[0], d_out[1]
    turn[env, WEIGHT, packet][lane] = weight


@ti.func
def drop_passed(env, pos, course, moved, io: Bundle[TrackingIO]):
    """An obstacle that was expected to turn and has gone straight on past the place, in the last ``moved``
    [m], takes one off its weight."""
    edge = ti.static(-PASSED_M)
    for packet in range(io.turn_history.turn.shape[2]):
        along, across = offsets(env, packet, pos, course, io.turn_history)
        for lane in ti.static(range(LANES)):
            behind = along[lane] < edge and along[lane] + moved >= edge
            if (
                behind
                and across[lane] < ti.static(0.5 * ACROSS_M)
                and io.turn_history.turn[env, WEIGHT, packet][lane] > 0.0
            ):
                io.turn_history.turn[env, WEIGHT, packet][lane] -= 1.0


# ----------------------------------------------------------------------------------------------------- recall


@ti.func
def offsets(env, packet, pos, course, turn_history: In[TurnHistory]):
    """Lanes: how far ahead along the course a remembered turn lies, and how far aside; FAR_M aside for those
    on another course."""
    turn = ti.static(turn_history.turn)
    dx, dy = turn[env, TURN_X, packet] - pos[0], turn[env, TURN_Y, packet] - pos[1]
    along = dx * course[0] + dy * course[1]
    aside = dx * course[1] - dy * course[0]
    alike = turn[env, IN_X, packet] * course[0] + turn[env, IN_Y, packet] * course[1]
    weight = turn_history.turn[env, WEIGHT, packet]
    across = f16x(FAR_M)
    for lane in ti.static(range(LANES)):
        across[lane] = ti.select(alike[lane] > _ALIKE_COS and weight[lane] > 0.0, ti.abs(aside[lane]), FAR_M)
    return along, across


@ti.func
def next_turn(env, pos, course, io: Bundle[TrackingIO]):
    """(distance [m] to the nearest remembered turn ahead, course after it); FAR_M = none."""
    gap, slot = FAR_M, 0
    for packet in range(io.turn_history.turn.shape[2]):
        along, across = offsets(env, packet, pos, course, io.turn_history)
        for lane in ti.static(range(LANES)):
            meets = across[lane] < ACROSS_M + ACROSS_SLOPE * along[lane] and along[lane] > -OVERDUE_M
            if meets and along[lane] < gap:
                gap, slot = along[lane], packet * LANES + lane
    out = course
    if gap < FAR_M:
        gap, packet, lane = ti.max(gap, 0.0), slot // LANES, slot % LANES
        turn = ti.static(io.turn_history.turn)
        out = ti.Vector([turn[env, OUT_X, packet][lane], turn[env, OUT_Y, packet][lane]])
    return gap, out


@ti.func
def wall_ahead(pos, course, radius, tank_cfg: Const[TankConfig]):
    """Distance [m] along the course at which an obstacle of that radius touches a side wall; it may be
    negative."""
    gap = FAR_M
    if ti.static(tank_cfg.shape == "circle"):
        off = pos - ti.Vector(
            [0.5 * (tank_cfg.x_m[0] + tank_cfg.x_m[1]), 0.5 * (tank_cfg.y_m[0] + tank_cfg.y_m[1])]
        )
        half = off.dot(course)
        gap = (
            ti.sqrt(ti.max(half * half + ti.max(tank_cfg.radius_m - radius, 0.0) ** 2 - off.norm_sqr(), 0.0))
            - half
        )
    else:
        for side in ti.static(range(2)):
            low, high = ti.static((tank_cfg.x_m, tank_cfg.y_m)[side])
            if ti.abs(course[side]) > 1e-6:
                edge = ti.select(course[side] > 0.0, high - radius, low + radius)
                gap = ti.min(gap, (edge - pos[side]) / course[side])
    return gap


@ti.func
def next_event(env, pos, course, radius, io: Bundle[TrackingIO]):
    """(distance [m] to the next turn on a straight course, course after it): a remembered one, or the wall if
    that comes first.

    At a wall obstacles are expected to turn back: right for lines, and nearer than a mirrored course to what
    loops do, whose next leg goes anywhere into the tank.
    """
    gap, out = FAR_M, course
    if ti.static(io.forecast_cfg.use_turn_history):
        gap, out = next_turn(env, pos, course, io)
    if ti.static(io.forecast_cfg.use_reflection):
        far = ti.max(wall_ahead(pos, course, radius, io.tank_cfg), 0.0)
        if far < gap:
            gap, out = far, -course
    return gap, out


@ti.func
def expected_turn_rate(
    env,
    track,
    tracks: In[TrackState],
    forecast_cfg: Const[ForecastConfig],
    tracking_cfg: Const[TrackingConfig],
):
    """[rad/s] the filter's turn rate, where that explains the track better than none: most obstacles go
    straight.

    Odds for a turn = density of rate 0 in the prior over that in the posterior (Savage-Dickey): an uncertain
    rate must stand out of its noise by little, a well known one by more, for a prior as wide as this one
    makes small rates unlikely.
    """
    rate = 0.0
    if ti.static(forecast_cfg.use_turn_rate and tracking_cfg.turn_rate_sigma_rad_s > 0):
        # prior N(0, S), posterior N(rate, s): odds = sqrt(s / S) exp(rate^2 / 2 s), so they exceed k where
        # rate^2 / s > ln(S / s) + 2 ln k
        known, var = tracks.turn_rate[env, track], tracks.turn_cov[env, track][4]
        bar = ti.log(ti.static(tracking_cfg.turn_rate_sigma_rad_s**2) / ti.max(var, 1e-9)) + ti.static(
            2.0 * math.log(STRAIGHT_ODDS)
        )
        if var > 0.0 and known * known > var * ti.max(bar, 0.0):
            rate = known
    return rate


@ti.func
def coasted(env, track, mean, time, io: Bundle[TrackingIO]):
    """Mean (x, y, vx, vy) of an unseen obstacle on a straight leg after ``time`` [s]: it turns where
    obstacles turn."""
    speed = ti.max(ti.sqrt(mean[2] ** 2 + mean[3] ** 2), 1e-6)
    course, way = ti.Vector([mean[2] / speed, mean[3] / speed]), speed * time
    gap, out = next_event(env, ti.Vector([mean[0], mean[1]]), course, io.tracks.radius_m[env, track], io)
    before = ti.min(gap, way)
    after = way - before
    late = course
    if after > 0.0:
        late = out
    x, y = mean[0] + before * course[0] + after * late[0], mean[1] + before * course[1] + after * late[1]
    return ti.Vector([x, y, speed * late[0], speed * late[1]])


# ------------------------------------------------------------------------------------------------------------


MOST_LEGS = 6
"""Turns within one forecast; beyond them an obstacle goes straight on."""


@quick_launch
@ti.kernel
def reset_forecast(io: Bundle[TrackingIO]):
    """Know no turn history and expect nothing in the active rows."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
            forget_turns(env, io)
            for track in range(io.forecast.radius_m.shape[1]):
                clear_forecast(env, track, io)
                io.forecast.turn_m[env, track] = FAR_M
                io.forecast.turn_out_w[env, track] = ti.Vector([0.0, 0.0])
                for k in range(io.forecast.pos_w.shape[2]):
                    io.forecast.pos_w[env, track, k] = ti.Vector([0.0, 0.0])


@quick_launch
@ti.kernel
def learn_turns(io: Bundle[TrackingIO]):
    """Watch how the tracks move, after each tracked scan."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1 and io.clusters.fresh[env] == 1:
            for track in range(io.tracks.alive.shape[1]):
                learn_turn(env, track, io)


@quick_launch
@ti.kernel
def forecast_tracks(io: Bundle[TrackingIO]):
    """From now to the horizon, for the moving tracks of the active rows; the others get a negative radius.

    The radius grows by ``growth_sigmas`` standard deviations of the predicted position along its worst axis,
    as the filter knows it today: turns to come are not in it (the planner's own growing margin is for them).
    At most ``MAX_GROWTH_M``.
    """
    n_track = ti.static(io.tracks.alive.shape[1])
    n_share = ti.static(shares(n_track))
    for env, share in ti.ndrange(n_envs(io.clock), n_share):
        if io.clock.active[env] == 1:
            # only a tracked scan or an image changes tracks and turn history
            changed = io.clusters.fresh[env] + io.image.fresh[env] > 0
            for track in range(share * n_track // n_share, (share + 1) * n_track // n_share):
                if io.tracks.alive[env, track] * io.tracks.moving[env, track] == 1:
                    if expected_turn_rate(env, track, io.tracks, io.forecast_cfg, io.tracking_cfg) != 0.0:
                        follow_arc(env, track, io)
                    else:
                        follow_legs(env, track, changed, io)
                elif io.forecast.radius_m[env, track, 0] >= 0:
                    clear_forecast(env, track, io)


@ti.func
def clear_forecast(env, track, io: Bundle[TrackingIO]):
    for k in range(io.forecast.radius_m.shape[2]):
        io.forecast.radius_m[env, track, k] = -1.0


@ti.func
def follow_arc(env, track, io: Bundle[TrackingIO]):
    """Constant speed and turn rate: steps along the chords of the arc."""
    mean, cov = io.tracks.state[env, track], io.tracks.cov[env, track]
    late = (io.clock.step[env] - io.tracks.scan_step[env]) * io.episode_cfg.control_dt_s
    rate = expected_turn_rate(env, track, io.tracks, io.forecast_cfg, io.tracking_cfg)
    vel = ti.Vector([mean[2], mean[3]])
    pos = ti.Vector([mean[0], mean[1]]) + late * chord(rate * late) * turned_z(vel, 0.5 * rate * late)
    vel = turned_z(vel, rate * late)
    step = ti.static(io.tracking_cfg.forecast_dt_s) * chord(rate * io.tracking_cfg.forecast_dt_s)
    for k in range(io.forecast.radius_m.shape[2]):
        ahead = late + k * io.tracking_cfg.forecast_dt_s
        growth = io.tracking_cfg.growth_sigmas * ti.sqrt(largest_position_variance(cov, ahead))
        io.forecast.pos_w[env, track, k] = pos
        io.forecast.radius_m[env, track, k] = io.tracks.radius_m[env, track] + ti.min(growth, MAX_GROWTH_M)
        pos += step * turned_z(vel, 0.5 * rate * io.tracking_cfg.forecast_dt_s)
        vel = turned_z(vel, rate * io.tracking_cfg.forecast_dt_s)


@ti.func
def follow_legs(env, track, changed, io: Bundle[TrackingIO]):
    """Constant speed on straight legs, from turn to turn; the search for the first turn is kept until
    something has ``changed``."""
    mean, cov, radius = io.tracks.state[env, track], io.tracks.cov[env, track], io.tracks.radius_m[env, track]
    pos, speed = ti.Vector([mean[0], mean[1]]), ti.max(ti.sqrt(mean[2] * mean[2] + mean[3] * mean[3]), 1e-6)
    course = ti.Vector([mean[2], mean[3]]) / speed
    gap, out = io.forecast.turn_m[env, track], io.forecast.turn_out_w[env, track]
    if changed:
        gap, out = next_event(env, pos, course, radius, io)
        io.forecast.turn_m[env, track] = gap
        io.forecast.turn_out_w[env, track] = out
    legs = 0
    ahead = (io.clock.step[env] - io.tracks.scan_step[env]) * io.episode_cfg.control_dt_s
    way = speed * ahead
    for k in range(io.forecast.radius_m.shape[2]):
        while way > gap and legs < MOST_LEGS:
            pos += gap * course
            way -= gap
            course = out
            gap, out = next_event(env, pos, course, radius, io)
            legs += 1
        pos += way * course
        gap -= way
        growth = io.tracking_cfg.growth_sigmas * ti.sqrt(largest_position_variance(cov, ahead))
        io.forecast.pos_w[env, track, k] = pos
        io.forecast.radius_m[env, track, k] = radius + ti.min(growth, MAX_GROWTH_M)
        way = speed * io.tracking_cfg.forecast_dt_s
        ahead += io.tracking_cfg.forecast_dt_s


@ti.func
def chord(angle):
    """Length of the chord over that of its arc of less than a turn: sin(a / 2) / (a / 2), by its series."""
    square = 0.25 * angle * angle
    return 1.0 - square / 6.0 * (1.0 - square / 20.0)
