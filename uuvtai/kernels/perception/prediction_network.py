"""Learned forecast: a mixture density network (Bishop 1994, NCRG/94/004) says what each moving track may do,
and how probable that is. It sees the columns of ``motion_columns`` and nothing else.

It says the logits of ``N_MODE`` futures, then each one's places at ``ANCHORS`` times ``ANCHOR_S`` apart, in
the track's frame and in parts of the way that it can go till then. Between them obstacles go straight, never
faster than of late. The trained network says spreads too; they are not needed here.
"""

import taichi as ti

from uuvtai.common.enums import (
    AHEAD_STEPS,
    ANCHOR_S,
    ANCHORS,
    FAR,
    LAST,
    LENGTH_M,
    MIDDLE,
    N_AHEAD,
    N_BEND,
    N_COLUMN,
    N_FRAME,
    N_HIDDEN,
    N_MODE,
    N_MOTION,
    N_PAST,
    N_SAID,
    PAST_S,
)
from uuvtai.compile.launch import quick_launch
from uuvtai.kernels.core.geometry import FAR_M
from uuvtai.kernels.core.simd import LANES
from uuvtai.kernels.core.stage import Bundle, loop_end
from uuvtai.kernels.perception.io import TrackingIO
from uuvtai.kernels.perception.prediction import IN_X, IN_Y, OUT_X, OUT_Y, WEIGHT, next_turn, wall_ahead


@quick_launch
@ti.kernel
def mix_futures(io: Bundle[TrackingIO]):
    """In decision steps: the likeliest future of every track that has a forecast becomes its forecast, the
    others are its futures, with their probabilities."""
    n, n_track = ti.static(io.clock.active.shape[0], io.forecast.radius_m.shape[1])
    for env, track in ti.ndrange(loop_end(n, io.clock), n_track):
        due = io.clock.step[env] % ti.static(io.behavior_cfg.decide_period_steps) == 0
        if due and io.clock.active[env] == 1:
            if io.forecast.radius_m[env, track, 0] >= 0:
                _think(env, track, io)
                _tell(env, track, io)
            else:
                for future in ti.static(range(N_MODE)):
                    io.futures.share[env, track, future] = 0.0


