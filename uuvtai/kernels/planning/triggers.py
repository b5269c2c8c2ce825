"""When to plan again (the paper, Sec. III-B). Each trigger rests for min_replan_s after it was served; one of
them is counted per replan.

- initial: there is no route.
- stuck: slower than 0.08 m/s for stuck_s, farther from the goal than its radius.
- safety: a sonar return nearer than safety_range_m, or range / closing speed below safety_ttc_s.
- intersection: a point of the look-ahead segment is not traversable any more, or a forecast obstacle comes
  closer to the segment than 0.35 m at a time when the vehicle could be there: the part of the segment within
  reach_speed_m_s times that time.
"""

import taichi as ti

from uuvtai.common.enums import (
    FAIL_NONE,
    N_TRIGGER,
    TRIGGER_INITIAL,
    TRIGGER_INTERSECTION,
    TRIGGER_NONE,
    TRIGGER_SAFETY,
    TRIGGER_STUCK,
)
from uuvtai.compile.launch import quick_launch
from uuvtai.kernels.core.beams import range_rate
from uuvtai.kernels.core.simd import LANES, i16x
from uuvtai.kernels.core.stage import Bundle, n_envs
from uuvtai.kernels.planning.io import RouteIO
from uuvtai.kernels.planning.medial_axis import is_traversable, room_at
from uuvtai.kernels.planning.route import advanced_arc, cell_on_grid, level, look_along, risk_at

_STUCK_M_S, _FORECAST_CLEARANCE_M = 0.08, 0.35


@quick_launch
@ti.kernel
def fire_triggers(io: Bundle[RouteIO]):
    """Move the foot along the route, look along it, find the triggers that hold, and queue the envs that plan
    in this step, in any order."""
    io.route.n_queue[None] = 0
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
            if io.route.n_way[env] > 0:
                io.route.arc[env] = advanced_arc(io.route, env, level(io.ego.pos_w[env]))
            look_along(env, level(io.ego.pos_w[env]), io)
            _count_stuck(env, io)
            closed = _is_path_closed(env, io)
            holding = _held_triggers(env, closed, io)
            _serve(env, holding, io)
            if io.route.want_plan[env] == 1:
                io.route.queue[ti.atomic_add(io.route.n_queue[None], 1)] = env


@ti.func
def _count_stuck(env, io: Bundle[RouteIO]):
    slow = io.ego.vel_b[env].norm() < _STUCK_M_S
    away = (io.mission.goal_w[env] - io.ego.pos_w[env]).norm() > ti.static(io.episode_cfg.goal_radius_m)
    io.route.stuck_steps[env] = ti.select(slow and away, io.route.stuck_steps[env] + 1, 0)


@ti.func
def _held_triggers(env, closed, io: Bundle[RouteIO]):
    """Bit set (bit = code - 1) of the triggers that hold and are not static; ``closed``: the path is."""
    dt = ti.static(io.episode_cfg.control_dt_s)
    bits = 0
    for trigger in ti.static(range(TRIGGER_INITIAL, N_TRIGGER + 1)):
        holds = False
        if (io.clock.step[env] - io.route.served_step[env, trigger - 1]) * dt >= ti.static(
            io.route_cfg.min_replan_s - 0.5 * io.episode_cfg.control_dt_s
        ):
            if ti.static(trigger == TRIGGER_INITIAL):
                holds = io.route.n_way[env] == 0
            elif ti.static(trigger == TRIGGER_STUCK):
                holds = io.route.stuck_steps[env] * dt >= ti.static(
                    io.route_cfg.stuck_s - 0.5 * io.episode_cfg.control_dt_s
                )
            elif ti.static(trigger == TRIGGER_SAFETY):
                holds = _is_return_near(env, io)
            elif ti.static(trigger == TRIGGER_INTERSECTION):
                holds = io.route.n_way[env] > 0 and (closed or _path_meets_forecast(env, io))
        bits |= ti.select(holds, 1 << (trigger - 1), 0)
    return bits


