"""Futures: what a body on a straight way may do instead of going on, and how probable that is.

Three hypotheses that nobody can rule out beforehand: it goes on; it swims to and fro on a line and turns
back; it swims from corner to corner, each anywhere in the known water, and turns there to the next. (Known
habits and turn rates are in the forecast itself.)

Turning back: the lengths of such ways are known in general (``traffic.leg_m``, all lengths between two bounds
equally likely), so the longer a body has gone straight the sooner it turns: with S(y) the probability that a
way is longer than y, a body that was seen to go straight for y turns within the next d with 1 - S(y + d) /
S(y). Where its begin was seen, S falls linearly between the bounds; else the place where it was first seen
lies anywhere on the way, and S(y) is the mean of what is left of a way beyond y. A body cannot go through a
wall: only turns before the next one count.

Corners: ways between two places that lie anywhere pass a given place, on a given course, with the density
s + t of their lengths s behind and t ahead of it (the area element of two points on a line). So the next
corner lies within d with d (q + d) / (w (q + w)), where w is the wall's distance ahead, and q twice the way
gone where its begin was seen, else the way gone and the wall's distance behind. From a corner the next way
leads on a course with the density L^2 / 2A, L the wall's distance on that course, A the area of the water.

Which of the two a body does is told by Bayes' rule from the share of such bodies (``traffic.corner_share``),
from its last turn, and from how far it has gone straight since. Of all courses behind a corner those matter
that lead to the vehicle: one future stands for them, with their probability. Sees tracks only.
"""

import math

import taichi as ti

from uuvtai.config import ForecastConfig, TankConfig, TrackingConfig, TrafficConfig
from uuvtai.kernels.core.geometry import FAR_M
from uuvtai.kernels.core.signature import Bundle, Const, In, spread
from uuvtai.kernels.perception.bundles import FuturesIO
from uuvtai.kernels.perception.habits import (
    BEGIN_SEEN,
    CORNER_SEEN,
    expected_turn_rate,
    next_turn,
    wall_ahead,
)
from uuvtai.native.launch import quick_launch
from uuvtai.state import TrackState

_SLOWEST_M_S = 0.1
"""A slower body is where it is, whichever way it turns."""

_ODD_SHARE = 0.05
"""Share of ways that are longer than any expected: their length is exponential."""

_MISTAKEN = 0.02
"""Share of turns that are taken for the other kind."""

_BACK_RAD = math.radians(20.0)
"""A corner within this of straight back looks like a turn back (``habits``)."""

_WALL_M = 0.1
"""No wall counts as nearer: places of bodies are not known better."""

_TOUCH_M = 0.3
"""Half width of the vehicle and what the referee keeps clear of it, beside a body's radius."""


@quick_launch
@ti.kernel
def weigh_futures(io: Bundle[FuturesIO]):
    """In decision steps: the futures of every track that goes straight. The others have none."""
    n, n_track = ti.static(io.tracks.alive.shape[0], io.tracks.alive.shape[1])
    for env, track, pad in ti.ndrange(n, n_track, ti.static(spread(n, n_track))):
        due = io.clock.step[env] % ti.static(io.teacher_cfg.decide_period_steps) == 0
        if pad == 0 and due and io.clock.awake[env] == 1:
            io.futures.corner[env, track] = 0.0
            for future in range(ti.static(io.futures.share.shape[2])):
                io.futures.share[env, track, future] = 0.0
            if io.forecast.radius_m[env, track, 0] >= 0:
                if expected_turn_rate(env, track, io.tracks, io.forecast_cfg, io.tracking_cfg) == 0.0:
                    _weigh_turns(env, track, io)


