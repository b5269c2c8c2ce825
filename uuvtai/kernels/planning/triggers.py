"""When to plan again (the paper, Sec. III-B). Each trigger rests for min_replan_s after it was served; one of them is counted per replan.

- initial: there is no route.
- stuck: slower than stuck_speed_m_s for stuck_s, farther from the goal than its radius.
- safety: a sonar return nearer than safety_range_m, or range / closing speed below safety_ttc_s.
- intersection: a point of the look-ahead segment is not traversable any more, or a forecast body comes closer to the segment than
  forecast_clearance_m at a time when the vehicle could be there: the part of the segment within reach_speed_m_s times that time.
"""

import taichi as ti

from uuvtai.config import EpisodeConfig, MappingConfig, RouteConfig, TankConfig, TrackingConfig, VoronoiConfig
from uuvtai.kernels.core.grid import cell_of
from uuvtai.kernels.core.lanes import LANES, i16x
from uuvtai.kernels.core.signature import Const, In, Out, quick_launch, spread
from uuvtai.kernels.planning.along import advanced_arc, level, look_along
from uuvtai.kernels.planning.traversable import is_traversable
from uuvtai.plan_codes import (
    FAIL_NONE,
    N_TRIGGER,
    TRIGGER_INITIAL,
    TRIGGER_INTERSECTION,
    TRIGGER_NONE,
    TRIGGER_SAFETY,
    TRIGGER_STUCK,
)
from uuvtai.state import ClearanceState, ClockState, ForecastState, GridMask, MapState, MissionState, Proprioception, RouteState, SonarScan