@ti.func
def _is_return_near(env, io: Bundle[RouteIO]):
    """True where a return is near or will soon be reached."""
    near = 0
    for packet in range(ti.static(io.scan.range_m.shape[1] // LANES)):
        urgent = i16x(0)
        for i in ti.static(range(LANES)):
            beam = packet * LANES + i
            gap = io.scan.range_m[env, beam]
            rate = range_rate(env, beam, io.scan, io.tracks, io.sonar_cfg)
            soon = -rate * ti.static(io.route_cfg.safety_ttc_s) > gap
            urgent[i] = ti.cast(
                (io.scan.hit[env, beam] == 1) & (soon | (gap < ti.static(io.route_cfg.safety_range_m))),
                ti.i32,
            )
        near |= urgent.max()
    return near == 1


@ti.func
def _is_path_closed(env, io: Bundle[RouteIO]):
    """True where a point of the look-ahead segment lies in a cell that is not traversable; the segment's mean
    risk on the way, for the same cells hold both."""
    closed, risk = False, 0.0
    for k in range(io.route.n_ahead[env]):
        cell = cell_on_grid(io.route.ahead_w[env, k], io)
        room = room_at(env, cell[0], cell[1], io)
        if not is_traversable(env, cell[0], cell[1], room, io):
            closed = True
        risk += risk_at(env, cell, room, io)
    io.route.path_risk[env] = risk / io.route.n_ahead[env]
    return closed


@ti.func
def _path_meets_forecast(env, io: Bundle[RouteIO]):
    """True where an obstacle comes too close to the part of the look-ahead segment that the vehicle can have
    reached by then."""
    meets = False
    for track in range(io.forecast.radius_m.shape[1]):
        # a track is forecast at all steps or at none
        if io.forecast.radius_m[env, track, 0] >= 0 and not meets:
            for k in range(io.forecast.radius_m.shape[2]):
                if _obstacle_meets_path(env, track, k, io):
                    meets = True
    return meets


@ti.func
def _obstacle_meets_path(env, track, k, io: Bundle[RouteIO]):
    """The same for one obstacle at forecast step k.

    Points of the segment lie a cell apart, so those with an arc up to reach + one cell are looked at. None of
    them is farther from the first one than that: an obstacle beyond reach + cell + limit of it meets none.
    """
    meets = False
    limit = io.forecast.radius_m[env, track, k] + _FORECAST_CLEARANCE_M
    obstacle = io.forecast.pos_w[env, track, k]
    reach = k * ti.static(io.route_cfg.reach_speed_m_s * io.tracking_cfg.forecast_dt_s)
    if (obstacle - io.route.ahead_w[env, 0]).norm() < reach + ti.static(io.mapping_cfg.cell_m) + limit:
        last = ti.min(
            ti.cast(reach / ti.static(io.mapping_cfg.cell_m), ti.i32) + 1, io.route.n_ahead[env] - 1
        )
        for j in range(last + 1):
            if (obstacle - io.route.ahead_w[env, j]).norm() < limit:
                meets = True
    return meets


@ti.func
def _serve(env, holding, io: Bundle[RouteIO]):
    """Ask for a plan, count the first trigger in the order of priority, and let all that hold rest."""
    io.route.fired[env] = holding
    io.route.trigger[env] = TRIGGER_NONE
    io.route.fallback_reason[env] = FAIL_NONE
    io.route.want_plan[env] = ti.cast(holding != 0, ti.i32)
    for trigger in ti.static(range(N_TRIGGER, 0, -1)):
        if holding & (1 << (trigger - 1)) != 0:
            io.route.trigger[env] = trigger
            io.route.served_step[env, trigger - 1] = io.clock.step[env]
    if holding & (1 << (TRIGGER_STUCK - 1)) != 0:
        io.route.stuck_steps[env] = 0
    if holding != 0:
        io.route.replans[env, io.route.trigger[env] - 1] += 1