@ti.func
def _think(env, track, io: Bundle[TrackingIO]):
    """Columns to what the network says: two hidden layers of rectified units."""
    n_packet = ti.static(N_HIDDEN // LANES)
    for packet in range(n_packet):
        total = io.mixture.weight[packet]
        for i in range(N_COLUMN):
            total += io.mixture.column[env, track, i] * io.mixture.weight[(i + 1) * n_packet + packet]
        for lane in ti.static(range(LANES)):
            io.mixture.hidden[env, track, packet * LANES + lane] = ti.max(total[lane], 0.0)
    middle = ti.static(MIDDLE // LANES)
    for packet in range(n_packet):
        total = io.mixture.weight[middle + packet]
        for i in range(N_HIDDEN):
            total += (
                io.mixture.hidden[env, track, i] * io.mixture.weight[middle + (i + 1) * n_packet + packet]
            )
        for lane in ti.static(range(LANES)):
            io.mixture.hidden[env, track, N_HIDDEN + packet * LANES + lane] = ti.max(total[lane], 0.0)
    last, n_said = ti.static(LAST // LANES, N_SAID // LANES)
    for packet in range(n_said):
        total = io.mixture.weight[last + packet]
        for i in range(N_HIDDEN):
            total += (
                io.mixture.hidden[env, track, N_HIDDEN + i]
                * io.mixture.weight[last + (i + 1) * n_said + packet]
            )
        for lane in ti.static(range(LANES)):
            io.mixture.said[env, track, packet * LANES + lane] = total[lane]


@ti.func
def _tell(env, track, io: Bundle[TrackingIO]):
    """What was said as probabilities and places in the world."""
    most, total, likeliest = io.mixture.said[env, track, 0], 0.0, 0
    for future in range(1, N_MODE):
        if io.mixture.said[env, track, future] > most:
            most, likeliest = io.mixture.said[env, track, future], future
    for future in range(N_MODE):
        total += ti.exp(io.mixture.said[env, track, future] - most)
    place = ti.Vector([io.mixture.frame[env, track, 0], io.mixture.frame[env, track, 1]])
    along, aside = io.mixture.frame[env, track, 2], io.mixture.frame[env, track, 3]
    speed = io.mixture.frame[env, track, 4]
    dt = ti.static(io.tracking_cfg.forecast_dt_s)
    for future in range(N_MODE):
        io.futures.share[env, track, future] = ti.exp(io.mixture.said[env, track, future] - most) / total
        there = place
        for k in range(io.futures.pos_w.shape[3]):
            if k > 0:
                way = _place_at(env, track, future, k * dt, io) * speed
                wanted = place + ti.Vector([along * way[0] - aside * way[1], aside * way[0] + along * way[1]])
                step = wanted - there
                there += step * ti.min(1.0, speed * dt / ti.max(ti.math.length(step), 1.0e-6))
            io.futures.pos_w[env, track, future, k] = there
            if future == likeliest:
                io.forecast.pos_w[env, track, k] = there
    io.futures.share[env, track, likeliest] = 0.0


@ti.func
def _place_at(env, track, future, ahead_s, io: Bundle[TrackingIO]):
    """Where a future is after a time, in the track's frame and per speed [s]: between two anchors, or on from
    the last two."""
    after = ti.math.clamp(ti.cast(ti.ceil(ahead_s * ti.static(1.0 / ANCHOR_S) - 1.0e-4), ti.i32), 1, ANCHORS)
    share = ahead_s * ti.static(1.0 / ANCHOR_S) - (after - 1)
    first = N_MODE + future * ti.static(2 * ANCHORS) + 2 * (after - 1)
    late = ti.Vector([io.mixture.said[env, track, first + i] for i in range(2)]) * (after * ANCHOR_S)
    early = ti.Vector([0.0, 0.0])
    if after > 1:
        early = ti.Vector([io.mixture.said[env, track, first - 2 + i] for i in range(2)])
        early *= (after - 1) * ANCHOR_S
    return early + share * (late - early)


# ------------------------------------------------------------------------------------------------------------
# What a learned forecast is told of each track: how it moves now, where it was, where it turned, what lies
# ahead. Sees tracks only.
#
# Places are counted in a frame of the track: its place now, x along its course, y to the left. Lengths are
# divided by ``LENGTH_M`` and cut off at ``FAR`` of it, so that every column is about 1 at the most.


_SLOWEST_M_S = 0.1
_NEW_BEND_M = 0.3  # a turn this far from the newest one is another
_FAST_LEGS = 3  # of the legs between remembered places: over so many a speed is measured
_BACK_COS = -0.9  # cosine of the change of course that makes a turn back


@quick_launch
@ti.kernel
def reset_past(io: Bundle[TrackingIO]):
    """Remember nothing in the active rows."""
    n, n_track = ti.static(io.clock.active.shape[0], io.tracks.alive.shape[1])
    for env, track in ti.ndrange(loop_end(n, io.clock), n_track):
        if io.clock.active[env] == 1:
            _forget(env, track, io)
            for i in range(io.mixture.frame.shape[2]):
                io.mixture.frame[env, track, i] = 0.0
            for i in range(io.mixture.column.shape[2]):
                io.mixture.column[env, track, i] = 0.0
            for i in range(io.mixture.said.shape[2]):
                io.mixture.said[env, track, i] = 0.0


@quick_launch
@ti.kernel
def remember_past(io: Bundle[TrackingIO]):
    """After each tracked scan: where the tracks are, and where they turned. A new track remembers nothing."""
    n, n_track = ti.static(io.clock.active.shape[0], io.tracks.alive.shape[1])
    for env, track in ti.ndrange(loop_end(n, io.clock), n_track):
        if io.clock.active[env] == 1 and io.clusters.fresh[env] == 1:
            if io.tracks.alive[env, track] == 0 or io.tracks.age[env, track] == 0:
                _forget(env, track, io)
            if io.tracks.alive[env, track] * io.tracks.moving[env, track] == 1:
                _remember(env, track, io)


@quick_launch
@ti.kernel
def describe_motion(io: Bundle[TrackingIO]):
    """In decision steps: the columns of every track that has a forecast."""
    n, n_track = ti.static(io.clock.active.shape[0], io.tracks.alive.shape[1])
    for env, track in ti.ndrange(loop_end(n, io.clock), n_track):
        due = io.clock.step[env] % ti.static(io.behavior_cfg.decide_period_steps) == 0
        if due and io.clock.active[env] == 1 and io.forecast.radius_m[env, track, 0] >= 0:
            mean, place = io.tracks.state[env, track], io.forecast.pos_w[env, track, 0]
            speed = ti.sqrt(mean[2] * mean[2] + mean[3] * mean[3])
            scale = 1.0 / ti.max(speed, 1.0e-6)
            course = ti.Vector([mean[2] * scale, mean[3] * scale])
            fastest = _fastest(env, track, ti.max(speed, _SLOWEST_M_S), io)
            frame = ti.Vector([place[0], place[1], mean[2] * scale, mean[3] * scale, fastest])
            for i in ti.static(range(N_FRAME)):
                io.mixture.frame[env, track, i] = frame[i]
            _put_motion(env, track, fastest, speed, course, io)
            _put_ahead(env, track, place, course, io)
            _put_behind(env, track, place, course, io)


@ti.func
def _forget(env, track, io: Bundle[TrackingIO]):
    io.past.past_count[env, track], io.past.bend_count[env, track] = 0, 0
    io.past.past_step[env, track] = 0
    for i in range(io.past.past_w.shape[2]):
        io.past.past_w[env, track, i] = ti.Vector([0.0, 0.0])
    for i in range(io.past.bend_w.shape[2]):
        io.past.bend_w[env, track, i] = ti.Vector([0.0, 0.0])


@ti.func
def _remember(env, track, io: Bundle[TrackingIO]):
    now = io.tracks.scan_step[env]
    gone = (now - io.past.past_step[env, track]) * io.episode_cfg.control_dt_s
    count = io.past.past_count[env, track]
    if count == 0 or gone >= PAST_S - 1.0e-3:
        for i in range(N_PAST - 1):
            io.past.past_w[env, track, N_PAST - 1 - i] = io.past.past_w[env, track, N_PAST - 2 - i]
        mean = io.tracks.state[env, track]
        io.past.past_w[env, track, 0] = ti.Vector([mean[0], mean[1]])
        io.past.past_step[env, track] = now
        io.past.past_count[env, track] = ti.min(count + 1, N_PAST)
    if io.turn_history.run_kind[env, track] == 2:
        bend, known = io.turn_history.run_from_w[env, track], io.past.bend_count[env, track]
        if known == 0 or (bend - io.past.bend_w[env, track, 0]).norm() > _NEW_BEND_M:
            for i in range(N_BEND - 1):
                io.past.bend_w[env, track, N_BEND - 1 - i] = io.past.bend_w[env, track, N_BEND - 2 - i]
            io.past.bend_count[env, track] = ti.min(known + 1, N_BEND)
            io.past.bend_w[env, track, 0] = bend


@ti.func
def _fastest(env, track, speed, io: Bundle[TrackingIO]):
    """[m/s] ``speed``, or that over ``_FAST_LEGS`` of the track's remembered legs, if that is more: what
    slows down for a turn comes out of it as fast as it went in."""
    for i in range(N_PAST - _FAST_LEGS):
        if i + _FAST_LEGS < io.past.past_count[env, track]:
            leg = io.past.past_w[env, track, i] - io.past.past_w[env, track, i + _FAST_LEGS]
            speed = ti.max(speed, ti.math.length(leg) / ti.static(_FAST_LEGS * PAST_S))
    return speed


@ti.func
def _scaled(length_m):
    return ti.math.clamp(length_m * ti.static(1.0 / LENGTH_M), -FAR, FAR)


@ti.func
def _put_place(env, track, column, off, course, io: Bundle[TrackingIO]):
    """Two columns: a place, given from the track's own in the world, in the track's frame."""
    io.mixture.column[env, track, column] = _scaled(off.dot(course))
    io.mixture.column[env, track, column + 1] = _scaled(course[0] * off[1] - course[1] * off[0])


@ti.func
def _put_motion(env, track, fastest, speed, course, io: Bundle[TrackingIO]):
    """How it moves, how well that is known, and how long it has gone straight."""
    dt, cov, turn_var = (
        io.episode_cfg.control_dt_s,
        io.tracks.cov[env, track],
        io.tracks.turn_cov[env, track][4],
    )
    unseen = (io.clock.step[env] - io.tracks.seen_step[env, track]) * dt
    kind, begun = io.turn_history.run_kind[env, track], 0.0
    if kind > 0:
        begun = (io.forecast.pos_w[env, track, 0] - io.turn_history.run_from_w[env, track]).dot(course)
    spread_v = ti.sqrt(ti.max(cov[7] + cov[9], 0.0))
    values = ti.Vector([
        fastest,
        speed,
        ti.math.clamp(io.tracks.turn_rate[env, track], -4.0, 4.0),
        ti.sqrt(turn_var),
        ti.select(turn_var > 0.0, 1.0, 0.0),
        ti.min(ti.sqrt(ti.max(cov[0] + cov[4], 0.0)), 2.0),
        ti.min(spread_v, 2.0),
        ti.min(unseen, 3.0),
        ti.math.log(1.0 + ti.cast(io.tracks.age[env, track], ti.f32)) * 0.2,
        io.tracks.radius_m[env, track],
        ti.select(kind == 1, 1.0, 0.0),
        ti.select(kind == 2, 1.0, 0.0),
        _scaled(begun),
    ])  # fmt: skip
    for i in ti.static(range(N_MOTION)):
        io.mixture.column[env, track, i] = values[i]


@ti.func
def _put_ahead(env, track, place, course, io: Bundle[TrackingIO]):
    """Walls on four sides, the next remembered turn, what turns this water has seen, the forecast."""
    radius, left = io.tracks.radius_m[env, track], ti.Vector([-course[1], course[0]])
    at = ti.static(N_MOTION)
    io.mixture.column[env, track, at] = _scaled(wall_ahead(place, course, radius, io.tank_cfg))
    io.mixture.column[env, track, at + 1] = _scaled(wall_ahead(place, -course, radius, io.tank_cfg))
    io.mixture.column[env, track, at + 2] = _scaled(wall_ahead(place, left, radius, io.tank_cfg))
    io.mixture.column[env, track, at + 3] = _scaled(wall_ahead(place, -left, radius, io.tank_cfg))
    gap, out = next_turn(env, place, course, io)
    known = gap < FAR_M
    io.mixture.column[env, track, at + 4] = _scaled(gap)
    io.mixture.column[env, track, at + 5] = ti.select(known, out.dot(course), 0.0)
    io.mixture.column[env, track, at + 6] = ti.select(known, out.dot(left), 0.0)
    back, aside = _turns_seen(env, io)
    io.mixture.column[env, track, at + 7] = ti.min(0.125 * back, FAR)
    io.mixture.column[env, track, at + 8] = ti.min(0.125 * aside, FAR)
    for i in ti.static(range(len(AHEAD_STEPS))):
        step = ti.min(ti.static(AHEAD_STEPS[i]), io.forecast.pos_w.shape[2] - 1)
        off = io.forecast.pos_w[env, track, step] - place
        _put_place(env, track, ti.static(N_MOTION + N_AHEAD + 2 * i), off, course, io)


@ti.func
def _put_behind(env, track, place, course, io: Bundle[TrackingIO]):
    """Turns of this track, and where it was."""
    first = ti.static(N_MOTION + N_AHEAD + 2 * len(AHEAD_STEPS))
    for i in range(N_BEND):
        known = ti.cast(i < io.past.bend_count[env, track], ti.f32)
        off = (io.past.bend_w[env, track, i] - place) * known
        _put_place(env, track, first + 3 * i, off, course, io)
        io.mixture.column[env, track, first + 3 * i + 2] = known
    begin = ti.static(first + 3 * N_BEND)
    for i in range(N_PAST):
        known = ti.cast(i < io.past.past_count[env, track], ti.f32)
        off = (io.past.past_w[env, track, i] - place) * known
        _put_place(env, track, begin + 2 * i, off, course, io)
    late = (io.clock.step[env] - io.past.past_step[env, track]) * io.episode_cfg.control_dt_s
    io.mixture.column[env, track, ti.static(begin + 2 * N_PAST)] = ti.math.clamp(late, 0.0, 1.0)


@ti.func
def _turns_seen(env, io: Bundle[TrackingIO]):
    """How many of the remembered turns of this water are turns back, and how many are others."""
    back, aside = 0.0, 0.0
    for packet in range(io.turn_history.turn.shape[2]):
        cos = (
            io.turn_history.turn[env, IN_X, packet] * io.turn_history.turn[env, OUT_X, packet]
            + io.turn_history.turn[env, IN_Y, packet] * io.turn_history.turn[env, OUT_Y, packet]
        )
        weight = io.turn_history.turn[env, WEIGHT, packet]
        for lane in ti.static(range(LANES)):
            if weight[lane] > 0.0:
                back += ti.select(cos[lane] < _BACK_COS, 1.0, 0.0)
                aside += ti.select(cos[lane] < _BACK_COS, 0.0, 1.0)
    return back, aside
