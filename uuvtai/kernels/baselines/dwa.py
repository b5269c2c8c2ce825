"""Dynamic window approach after Fox, Burgard and Thrun, "The Dynamic Window Approach to Collision
Avoidance", IEEE Robotics & Automation Magazine 4(1), 1997.

Of the velocities that can be reached within a short time those are admissible that come to rest before they
touch anything, and of these the best has the largest weighted sum of heading, clearance and speed. Adapted:
the vehicle moves sideways too (``local_planner.py``); obstacles move, so a velocity is rolled out with the
vehicle's lag against their forecast; speed beyond the wanted one is worth nothing more; where nothing is
admissible, the velocity that touches least and latest is driven.
"""

import taichi as ti

from uuvtai.compile.launch import quick_launch
from uuvtai.config.planning import ACCELERATION_M_S2
from uuvtai.kernels.baselines.io import LocalPlannerIO
from uuvtai.kernels.baselines.local_planner import (
    decides,
    mapped_m,
    nearest_obstacle_m,
    reachable_velocity,
    wanted_velocity,
)
from uuvtai.kernels.core.geometry import FAR_M, PI, turned_z3
from uuvtai.kernels.core.stage import Bundle, loop_end

_CLEAR_M = 0.6  # Clearance beyond the margin from which on more is worth nothing.
_FORBIDDEN = -100.0  # Score below that of every admissible velocity.


@quick_launch
@ti.kernel
def plan_dynamic_window(io: Bundle[LocalPlannerIO]):
    """Velocity of best score for the rows that decide in this step."""
    n, n_trial = ti.static(io.clock.active.shape[0], io.baselines_cfg.n_reachable)
    window_s = ti.static(io.dwa_cfg.window_s)
    for env, trial in ti.ndrange(loop_end(n, io.clock), n_trial):
        if decides(env, io):
            io.baselines.score[env, trial] = _score(
                env, wanted_velocity(env, io), reachable_velocity(env, trial, window_s, io), io
            )
    for env in range(loop_end(n, io.clock)):
        if decides(env, io):
            best = 0
            for trial in range(1, n_trial):
                if io.baselines.score[env, trial] >= io.baselines.score[env, best]:
                    best = trial
            io.baselines.vel_w[env] = reachable_velocity(env, best, window_s, io)


@ti.func
def _score(env, wanted, velocity, io: Bundle[LocalPlannerIO]):
    """Weighted sum of the three shares in [0, 1]; far below 0 where the velocity is not admissible."""
    room, touch_s = _rolled_out(env, velocity, io)
    horizon = ti.static(io.dwa_cfg.horizon_s)
    speed = velocity.norm()
    fast = ti.min(ti.Vector([velocity[0], velocity[1]]).norm(), ti.Vector([wanted[0], wanted[1]]).norm())
    heading = 0.5
    if speed > 0.02 and wanted.norm() > 0.02:
        heading = 1.0 - ti.acos(ti.math.clamp(velocity.dot(wanted) / (speed * wanted.norm()), -1.0, 1.0)) * (
            1.0 / PI
        )
    free = 0.5 + 0.5 * ti.math.clamp(room / _CLEAR_M, 0.0, 1.0)
    if touch_s < FAR_M:
        free = 0.5 * touch_s / horizon
    out = (
        ti.static(io.dwa_cfg.weight_heading) * heading
        + ti.static(io.dwa_cfg.weight_clearance) * free
        + fast * ti.static(1.0 / io.behavior_cfg.cruise_m_s)
    )
    # v^2 <= 2 a d with d = v t: in time to come to rest
    if touch_s < 0.5 * speed * ti.static(1.0 / ACCELERATION_M_S2):
        out = _FORBIDDEN + touch_s + 10.0 * room
    return out


@ti.func
def _rolled_out(env, velocity, io: Bundle[LocalPlannerIO]):
    """(smallest distance [m] beyond the wanted clearance, time [s] until it is below 0, FAR_M = never).

    A mapped obstacle that is too near already counts only where it comes nearer.
    """
    dt, lag = ti.static(io.tracking_cfg.forecast_dt_s, io.behavior_cfg.lag_s)
    n_sample = ti.static(
        min(io.forecast.radius_m.shape[2] - 1, round(io.dwa_cfg.horizon_s / io.tracking_cfg.forecast_dt_s))
    )
    pos, own = io.ego.pos_w[env], turned_z3(io.ego.vel_b[env], io.ego.rpy[env][2])
    here = mapped_m(env, pos, io)
    wanted_static = ti.min(ti.static(io.baselines_cfg.static_margin_m), here)
    room, touch_s, decay = FAR_M, FAR_M, 1.0
    for k in range(1, n_sample + 1):
        decay *= ti.static(2.718281828459045 ** (-io.tracking_cfg.forecast_dt_s / io.behavior_cfg.lag_s))
        settle = lag * (1.0 - decay)
        at = pos + own * settle + velocity * (k * dt - settle)
        free = nearest_obstacle_m(env, k, at, io) - ti.static(io.dwa_cfg.margin_m)
        mapped = mapped_m(env, at, io) - wanted_static
        smaller = ti.min(free, mapped)
        room = ti.min(room, smaller)
        if smaller < 0.0 and touch_s == FAR_M:
            touch_s = k * dt
    return room, touch_s
