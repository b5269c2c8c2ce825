"""Artificial potential field after Khatib, "Real-Time Obstacle Avoidance for Manipulators and Mobile
Robots", International Journal of Robotics Research 5(1), 1986.

The goal pulls, and whatever is nearer than its reach pushes with FIRAS, gain (1 / d - 1 / reach) / d^2
along the way out. Adapted: the force is taken as the velocity to be commanded, for the inner loop is a
velocity loop; the pull is the velocity-limited one of the paper, towards the local goal; obstacles count
where they are now, whatever their velocity; of the mapped obstacles and walls the nearest pushes; an obstacle
that is known to be above or below pushes down or up too.
"""

import taichi as ti

from uuvtai.compile.launch import quick_launch
from uuvtai.kernels.baselines.io import LocalPlannerIO
from uuvtai.kernels.baselines.local_planner import (
    apart_m,
    decides,
    edge_stopped,
    free_water_m,
    mapped_m,
    speed_limited,
    wanted_velocity,
)
from uuvtai.kernels.core.stage import Bundle, n_envs

_STATIC_REACH_M = 0.3
"""Mapped obstacles and walls farther away push nobody."""
_STATIC_GAIN = 0.002
"""[m^4/s] of the push of the nearest mapped obstacle or wall."""
_LEAST_M = 0.05
"""Distances count as at least so much: the force stays finite."""


@quick_launch
@ti.kernel
def plan_potential_field(io: Bundle[LocalPlannerIO]):
    """Velocity along the sum of pull and pushes for the rows that decide in this step."""
    for env in range(n_envs(io.clock)):
        if decides(env, io):
            pull = wanted_velocity(env, io)
            force = pull + _push_of_obstacles(env, io) + _push_of_map(env, io)
            heave = ti.static(io.baselines_cfg.heave_m_s)
            if ti.static(heave > 0):
                force[2] = edge_stopped(ti.math.clamp(force[2], -heave, heave), io.ego.pos_w[env][2], io)
            else:
                force[2] = pull[2]
            io.baselines.vel_w[env] = speed_limited(force, io.ego.rpy[env][2], io)


@ti.func
def _firas(distance_m, reach_m, gain):
    """Size [m/s] of the push at a distance; 0 from ``reach_m`` on."""
    near = ti.max(distance_m, _LEAST_M)
    return gain * ti.max(1.0 / near - 1.0 / reach_m, 0.0) / (near * near)


@ti.func
def _push_of_obstacles(env, io: Bundle[LocalPlannerIO]):
    pos, push = io.ego.pos_w[env], ti.Vector([0.0, 0.0, 0.0])
    for track in range(ti.static(io.forecast.radius_m.shape[1])):
        radius = io.forecast.radius_m[env, track, 0]
        if radius >= 0:
            off = ti.Vector([pos[0], pos[1]]) - io.forecast.pos_w[env, track, 0]
            middle = ti.max(off.norm(), 1.0e-6)
            gap = free_water_m(env, track, pos[2], io)
            apart = apart_m(middle - radius, gap)
            # the obstacle's surface is ``apart`` away, most of it on the level or most of it up or down
            rise = ti.select(gap > 0.0, gap / ti.max(apart, 1.0e-6), 0.0)
            out = off / middle * ti.sqrt(ti.max(1.0 - rise * rise, 0.0))
            is_above = io.forecast.above_w[env, track] - pos[2] < pos[2] - io.forecast.below_w[env, track]
            size = _firas(
                apart - ti.static(io.behavior_cfg.hull_reach_m + io.behavior_cfg.contact_m),
                ti.static(io.field_cfg.reach_m),
                ti.static(io.field_cfg.gain),
            )
            push += size * ti.Vector([out[0], out[1], ti.select(is_above, -rise, rise)])
    return push


@ti.func
def _push_of_map(env, io: Bundle[LocalPlannerIO]):
    """From the nearest mapped obstacle or wall, on the level."""
    away = io.behavior.away_w[env]
    room = mapped_m(env, io.ego.pos_w[env], io)
    size = _firas(room, _STATIC_REACH_M, _STATIC_GAIN)
    return size * ti.Vector([away[0], away[1], 0.0])