@ti.func
def _weigh_turns(env, track, io: Bundle[FuturesIO]):
    """Two futures for each of ``turn_back_s``, unless the next turn is known."""
    step_s, n_span = ti.static(io.tracking_cfg.forecast_dt_s, len(io.forecast_cfg.turn_back_s))
    pos = io.forecast.pos_w[env, track, 0]
    way = io.forecast.pos_w[env, track, 1] - pos
    speed = way.norm() / step_s
    if speed > _SLOWEST_M_S:
        course = way / way.norm()
        turn, _ = next_turn(env, pos, course, io.habits, io.forecast_cfg)
        if turn >= FAR_M:
            radius, kind = io.tracks.radius_m[env, track], io.habits.run_kind[env, track]
            begun, known = 0.0, kind >= BEGIN_SEEN
            if kind > 0:
                begun = ti.max((pos - io.habits.run_from_w[env, track]).dot(course), 0.0)
            wall = ti.max(wall_ahead(pos, course, radius, io.tank_cfg), _WALL_M)
            behind = ti.max(wall_ahead(pos, -course, radius, io.tank_cfg), begun + _WALL_M)
            corners = _corner_share(env, track, begun, wall, behind, io)
            straight = straight_share(env, track, io.tracks, io.forecast_cfg, io.tracking_cfg)
            gone, turned, cornered = 0.0, 0.0, 0.0
            for span in ti.static(range(n_span)):
                end = ti.min(speed * ti.static(io.forecast_cfg.turn_back_s[span]), wall)
                back = turn_share(begun, end, wall, known, io.traffic_cfg)
                corner = corner_share(begun, end, wall, behind, known)
                io.futures.share[env, track, span] = straight * (1.0 - corners) * (back - turned)
                _go_round(env, track, span, pos, 0.5 * (gone + end), speed, course, -course, io)
                likely = straight * corners * (corner - cornered)
                io.futures.corner[env, track] += likely
                place = pos + 0.5 * (gone + end) * course
                off = ti.Vector([io.ego.pos_w[env][0], io.ego.pos_w[env][1]]) - place
                out = off / ti.max(off.norm(), 1.0e-3)
                io.futures.share[env, track, n_span + span] = likely * _sector(place, off, radius, io)
                _go_round(env, track, n_span + span, pos, 0.5 * (gone + end), speed, course, out, io)
                gone, turned, cornered = end, back, corner


@ti.func
def _corner_share(env, track, begun, wall, behind, io: Bundle[FuturesIO]):
    """Probability that a body turns corners rather than back, after what it was seen to do."""
    corners = ti.static(io.traffic_cfg.corner_share) + 0.0
    turns_back = 1.0 - corners
    kind = io.habits.run_kind[env, track]
    known = kind >= BEGIN_SEEN
    if kind == CORNER_SEEN:
        turns_back *= _MISTAKEN
    elif kind == BEGIN_SEEN:
        # the last corner is ``begun`` behind, and the way before it came from ahead
        length = begun + wall
        area = _area_m2(io.tracks.radius_m[env, track], io.tank_cfg)
        corners *= ti.min(_BACK_RAD * length * length / area + _MISTAKEN, 1.0)
    corners *= 1.0 - corner_share(0.0, begun, begun + wall, behind - begun, known)
    turns_back *= longer_share(begun, known, io.traffic_cfg)
    return corners / ti.max(corners + turns_back, 1.0e-9)


@ti.func
def turn_share(begun, ahead, wall, known, traffic_cfg: Const[TrafficConfig]):
    """Probability that a body on a line turns back within ``ahead`` [m], all before the ``wall`` [m]."""
    here = longer_share(begun, known, traffic_cfg)
    rest = here - longer_share(begun + wall, known, traffic_cfg)
    return ti.max(here - longer_share(begun + ahead, known, traffic_cfg), 0.0) / ti.max(rest, 1.0e-3)


@ti.func
def corner_share(begun, ahead, wall, behind, known):
    """Probability that a body's next corner lies within ``ahead`` [m]: see above; all lie before the ``wall``
    [m]."""
    q = ti.select(known, 2.0 * begun, behind + begun)
    return ti.min(ahead * (q + ahead) / ti.max(wall * (q + wall), 1.0e-6), 1.0)


@ti.func
def _sector(place, off, radius, io: Bundle[FuturesIO]):
    """Share of the courses from a corner at ``place`` that lead to the vehicle, ``off`` [m] away."""
    away = ti.max(off.norm(), 1.0e-3)
    length = ti.max(wall_ahead(place, off / away, radius, io.tank_cfg), _WALL_M)
    width = 2.0 * ti.atan2(radius + ti.static(_TOUCH_M), away)
    return ti.min(0.5 / _area_m2(radius, io.tank_cfg) * length * length * width, 1.0)


@ti.func
def _area_m2(radius, tank_cfg: Const[TankConfig]):
    """[m^2] seen from above, where the centre of a body of that radius [m] may be."""
    area = 0.0
    if ti.static(tank_cfg.shape == "circle"):
        area = ti.static(math.pi) * (tank_cfg.radius_m - radius) ** 2
    else:
        length, width = ti.static(tank_cfg.x_m[1] - tank_cfg.x_m[0], tank_cfg.y_m[1] - tank_cfg.y_m[0])
        area = (length - 2.0 * radius) * (width - 2.0 * radius)
    return ti.max(area, 1.0)


@ti.func
def _go_round(env, track, future, pos, turn_m, speed, course, out, io: Bundle[FuturesIO]):
    """A future that goes on along ``out`` after ``turn_m`` [m]."""
    for k in range(io.futures.pos_w.shape[3]):
        there = speed * ti.static(io.tracking_cfg.forecast_dt_s) * k
        place = pos + ti.min(there, turn_m) * course + ti.max(there - turn_m, 0.0) * out
        io.futures.pos_w[env, track, future, k] = place


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
