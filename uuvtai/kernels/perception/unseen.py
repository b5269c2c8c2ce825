"""Bodies above or below the fan may turn back: where they are then, and how uncertain that is (part of
tracking).

A body that swims to and fro at constant speed and turns back at the rate h [1/s] has the velocity s(t) v with
s = +-1: its mean is exp(-2ht) v, and the covariance of its velocity at two times falls as exp(-2h |t - t'|)
(Kac's telegraph process). An Ornstein-Uhlenbeck velocity with the rate 2h and the same mean square has the
same first and second moments at all times, so a Kalman filter can carry them: the mean slows down and stays
ahead of the last sight by v / 2h, the variance along the way grows backwards as well as forwards. The mean
square of the velocity, mean^2 + variance, is what such a body keeps: its largest axis is the way, its root
the speed.
"""

import taichi as ti

from uuvtai.config import ForecastConfig, TrackingConfig, TrafficConfig
from uuvtai.kernels.core.geometry import FAR_M
from uuvtai.kernels.core.kalman import AT
from uuvtai.kernels.core.signature import Bundle, Const, In
from uuvtai.kernels.perception.bundles import TrackingIO
from uuvtai.kernels.perception.habits import BEGIN_SEEN, next_turn
from uuvtai.state import TrackState

_SLOWEST_M_S = 0.1
"""A slower body is where it is, whichever way it turns."""

_LEAST_SHARE = 1.0e-3
"""Share of ways at least that a body may still be on."""

_ODD_SHARE = 0.05
"""Share of ways that are longer than any expected: their length is exponential."""


@ti.func
def way_of(mean, cov):
    """(unit vector along the way, mean square speed along it [m^2/s^2])."""
    xx, xy, yy = mean[2] * mean[2] + cov[7], mean[2] * mean[3] + cov[8], mean[3] * mean[3] + cov[9]
    half = 0.5 * (xx - yy)
    root = ti.sqrt(half * half + xy * xy)
    angle = 0.5 * ti.atan2(xy, half)
    c, s = ti.cos(angle), ti.sin(angle)
    ahead = ti.select(c * mean[2] + s * mean[3] < 0.0, -1.0, 1.0)
    return ti.Vector([ahead * c, ahead * s]), 0.5 * (xx + yy) + root


@ti.func
def turn_back_rate(env, track, dt, io: Bundle[TrackingIO]):
    """[1/s] at which an unseen body turns back, from the length of way that it was seen to go straight; 0
    where its next turn is known."""
    mean = io.tracks.state[env, track]
    course, square = way_of(mean, io.tracks.cov[env, track])
    speed, pos = ti.sqrt(square), ti.Vector([mean[0], mean[1]])
    rate = 0.0
    if speed > _SLOWEST_M_S:
        turn = FAR_M + 0.0
        if ti.static(io.forecast_cfg.use_habits):
            turn, _ = next_turn(env, pos, course, io.habits, io.forecast_cfg)
        if turn >= FAR_M:
            begun, known = 0.0, io.habits.run_kind[env, track] >= BEGIN_SEEN
            if io.habits.run_kind[env, track] > 0:
                begun = ti.max((pos - io.habits.run_from_w[env, track]).dot(course), 0.0)
            first = ti.max(longer_share(begun, known, io.traffic_cfg), _LEAST_SHARE)
            last = ti.max(longer_share(begun + speed * dt, known, io.traffic_cfg), _LEAST_SHARE)
            straight = straight_share(env, track, io.tracks, io.forecast_cfg, io.tracking_cfg)
            rate = straight * ti.log(first / last) / ti.max(dt, 1.0e-3)
    return rate


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


@ti.func
def turned_back(mean, cov, link, rate, dt):
    """(mean, covariance, link) that went straight for dt [s], of a body that turns back at ``rate``
    [1/s]."""
    course, square = way_of(mean, cov)
    x = 2.0 * rate * dt
    left = ti.exp(-x)
    short = dt * _lag(x)
    m = _along(mean, course, short, 1.0 - left)
    bound = _along(ti.Vector([link[0], link[1], link[2], link[3]]), course, short, 1.0 - left)
    half = ti.Matrix.zero(ti.f32, 4, 4)
    for j in ti.static(range(4)):
        column = _along(ti.Vector([cov[ti.static(AT[i][j])] for i in range(4)]), course, short, 1.0 - left)
        for i in ti.static(range(4)):
            half[i, j] = column[i]
    # noise of the Ornstein-Uhlenbeck velocity along the way; (1 - e)^2 / x^2 = (1 - lag)^2 to all orders
    gained = 1.0 - _lag(x)
    q = ti.Vector([dt * dt * _spread(x), dt * x * gained * gained, 1.0 - left * left]) * square
    grown = cov + 0.0
    for i in ti.static(range(4)):
        row = _along(ti.Vector([half[i, j] for j in range(4)]), course, short, 1.0 - left)
        for j in ti.static(range(i, 4)):
            noise = q[ti.static(i // 2 + j // 2)] * course[ti.static(i % 2)] * course[ti.static(j % 2)]
            grown[ti.static(AT[i][j])] = row[j] + noise
    return m, grown, ti.Vector([bound[0], bound[1], bound[2], bound[3], link[4]])


@ti.func
def _along(u, course, short, lost):
    """A small change of (x, y, vx, vy): along the way the velocity loses a share, the position what that
    would have driven."""
    gone = (u[2] * course[0] + u[3] * course[1]) * course
    return u - ti.Vector([short * gone[0], short * gone[1], lost * gone[0], lost * gone[1]])


@ti.func
def _lag(x):
    """1 - (1 - exp(-x)) / x."""
    series = x * (0.5 - x * (1.0 / 6.0 - x * (1.0 / 24.0 - x * (1.0 / 120.0))))
    return ti.select(x < 0.1, series, 1.0 - (1.0 - ti.exp(-x)) / ti.max(x, 0.1))


@ti.func
def _spread(x):
    """(2x - 3 + 4 exp(-x) - exp(-2x)) / x^2."""
    series = x * (2.0 / 3.0 - x * (0.5 - x * (7.0 / 30.0 - x * (1.0 / 12.0 - x * (31.0 / 1260.0)))))
    far = ti.max(x, 0.4)
    left = ti.exp(-far)
    return ti.select(x < 0.4, series, (2.0 * far - 3.0 + 4.0 * left - left * left) / (far * far))
