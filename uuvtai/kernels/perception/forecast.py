"""Forecast: where every moving track will be from now to the horizon, and how surely. Sees tracks only, never
the truth."""

import taichi as ti

from uuvtai.kernels.core.geometry import FAR_M, turned_z
from uuvtai.kernels.core.kalman import largest_position_variance
from uuvtai.kernels.core.signature import Bundle, spread
from uuvtai.kernels.perception.bundles import ForecastIO
from uuvtai.kernels.perception.habits import expected_turn_rate, forget_habits, learn_habit, next_event
from uuvtai.native.launch import quick_launch

MOST_LEGS = 6
"""Turns within one forecast; beyond them a body goes straight on."""


@quick_launch
@ti.kernel
def reset_forecast(io: Bundle[ForecastIO]):
    """Know no habits and expect nothing in the awake rows."""
    n = ti.static(io.clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and io.clock.awake[env] == 1:
            forget_habits(env, io)
            for track in range(io.forecast.radius_m.shape[1]):
                clear_forecast(env, track, io)
                io.forecast.turn_m[env, track], io.forecast.turn_out_w[env, track] = (
                    FAR_M,
                    ti.Vector([0.0, 0.0]),
                )
                for k in range(io.forecast.pos_w.shape[2]):
                    io.forecast.pos_w[env, track, k] = ti.Vector([0.0, 0.0])


@quick_launch
@ti.kernel
def learn_habits(io: Bundle[ForecastIO]):
    """Watch how the tracks move, after each tracked scan."""
    n = ti.static(io.clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and io.clock.awake[env] == 1 and io.clusters.fresh[env] == 1:
            for track in range(io.tracks.alive.shape[1]):
                learn_habit(env, track, io)


@quick_launch
@ti.kernel
def forecast_tracks(io: Bundle[ForecastIO]):
    """From now to the horizon, for the moving tracks of the awake rows; the others get a negative radius.

    The radius grows by ``growth_sigmas`` standard deviations of the predicted position along its worst axis,
    as the filter knows it today: turns to come are not in it (the planner's own growing margin is for them).
    At most ``max_growth_m``.
    """
    n = ti.static(io.clock.awake.shape[0])
    n_track = ti.static(io.tracks.alive.shape[1])
    for env, track, pad in ti.ndrange(n, n_track, ti.static(spread(n, n_track))):
        if pad == 0 and io.clock.awake[env] == 1:
            changed = (
                io.clusters.fresh[env] + io.image.fresh[env] > 0
            )  # only a tracked scan or an image changes tracks and habits
            if io.tracks.alive[env, track] * io.tracks.moving[env, track] == 1:
                if expected_turn_rate(env, track, io.tracks, io.forecast_cfg, io.tracking_cfg) != 0.0:
                    follow_arc(env, track, io)
                else:
                    follow_legs(env, track, changed, io)
            elif io.forecast.radius_m[env, track, 0] >= 0:
                clear_forecast(env, track, io)


@ti.func
def clear_forecast(env, track, io: Bundle[ForecastIO]):
    for k in range(io.forecast.radius_m.shape[2]):
        io.forecast.radius_m[env, track, k] = -1.0


@ti.func
def follow_arc(env, track, io: Bundle[ForecastIO]):
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
        io.forecast.radius_m[env, track, k] = io.tracks.radius_m[env, track] + ti.min(
            growth, io.tracking_cfg.max_growth_m
        )
        pos += step * turned_z(vel, 0.5 * rate * io.tracking_cfg.forecast_dt_s)
        vel = turned_z(vel, rate * io.tracking_cfg.forecast_dt_s)


@ti.func
def follow_legs(env, track, changed, io: Bundle[ForecastIO]):
    """Constant speed on straight legs, from turn to turn; the search for the first turn is kept until
    something has ``changed``."""
    mean, cov, radius = io.tracks.state[env, track], io.tracks.cov[env, track], io.tracks.radius_m[env, track]
    pos, speed = ti.Vector([mean[0], mean[1]]), ti.max(ti.sqrt(mean[2] * mean[2] + mean[3] * mean[3]), 1e-6)
    course = ti.Vector([mean[2], mean[3]]) / speed
    gap, out = io.forecast.turn_m[env, track], io.forecast.turn_out_w[env, track]
    if changed:
        gap, out = next_event(env, pos, course, radius, io.habits, io.forecast_cfg, io.tank_cfg)
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
            gap, out = next_event(env, pos, course, radius, io.habits, io.forecast_cfg, io.tank_cfg)
            legs += 1
        pos += way * course
        gap -= way
        growth = io.tracking_cfg.growth_sigmas * ti.sqrt(largest_position_variance(cov, ahead))
        io.forecast.pos_w[env, track, k] = pos
        io.forecast.radius_m[env, track, k] = radius + ti.min(growth, io.tracking_cfg.max_growth_m)
        way = speed * io.tracking_cfg.forecast_dt_s
        ahead += io.tracking_cfg.forecast_dt_s


@ti.func
def chord(angle):
    """Length of the chord over that of its arc of less than a turn: sin(a / 2) / (a / 2), by its series."""
    square = 0.25 * angle * angle
    return 1.0 - square / 6.0 * (1.0 - square / 20.0)