@quick_launch
@ti.kernel
def fire_triggers(
    route: Out[RouteState],
    clearance: In[ClearanceState],
    grid_map: In[MapState],
    mask: In[GridMask],
    forecast: In[ForecastState],
    scan: In[SonarScan],
    ego: In[Proprioception],
    mission: In[MissionState],
    clock: In[ClockState],
    cfg: Const[RouteConfig],
    voronoi_cfg: Const[VoronoiConfig],
    tracking_cfg: Const[TrackingConfig],
    mapping_cfg: Const[MappingConfig],
    tank_cfg: Const[TankConfig],
    episode_cfg: Const[EpisodeConfig],
):
    """Move the foot along the route, find the triggers that hold, and queue the envs that plan in this step in the order of their ids."""
    n = ti.static(clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and clock.awake[env] == 1:
            if route.n_way[env] > 0:
                route.arc[env] = advanced_arc(route, env, level(ego.pos_w[env]), cfg)
            look_along(route, env, level(ego.pos_w[env]), cfg, mapping_cfg)
            _count_stuck(env, route, ego, mission, cfg, episode_cfg)
            holding = _held_triggers(
                env,
                route,
                clearance,
                grid_map,
                mask,
                forecast,
                scan,
                clock,
                cfg,
                voronoi_cfg,
                tracking_cfg,
                mapping_cfg,
                tank_cfg,
                episode_cfg,
            )
            _serve(env, holding, route, clock)
    for _ in range(1):
        count = 0
        for env in range(n):
            if clock.awake[env] == 1 and route.want_plan[env] == 1:
                route.queue[count] = env
                count += 1
        route.n_queue[None] = count
        route.n_failed[None] = 0


@ti.func
def _count_stuck(
    env,
    route: Out[RouteState],
    ego: In[Proprioception],
    mission: In[MissionState],
    cfg: Const[RouteConfig],
    episode_cfg: Const[EpisodeConfig],
):
    slow = ego.vel_b[env].norm() < ti.static(cfg.stuck_speed_m_s)
    away = (mission.goal_w[env] - ego.pos_w[env]).norm() > ti.static(episode_cfg.goal_radius_m)
    route.stuck_steps[env] = ti.select(slow and away, route.stuck_steps[env] + 1, 0)


@ti.func
def _held_triggers(
    env,
    route: In[RouteState],
    clearance: In[ClearanceState],
    grid_map: In[MapState],
    mask: In[GridMask],
    forecast: In[ForecastState],
    scan: In[SonarScan],
    clock: In[ClockState],
    cfg: Const[RouteConfig],
    voronoi_cfg: Const[VoronoiConfig],
    tracking_cfg: Const[TrackingConfig],
    mapping_cfg: Const[MappingConfig],
    tank_cfg: Const[TankConfig],
    episode_cfg: Const[EpisodeConfig],
):
    """Bit set (bit = code - 1) of the triggers that hold and are not resting."""
    dt = ti.static(episode_cfg.control_dt_s)
    bits = 0
    for trigger in ti.static(range(TRIGGER_INITIAL, N_TRIGGER + 1)):
        holds = False
        if (clock.step[env] - route.served_step[env, trigger - 1]) * dt >= ti.static(cfg.min_replan_s - 0.5 * episode_cfg.control_dt_s):
            if ti.static(trigger == TRIGGER_INITIAL):
                holds = route.n_way[env] == 0
            elif ti.static(trigger == TRIGGER_STUCK):
                holds = route.stuck_steps[env] * dt >= ti.static(cfg.stuck_s - 0.5 * episode_cfg.control_dt_s)
            elif ti.static(trigger == TRIGGER_SAFETY):
                holds = _feels_near(env, scan, cfg)
            elif ti.static(trigger == TRIGGER_INTERSECTION):
                holds = route.n_way[env] > 0 and (
                    _path_is_closed(env, route, clearance, grid_map, mask, voronoi_cfg, mapping_cfg, tank_cfg)
                    or _path_meets_forecast(env, route, forecast, cfg, tracking_cfg, mapping_cfg)
                )
        bits |= ti.select(holds, 1 << (trigger - 1), 0)
    return bits


@ti.func
def _feels_near(env, scan: In[SonarScan], cfg: Const[RouteConfig]):
    """True where a return is near or will soon be reached."""
    near = 0
    for packet in range(ti.static(scan.range_m.shape[1] // LANES)):
        urgent = i16x(0)
        for i in ti.static(range(LANES)):
            beam = packet * LANES + i
            gap = scan.range_m[env, beam]
            soon = -scan.doppler_m_s[env, beam] * ti.static(cfg.safety_ttc_s) > gap
            urgent[i] = ti.cast((scan.hit[env, beam] == 1) & (soon | (gap < ti.static(cfg.safety_range_m))), ti.i32)
        near |= urgent.max()
    return near == 1


@ti.func
def _path_is_closed(
    env,
    route: In[RouteState],
    clearance: In[ClearanceState],
    grid_map: In[MapState],
    mask: In[GridMask],
    voronoi_cfg: Const[VoronoiConfig],
    mapping_cfg: Const[MappingConfig],
    tank_cfg: Const[TankConfig],
):
    """True where a point of the look-ahead segment lies in a cell that is not traversable."""
    closed = False
    for k in range(route.n_ahead[env]):
        cell = cell_of(route.ahead_w[env, k], tank_cfg, mapping_cfg.cell_m)
        row = ti.math.clamp(cell[0], 0, ti.static(mask.outside.shape[0] - 1))
        col = ti.math.clamp(cell[1], 0, ti.static(mask.outside.shape[1] - 1))
        if not is_traversable(clearance, grid_map, mask, env, row, col, voronoi_cfg, mapping_cfg):
            closed = True
    return closed


@ti.func
def _path_meets_forecast(
    env,
    route: In[RouteState],
    forecast: In[ForecastState],
    cfg: Const[RouteConfig],
    tracking_cfg: Const[TrackingConfig],
    mapping_cfg: Const[MappingConfig],
):
    """True where a body comes too close to the part of the look-ahead segment that the vehicle can have reached by then."""
    meets = False
    per_step = ti.static(cfg.reach_speed_m_s * tracking_cfg.forecast_dt_s)
    for track in range(forecast.radius_m.shape[1]):
        if forecast.radius_m[env, track, 0] >= 0 and not meets:  # a track is forecast at all steps or at none
            for k in range(forecast.radius_m.shape[2]):
                limit = forecast.radius_m[env, track, k] + ti.static(cfg.forecast_clearance_m)
                body = forecast.pos_w[env, track, k]
                reach = k * per_step
                if (body - route.ahead_w[env, 0]).norm() < reach + ti.static(mapping_cfg.cell_m) + limit:
                    last = ti.min(ti.cast(reach / ti.static(mapping_cfg.cell_m), ti.i32) + 1, route.n_ahead[env] - 1)
                    for j in range(last + 1):
                        if (body - route.ahead_w[env, j]).norm() < limit:
                            meets = True
    return meets


@ti.func
def _serve(env, holding, route: Out[RouteState], clock: In[ClockState]):
    """Ask for a plan, count the first trigger in the order of priority, and let all that hold rest."""
    route.fired[env] = holding
    route.trigger[env] = TRIGGER_NONE
    route.fallback_reason[env] = FAIL_NONE
    route.want_plan[env] = ti.cast(holding != 0, ti.i32)
    for trigger in ti.static(range(N_TRIGGER, 0, -1)):
        if holding & (1 << (trigger - 1)) != 0:
            route.trigger[env] = trigger
            route.served_step[env, trigger - 1] = clock.step[env]
    if holding & (1 << (TRIGGER_STUCK - 1)) != 0:
        route.stuck_steps[env] = 0
    if holding != 0:
        route.replans[env, route.trigger[env] - 1] += 1
