"""Assessment of threats for the behaviour tree: what the sonar feels, what the map holds, and whether following the route conflicts."""

import taichi as ti

from uuvtai.config import EpisodeConfig, MappingConfig, TankConfig, TeacherConfig, TrackingConfig, VehicleConfig
from uuvtai.kernels.core.geometry import FAR_M, TWO_PI, turned_z3, wrapped_angle
from uuvtai.kernels.core.grid import cell_of, centre_of
from uuvtai.kernels.core.lanes import f16x
from uuvtai.kernels.core.signature import Const, In, Out, quick_launch, spread
from uuvtai.kernels.teacher.rollout import body_depths, depth_band, held_heave
from uuvtai.state import ClearanceState, ClockState, ForecastState, MissionState, Proprioception, RouteState, SonarScan, TeacherState

_PATH_SAMPLES = 8

_NEARER = 3
"""Points of the route before the look-ahead point that are tried where the straight way to it is narrow,"""
_NEARER_M = 0.2
"""[m] so far apart, from the foot of the route on."""


@quick_launch
@ti.kernel
def assess_threats(
    teacher: Out[TeacherState],
    route: In[RouteState],
    forecast: In[ForecastState],
    scan: In[SonarScan],
    clearance: In[ClearanceState],
    ego: In[Proprioception],
    mission: In[MissionState],
    clock: In[ClockState],
    teacher_cfg: Const[TeacherConfig],
    vehicle_cfg: Const[VehicleConfig],
    tracking_cfg: Const[TrackingConfig],
    tank_cfg: Const[TankConfig],
    mapping_cfg: Const[MappingConfig],
    episode_cfg: Const[EpisodeConfig],
):
    """Fill the blackboard, and decide which envs must plan an evasion in this step."""
    n = ti.static(clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and clock.awake[env] == 1:
            if scan.fresh[env] == 1:
                _sense_contact(env, teacher, scan, ego, teacher_cfg)
            _read_clearance(env, teacher, route, clearance, ego, teacher_cfg, tank_cfg, mapping_cfg)
            _follow_velocity(env, teacher, route, ego, teacher_cfg)
            _foresee_conflict(env, teacher, forecast, ego, mission, clock, teacher_cfg, vehicle_cfg, tracking_cfg, tank_cfg, episode_cfg)


@ti.func
def _sense_contact(env, teacher: Out[TeacherState], scan: In[SonarScan], ego: In[Proprioception], cfg: Const[TeacherConfig]):
    """Smallest time to contact and nearest return. Two neighbouring beams must agree on a time, so that one outlier is no emergency."""
    n_ray = ti.static(scan.range_m.shape[1])
    ttc, threat, nearest, nearest_beam = FAR_M, 0, FAR_M, 0
    before = _beam_ttc(env, n_ray - 1, scan, cfg)
    for beam in range(n_ray):
        own = _beam_ttc(env, beam, scan, cfg)
        agreed = ti.max(own, before)
        before = own
        if agreed < ttc:
            ttc = agreed
            threat = beam
        if scan.hit[env, beam] == 1:
            gap = scan.range_m[env, beam]
            if gap < nearest:
                nearest = gap
                nearest_beam = beam
    turned = scan.ping_yaw[env] - ego.rpy[env][2]
    teacher.ttc_s[env] = ttc
    teacher.threat_bearing[env] = wrapped_angle(turned + TWO_PI * threat / n_ray)
    teacher.nearest_m[env] = nearest - ti.static(cfg.hull_reach_m)
    teacher.nearest_bearing[env] = wrapped_angle(turned + TWO_PI * nearest_beam / n_ray)


@ti.func
def _beam_ttc(env, beam, scan: In[SonarScan], cfg: Const[TeacherConfig]):
    """Time until what the beam hit reaches the hull's contact distance; FAR_M where it does not approach."""
    closing = -scan.doppler_m_s[env, beam]
    out = FAR_M
    if scan.hit[env, beam] == 1 and closing > ti.static(cfg.emergency_closing_m_s):
        out = ti.max(scan.range_m[env, beam] - ti.static(cfg.hull_reach_m + cfg.contact_m), 0.0) / closing
    return out


@ti.func
def _read_clearance(
    env,
    teacher: Out[TeacherState],
    route: In[RouteState],
    clearance: In[ClearanceState],
    ego: In[Proprioception],
    teacher_cfg: Const[TeacherConfig],
    tank_cfg: Const[TankConfig],
    mapping_cfg: Const[MappingConfig],
):
    """Mapped clearance here, the way out of it, and the smallest one up to the look-ahead point."""
    pos = ego.pos_w[env]
    n_row, n_col = ti.static(clearance.clearance_m.shape[1], clearance.clearance_m.shape[2])
    cell = _held_cell(pos, n_row, n_col, tank_cfg, mapping_cfg)
    teacher.clearance_m[env] = clearance.clearance_m[env, cell[0], cell[1]]
    away = ti.Vector([0.0, 0.0])
    if clearance.site_row[env, cell[0], cell[1]] >= 0:
        site = centre_of(
            ti.cast(clearance.site_row[env, cell[0], cell[1]], ti.i32),
            ti.cast(clearance.site_col[env, cell[0], cell[1]], ti.i32),
            tank_cfg,
            ti.static(mapping_cfg.cell_m),
        )
        away = _unit(ti.Vector([pos[0] - site[0], pos[1] - site[1]]))
    teacher.away_w[env] = away
    here = ti.Vector([pos[0], pos[1]])
    steer, room = ti.Vector([route.lookahead_w[env][0], route.lookahead_w[env][1]]), teacher.clearance_m[env]
    if route.n_way[env] > 0:
        room = _room_to(env, here, steer, teacher.clearance_m[env], clearance, tank_cfg, mapping_cfg)
        for nearer in range(_NEARER):
            nth = (_NEARER - nearer) * ti.static(round(_NEARER_M / mapping_cfg.cell_m))
            if (
                room < ti.static(teacher_cfg.hull_reach_m + teacher_cfg.contact_m + teacher_cfg.static_margin_m)
                and nth < route.n_ahead[env]
            ):
                point = route.ahead_w[env, nth]
                wider = _room_to(env, here, point, teacher.clearance_m[env], clearance, tank_cfg, mapping_cfg)
                if wider > room:
                    steer, room = point, wider
    teacher.path_clearance_m[env] = room
    teacher.steer_w[env] = steer - here


@ti.func
def _room_to(env, here, there, own, clearance: In[ClearanceState], tank_cfg: Const[TankConfig], mapping_cfg: Const[MappingConfig]):
    """Smallest mapped clearance [m] on the straight way to a place, the own one included."""
    n_row, n_col = ti.static(clearance.clearance_m.shape[1], clearance.clearance_m.shape[2])
    smallest = own
    for k in range(1, _PATH_SAMPLES + 1):
        on_way = _held_cell(here + (there - here) * (k / _PATH_SAMPLES), n_row, n_col, tank_cfg, mapping_cfg)
        smallest = ti.min(smallest, clearance.clearance_m[env, on_way[0], on_way[1]])
    return smallest


@ti.func
def _held_cell(pos, n_row, n_col, tank_cfg: Const[TankConfig], mapping_cfg: Const[MappingConfig]):
    cell = cell_of(pos, tank_cfg, ti.static(mapping_cfg.cell_m))
    return ti.Vector([ti.math.clamp(cell[0], 0, n_row - 1), ti.math.clamp(cell[1], 0, n_col - 1)])


@ti.func
def _unit(v):
    return v / ti.max(v.norm(), 1.0e-6)


@ti.func
def _follow_velocity(env, teacher: Out[TeacherState], route: In[RouteState], ego: In[Proprioception], cfg: Const[TeacherConfig]):
    """Level velocity towards the point that is steered for, slower in narrow places; zero without a route."""
    level = teacher.steer_w[env]
    room = (teacher.clearance_m[env] - ti.static(cfg.hull_reach_m + cfg.contact_m)) / ti.static(cfg.slow_clearance_m)
    share = ti.static(cfg.slow_fraction) + ti.static(1.0 - cfg.slow_fraction) * ti.math.clamp(room, 0.0, 1.0)
    askew = ti.abs(ti.sin(ti.atan2(level[1], level[0]) - ego.rpy[env][2]))
    if teacher.path_clearance_m[env] < ti.static(cfg.askew_clearance_m):  # across the way the hull is wider: let it turn first
        share *= 1.0 - 0.6 * askew
    speed = ti.select(route.n_way[env] > 0, ti.static(cfg.cruise_m_s) * share, 0.0)
    wanted = _unit(level) * speed
    teacher.follow_vel_w[env] = ti.Vector([wanted[0], wanted[1], teacher.follow_vel_w[env][2]])


@ti.func
def _foresee_conflict(
    env,
    teacher: Out[TeacherState],
    forecast: In[ForecastState],
    ego: In[Proprioception],
    mission: In[MissionState],
    clock: In[ClockState],
    teacher_cfg: Const[TeacherConfig],
    vehicle_cfg: Const[VehicleConfig],
    tracking_cfg: Const[TrackingConfig],
    tank_cfg: Const[TankConfig],
    episode_cfg: Const[EpisodeConfig],
):
    """Roll the follow velocity out against the forecasts, in decision steps only, with and without a change of depth; and a stop.

    Depth is changed towards the goal's only where that comes no nearer to any body: what is above or below is easily forgotten.
    """
    teacher.want_evade[env] = 0
    teacher.calm_steps[env] += 1
    if clock.step[env] % ti.static(teacher_cfg.decide_period_steps) == 0:
        pos, vel = ego.pos_w[env], turned_z3(ego.vel_b[env], ego.rpy[env][2])
        follow = teacher.follow_vel_w[env]
        low, high = ti.static(depth_band(tank_cfg, teacher_cfg))
        heave = held_heave(ti.math.clamp(mission.goal_w[env][2], low, high) - pos[2], teacher_cfg, vehicle_cfg)
        cz = f16x(0.0)
        cz[1] = heave
        cx, cy = f16x(follow[0]), f16x(follow[1])
        cx[2], cy[2] = 0.0, 0.0
        peak, _, _, first = body_depths(env, cx, cy, cz, FAR_M, pos, vel, forecast, teacher_cfg, tracking_cfg, tank_cfg)
        climbs = peak[1] <= peak[0] + 1.0e-3
        teacher.follow_vel_w[env][2] = ti.select(climbs, heave, 0.0)
        teacher.conflict_s[env] = ti.select(climbs, first[1], first[0])
        teacher.hold_conflict_s[env] = first[2]
        gap, way = _nearest_body(env, pos, forecast, teacher_cfg)
        teacher.body_near_m[env] = gap
        teacher.gaze_w[env] = way * ti.cast(teacher.path_clearance_m[env] > ti.static(teacher_cfg.gaze_clearance_m), ti.f32)
        if teacher.conflict_s[env] < FAR_M:
            teacher.calm_steps[env] = 0
        calm = teacher.calm_steps[env] * ti.static(episode_cfg.control_dt_s)
        urgent = teacher.ttc_s[env] < ti.static(teacher_cfg.emergency_ttc_s)
        if teacher.conflict_s[env] < FAR_M or urgent or (teacher.evading_steps[env] > 0 and calm <= ti.static(teacher_cfg.calm_s + 0.2)):
            teacher.want_evade[env] = 1


@ti.func
def _nearest_body(env, pos, forecast: In[ForecastState], cfg: Const[TeacherConfig]):
    """(distance [m] from the hull to the nearest forecast body, horizontal way [m] to the one that needs to be looked at).

    A body above or below the sonar's fan needs it most. FAR_M and zero where there is none.
    """
    nearest, need, way = FAR_M, ti.static(cfg.gaze_m), ti.Vector([0.0, 0.0])
    for track in range(ti.static(forecast.radius_m.shape[1])):
        radius = forecast.radius_m[env, track, 0]
        if radius >= 0:
            off = forecast.pos_w[env, track, 0] - ti.Vector([pos[0], pos[1]])
            gap = off.norm() - radius - ti.static(cfg.hull_reach_m)
            nearest = ti.min(nearest, gap)
            level = forecast.above_w[env, track] <= pos[2] and forecast.below_w[env, track] >= pos[2]
            wanted = gap + ti.select(level, ti.static(cfg.gaze_level_m), 0.0)
            if wanted < need:
                need, way = wanted, off
    return nearest, way
