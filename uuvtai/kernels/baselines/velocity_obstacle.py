"""Velocity obstacles after Fiorini and Shiller, "Motion Planning in Dynamic Environments Using Velocity
Obstacles", International Journal of Robotics Research 17(7), 1998.

A velocity lies in an obstacle's cone if it meets the obstacle, grown by the hull, within the horizon, while
the obstacle goes straight on. Of the velocities that can be reached and lie outside all cones the one nearest
to the wanted velocity is driven. Adapted: the vehicle's lag (a new velocity v leads to where it would if the
vehicle began to drive it from x + (v0 - v) lag); obstacles that it passes above or below have no cone; mapped
obstacles and walls forbid the velocities that come too near to them; where every velocity is in a cone, the
one that collides last is driven (the paper leaves that to the designer).
"""

import taichi as ti

from uuvtai.compile.launch import quick_launch
from uuvtai.kernels.baselines.io import LocalPlannerIO
from uuvtai.kernels.baselines.local_planner import (
    decides,
    free_water_m,
    mapped_m,
    reachable_velocity,
    wanted_velocity,
)
from uuvtai.kernels.core.geometry import FAR_M, turned_z3
from uuvtai.kernels.core.stage import Bundle, loop_end

_FORBIDDEN = 100.0
"""Cost above that of every velocity outside all cones."""

_MAP_STEP_S = 0.1
"""Spacing of the samples at which the map is asked: no more than 0.085 m at full speed."""


@quick_launch
@ti.kernel
def plan_velocity_obstacle(io: Bundle[LocalPlannerIO]):
    """Velocity of least cost for the rows that decide in this step."""
    n, n_trial = ti.static(io.clock.active.shape[0], io.baselines_cfg.n_reachable)
    window_s = ti.static(io.obstacle_cfg.window_s)
    for env, trial in ti.ndrange(loop_end(n, io.clock), n_trial):
        if decides(env, io):
            io.baselines.score[env, trial] = _cost(env, reachable_velocity(env, trial, window_s, io), io)
    for env in range(loop_end(n, io.clock)):
        if decides(env, io):
            best = n_trial - 1
            for back in range(1, n_trial):
                trial = n_trial - 1 - back
                if io.baselines.score[env, trial] < io.baselines.score[env, best]:
                    best = trial
            io.baselines.vel_w[env] = reachable_velocity(env, best, window_s, io)


@ti.func
def _cost(env, velocity, io: Bundle[LocalPlannerIO]):
    """Difference from the wanted velocity [m/s]; in a cone far more, and the more the sooner it collides."""
    hit_s = _map_hit_s(env, velocity, io)
    for track in range(ti.static(io.forecast.radius_m.shape[1])):
        if io.forecast.radius_m[env, track, 0] >= 0:
            hit_s = ti.min(hit_s, _obstacle_hit_s(env, track, velocity, io))
    out = (velocity - wanted_velocity(env, io)).norm()
    if hit_s < FAR_M:
        out = _FORBIDDEN + out - 10.0 * hit_s
    return out


@ti.func
def _obstacle_hit_s(env, track, velocity, io: Bundle[LocalPlannerIO]):
    """Time [s] at which a velocity meets an obstacle's grown outline within the horizon; FAR_M = outside its
    cone.

    Where it is inside at once: the depth [m] below 0, so that the least deep is the best of bad ones. Who is
    nearer than the margin already keeps what is left of it.
    """
    pos, own = io.ego.pos_w[env], turned_z3(io.ego.vel_b[env], io.ego.rpy[env][2])
    begin = pos + (own - velocity) * ti.static(io.behavior_cfg.lag_s)
    state, obstacle = io.tracks.state[env, track], io.forecast.pos_w[env, track, 0]
    ahead = obstacle - ti.Vector([begin[0], begin[1]])
    closing = ti.Vector([velocity[0] - state[2], velocity[1] - state[3]])
    touch = io.forecast.radius_m[env, track, 0] + ti.static(
        io.behavior_cfg.hull_reach_m + io.behavior_cfg.contact_m
    )
    kept = (obstacle - ti.Vector([pos[0], pos[1]])).norm() - touch
    reach = touch + ti.math.clamp(kept, 0.0, ti.static(io.obstacle_cfg.margin_m))
    speed2, along = closing.norm_sqr(), ahead.dot(closing)
    depth = reach - ahead.norm()
    root = along * along - speed2 * (ahead.norm_sqr() - reach * reach)
    out = FAR_M
    if depth > 0.0:
        if along > 0.0 or speed2 < 1.0e-8:
            out = -depth
    elif root > 0.0 and along > 0.0:
        out = (along - ti.sqrt(root)) / speed2
    if out < FAR_M:
        last = (along + ti.sqrt(ti.max(root, 0.0))) / ti.max(speed2, 1.0e-8)
        until = ti.min(last, ti.static(io.obstacle_cfg.horizon_s))
        if out > until or _passes(env, track, begin[2], velocity[2], ti.max(out, 0.0), until, io):
            out = FAR_M
    return out


@ti.func
def _passes(env, track, z, heave, first_s, last_s, io: Bundle[LocalPlannerIO]):
    """Whether the hull is clear above or below the obstacle from ``first_s`` to ``last_s``: free water has no
    corners, so both ends decide."""
    needed = ti.static(io.behavior_cfg.hull_reach_m + io.behavior_cfg.contact_m + io.obstacle_cfg.margin_m)
    first = free_water_m(env, track, z + heave * first_s, io)
    last = free_water_m(env, track, z + heave * last_s, io)
    return ti.min(first, last) > needed


@ti.func
def _map_hit_s(env, velocity, io: Bundle[LocalPlannerIO]):
    """Time [s] at which a velocity comes too near to a mapped obstacle or wall, and nearer than now; FAR_M =
    never."""
    n_sample = ti.static(max(1, round(io.obstacle_cfg.static_horizon_s / _MAP_STEP_S)))
    pos, own = io.ego.pos_w[env], turned_z3(io.ego.vel_b[env], io.ego.rpy[env][2])
    lag = ti.static(io.behavior_cfg.lag_s)
    here = mapped_m(env, pos, io)
    wanted = ti.min(ti.static(io.baselines_cfg.static_margin_m), here)
    out = FAR_M
    for k in range(1, n_sample + 1):
        time = k * _MAP_STEP_S
        settle = lag * (1.0 - ti.exp(-time / lag))
        at = pos + own * settle + velocity * (time - settle)
        if out == FAR_M and (mapped_m(env, at, io) < wanted):
            out = time
    return out
