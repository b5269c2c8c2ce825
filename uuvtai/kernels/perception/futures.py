"""Futures: what a body on a straight way may do instead of going on, and how probable that is.

A body that swims back and forth on a line, or from corner to corner, turns where nobody knows until it was
seen (``habits``). The lengths of such ways are known in general (``traffic.leg_m``, all lengths between two
bounds equally likely), so the longer a body has gone straight the sooner it turns: with S(y) the probability
that a way is longer than y, a body that was seen to go straight for y turns within the next d with 1 - S(y +
d) / S(y). Where its begin was seen, S falls linearly between the bounds; else the place where it was first
seen lies anywhere on the way, and S(y) is the mean of what is left of a way beyond y. A body cannot go
through a wall: only turns before the next one count. Sees tracks only.
"""

import taichi as ti

from uuvtai.config import ForecastConfig, TrackingConfig, TrafficConfig
from uuvtai.kernels.core.geometry import FAR_M
from uuvtai.kernels.core.signature import Bundle, Const, In, spread
from uuvtai.kernels.perception.bundles import FuturesIO
from uuvtai.kernels.perception.habits import expected_turn_rate, next_turn, wall_ahead
from uuvtai.native.launch import quick_launch
from uuvtai.state import TrackState

_SLOWEST_M_S = 0.1
"""A slower body is where it is, whichever way it turns."""

_ODD_SHARE = 0.05
"""Share of ways that are longer than any expected: their length is exponential."""

BEGIN_SEEN = 2


@quick_launch
@ti.kernel
def weigh_futures(io: Bundle[FuturesIO]):
    """In decision steps: the futures of every track that goes straight. The others have none."""
    n, n_track = ti.static(io.tracks.alive.shape[0], io.tracks.alive.shape[1])
    for env, track, pad in ti.ndrange(n, n_track, ti.static(spread(n * n_track))):
        due = io.clock.step[env] % ti.static(io.teacher_cfg.decide_period_steps) == 0
        if pad == 0 and due and io.clock.awake[env] == 1:
            for future in range(ti.static(io.futures.share.shape[2])):
                io.futures.share[env, track, future] = 0.0
            if io.forecast.radius_m[env, track, 0] >= 0:
                if expected_turn_rate(env, track, io.tracks, io.forecast_cfg, io.tracking_cfg) == 0.0:
                    _turn_backs(env, track, io)


@ti.func
def _turn_backs(env, track, io: Bundle[FuturesIO]):
    """One future for each of ``turn_back_s``, unless the next turn is known."""
    step_s = ti.static(io.tracking_cfg.forecast_dt_s)
    pos = io.forecast.pos_w[env, track, 0]
    way = io.forecast.pos_w[env, track, 1] - pos
    speed = way.norm() / step_s
    if speed > _SLOWEST_M_S:
        course = way / way.norm()
        turn, _ = next_turn(env, pos, course, io.habits, io.forecast_cfg)
        if turn >= FAR_M:
            begun, known = 0.0, io.habits.run_kind[env, track] == BEGIN_SEEN
            if io.habits.run_kind[env, track] > 0:
                begun = ti.max((pos - io.habits.run_from_w[env, track]).dot(course), 0.0)
            wall = ti.max(wall_ahead(pos, course, io.tracks.radius_m[env, track], io.tank_cfg), 0.0)
            first = longer_share(begun, known, io.traffic_cfg)
            rest = first - longer_share(begun + wall, known, io.traffic_cfg)
            straight = straight_share(env, track, io.tracks, io.forecast_cfg, io.tracking_cfg) / ti.max(
                rest, 1.0e-3
            )
            gone = 0.0
            for future in ti.static(range(len(io.forecast_cfg.turn_back_s))):
                end = ti.min(speed * ti.static(io.forecast_cfg.turn_back_s[future]), wall)
                last = longer_share(begun + end, known, io.traffic_cfg)
                io.futures.share[env, track, future] = straight * ti.max(first - last, 0.0)
                turns_s = 0.5 * (gone + end) / speed
                for k in range(io.futures.pos_w.shape[3]):
                    ahead = k * step_s
                    there = speed * ti.select(ahead < turns_s, ahead, 2.0 * turns_s - ahead)
                    io.futures.pos_w[env, track, future, k] = pos + there * course
                first, gone = last, end


@ti.func
def longer_share(way_m, known, traffic_cfg: Const[TrafficConfig]):
    """S: share of straight ways that go on for more than ``way_m`` [m]; ``known``: counted from their begin,
    else from a place anywhere on them."""
    low, high = ti.static(traffic_cfg.leg_m)
    left = ti.math.clamp((high - way_m) * ti.static(1.0 / max(high - low, 1e-3)), 0.0, 1.0)
    if not known:
        middle = ti.static(0.5 * (low + high))
        beyond = ti.max(high - way_m, 0.0)
        curve = beyond * beyond * ti.static(0.5 / max(high - low, 1e-3) / (0.5 * (low + high)))
        left = ti.select(way_m < low, (middle - way_m) / middle, curve)
    return (1.0 - _ODD_SHARE) * left + _ODD_SHARE * ti.exp(-way_m * ti.static(1.0 / high))


@ti.func
def straight_share(
    env,
    track,
    tracks: In[TrackState],
    forecast_cfg: Const[ForecastConfig],
    tracking_cfg: Const[TrackingConfig],
):
    """Probability that the body goes straight rather than in a circle (``habits.expected_turn_rate``)."""
    share = 1.0
    if ti.static(forecast_cfg.use_turn_rate and tracking_cfg.turn_rate_sigma_rad_s > 0):
        rate, var = tracks.turn_rate[env, track], tracks.turn_cov[env, track][4]
        if var > 0.0:
            turns = ti.sqrt(var) * ti.static(1.0 / tracking_cfg.turn_rate_sigma_rad_s)
            turns *= ti.exp(ti.min(0.5 * rate * rate / var, 20.0))
            share = forecast_cfg.straight_odds / (forecast_cfg.straight_odds + turns)
    return share
