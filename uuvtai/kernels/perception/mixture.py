"""Learned forecast: a mixture density network (Bishop 1994, NCRG/94/004) says what each moving track may do,
and how probable that is. It sees the columns of ``motion_columns`` and nothing else.

It says the logits of ``N_MODE`` futures, then each one's places at ``ANCHORS`` times ``ANCHOR_S`` apart, in
the track's frame and in parts of the way that it can go till then. Between them bodies go straight, never
faster than now. The trained network says spreads too; they are not needed here.
"""

import taichi as ti

from uuvtai.forecast_codes import ANCHOR_S, ANCHORS, LAST, MIDDLE, N_COLUMN, N_HIDDEN, N_MODE, N_SAID
from uuvtai.kernels.core.lanes import LANES
from uuvtai.kernels.core.signature import Bundle, spread
from uuvtai.kernels.perception.bundles import MixtureIO
from uuvtai.native.launch import quick_launch


@quick_launch
@ti.kernel
def mix_futures(io: Bundle[MixtureIO]):
    """In decision steps: the likeliest future of every track that has a forecast becomes its forecast, the
    others are its futures, with their probabilities."""
    n, n_track = ti.static(io.clock.awake.shape[0], io.forecast.radius_m.shape[1])
    for env, track, pad in ti.ndrange(n, n_track, ti.static(spread(n, n_track))):
        due = io.clock.step[env] % ti.static(io.teacher_cfg.decide_period_steps) == 0
        if pad == 0 and due and io.clock.awake[env] == 1:
            if io.forecast.radius_m[env, track, 0] >= 0:
                _think(env, track, io)
                _tell(env, track, io)
            else:
                for future in ti.static(range(N_MODE)):
                    io.futures.share[env, track, future] = 0.0


@ti.func
def _think(env, track, io: Bundle[MixtureIO]):
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
def _tell(env, track, io: Bundle[MixtureIO]):
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
def _place_at(env, track, future, ahead_s, io: Bundle[MixtureIO]):
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
