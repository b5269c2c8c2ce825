"""Forecast: where every moving track will be from now to the horizon, and how surely. Sees tracks only, never the truth."""

import taichi as ti

from uuvtai.config import EpisodeConfig, ForecastConfig, TankConfig, TrackingConfig
from uuvtai.kernels.core.geometry import FAR_M, turned_z
from uuvtai.kernels.core.kalman import largest_position_variance
from uuvtai.kernels.core.signature import Const, In, Out, quick_launch, spread
from uuvtai.kernels.perception.habits import expected_turn_rate, forget_habits, learn_habit, next_event
from uuvtai.state import ClockState, ClusterState, DepthImage, ForecastState, HabitState, TrackState

MOST_LEGS = 6
"""Turns within one forecast; beyond them a body goes straight on."""


@quick_launch
@ti.kernel
def reset_forecast(forecast: Out[ForecastState], habits: Out[HabitState], clock: In[ClockState]):
    """Know no habits and expect nothing in the awake rows."""
    n = ti.static(clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and clock.awake[env] == 1:
            forget_habits(env, habits)
            for track in range(forecast.radius_m.shape[1]):
                clear_forecast(env, track, forecast)
                forecast.turn_m[env, track], forecast.turn_out_w[env, track] = FAR_M, ti.Vector([0.0, 0.0])
                for k in range(forecast.pos_w.shape[2]):
                    forecast.pos_w[env, track, k] = ti.Vector([0.0, 0.0])


@quick_launch
@ti.kernel
def learn_habits(
    habits: Out[HabitState],
    tracks: In[TrackState],
    clusters: In[ClusterState],
    clock: In[ClockState],
    forecast_cfg: Const[ForecastConfig],
    rules: Const[EpisodeConfig],
):
    """Watch how the tracks move, after each tracked scan."""
    n = ti.static(clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and clock.awake[env] == 1 and clusters.fresh[env] == 1:
            for track in range(tracks.alive.shape[1]):
                learn_habit(env, track, habits, tracks, forecast_cfg, rules)


@quick_launch
@ti.kernel
def forecast_tracks(
    forecast: Out[ForecastState],
    tracks: In[TrackState],
    habits: In[HabitState],
    clusters: In[ClusterState],
    image: In[DepthImage],
    clock: In[ClockState],
    forecast_cfg: Const[ForecastConfig],
    tracking: Const[TrackingConfig],
    tank: Const[TankConfig],
    rules: Const[EpisodeConfig],
):
    """From now to the horizon, for the moving tracks of the awake rows; the others get a negative radius.

    The radius grows by ``growth_sigmas`` standard deviations of the predicted position along its worst axis, as the filter knows it today:
    turns to come are not in it (the planner's own growing margin is for them). At most ``max_growth_m``.
    """
    n = ti.static(clock.awake.shape[0])
    n_track = ti.static(tracks.alive.shape[1])
    for env, track, pad in ti.ndrange(n, n_track, ti.static(spread(n * n_track))):
        if pad == 0 and clock.awake[env] == 1:
            changed = clusters.fresh[env] + image.fresh[env] > 0  # only a tracked scan or an image changes tracks and habits
            if tracks.alive[env, track] * tracks.moving[env, track] == 1:
                if expected_turn_rate(env, track, tracks, forecast_cfg, tracking) != 0.0:
                    follow_arc(env, track, forecast, tracks, clock, forecast_cfg, tracking, rules)
                else:
                    follow_legs(env, track, changed, forecast, tracks, habits, clock, forecast_cfg, tracking, tank, rules)
            elif forecast.radius_m[env, track, 0] >= 0:
                clear_forecast(env, track, forecast)


@ti.func
def clear_forecast(env, track, forecast: Out[ForecastState]):
    for k in range(forecast.radius_m.shape[2]):
        forecast.radius_m[env, track, k] = -1.0


@ti.func
def follow_arc(
    env,
    track,
    forecast: Out[ForecastState],
    tracks: In[TrackState],
    clock: In[ClockState],
    forecast_cfg: Const[ForecastConfig],
    tracking: Const[TrackingConfig],
    rules: Const[EpisodeConfig],
):
    """Constant speed and turn rate: steps along the chords of the arc."""
    mean, cov = tracks.state[env, track], tracks.cov[env, track]
    late = (clock.step[env] - tracks.scan_step[env]) * rules.control_dt_s
    rate = expected_turn_rate(env, track, tracks, forecast_cfg, tracking)
    vel = ti.Vector([mean[2], mean[3]])
    pos = ti.Vector([mean[0], mean[1]]) + late * chord(rate * late) * turned_z(vel, 0.5 * rate * late)
    vel = turned_z(vel, rate * late)
    step = ti.static(tracking.forecast_dt_s) * chord(rate * tracking.forecast_dt_s)
    for k in range(forecast.radius_m.shape[2]):
        ahead = late + k * tracking.forecast_dt_s
        growth = tracking.growth_sigmas * ti.sqrt(largest_position_variance(cov, ahead))
        forecast.pos_w[env, track, k] = pos
        forecast.radius_m[env, track, k] = tracks.radius_m[env, track] + ti.min(growth, tracking.max_growth_m)
        pos += step * turned_z(vel, 0.5 * rate * tracking.forecast_dt_s)
        vel = turned_z(vel, rate * tracking.forecast_dt_s)


@ti.func
def follow_legs(
    env,
    track,
    changed,
    forecast: Out[ForecastState],
    tracks: In[TrackState],
    habits: In[HabitState],
    clock: In[ClockState],
    forecast_cfg: Const[ForecastConfig],
    tracking: Const[TrackingConfig],
    tank: Const[TankConfig],
    rules: Const[EpisodeConfig],
):
    """Constant speed on straight legs, from turn to turn; the search for the first turn is kept until something has ``changed``."""
    mean, cov, radius = tracks.state[env, track], tracks.cov[env, track], tracks.radius_m[env, track]
    pos, speed = ti.Vector([mean[0], mean[1]]), ti.max(ti.sqrt(mean[2] * mean[2] + mean[3] * mean[3]), 1e-6)
    course = ti.Vector([mean[2], mean[3]]) / speed
    gap, out = forecast.turn_m[env, track], forecast.turn_out_w[env, track]
    if changed:
        gap, out = next_event(env, pos, course, radius, habits, forecast_cfg, tank)
        forecast.turn_m[env, track] = gap
        forecast.turn_out_w[env, track] = out
    legs = 0
    ahead = (clock.step[env] - tracks.scan_step[env]) * rules.control_dt_s
    way = speed * ahead
    for k in range(forecast.radius_m.shape[2]):
        while way > gap and legs < MOST_LEGS:
            pos += gap * course
            way -= gap
            course = out
            gap, out = next_event(env, pos, course, radius, habits, forecast_cfg, tank)
            legs += 1
        pos += way * course
        gap -= way
        growth = tracking.growth_sigmas * ti.sqrt(largest_position_variance(cov, ahead))
        forecast.pos_w[env, track, k] = pos
        forecast.radius_m[env, track, k] = radius + ti.min(growth, tracking.max_growth_m)
        way = speed * tracking.forecast_dt_s
        ahead += tracking.forecast_dt_s


@ti.func
def chord(angle):
    """Length of the chord over that of its arc of less than a turn: sin(a / 2) / (a / 2), by its series."""
    square = 0.25 * angle * angle
    return 1.0 - square / 6.0 * (1.0 - square / 20.0)
