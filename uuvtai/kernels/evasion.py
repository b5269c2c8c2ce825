"""Search for an evasive velocity: headings times speeds, stop, the last command and the follow velocity, rolled out in packets."""

import taichi as ti

from uuvtai.config import MappingConfig, TankConfig, TeacherConfig, TrackingConfig, VehicleConfig
from uuvtai.kernels.geometry import FAR_M, TWO_PI, turned_z
from uuvtai.kernels.lanes import LANES, f16x
from uuvtai.kernels.rollout import body_depths, static_depths
from uuvtai.kernels.signature import Const, In, Out, spread
from uuvtai.state import ClearanceState, ClockState, ForecastState, Proprioception, TeacherState


@ti.kernel
def plan_evasion(
    teacher: Out[TeacherState],
    forecast: In[ForecastState],
    clearance: In[ClearanceState],
    ego: In[Proprioception],
    clock: In[ClockState],
    teacher_cfg: Const[TeacherConfig],
    vehicle_cfg: Const[VehicleConfig],
    tracking_cfg: Const[TrackingConfig],
    tank_cfg: Const[TankConfig],
    mapping_cfg: Const[MappingConfig],
):
    """Best evasive velocity of the envs with ``want_evade``: the softmax mean of the candidates where that is as good as the best one."""
    n, n_packet = ti.static(clock.awake.shape[0], teacher.candidate_cost.shape[1] // LANES)
    for env, packet in ti.ndrange(n, n_packet):
        if clock.awake[env] == 1 and teacher.want_evade[env] == 1:
            cx, cy = candidate_lanes(env, packet * LANES, teacher, ego, teacher_cfg, vehicle_cfg)
            cost = cost_lanes(env, cx, cy, teacher, forecast, clearance, ego, teacher_cfg, tracking_cfg, tank_cfg, mapping_cfg)
            for i in ti.static(range(LANES)):
                teacher.candidate_cost[env, packet * LANES + i] = cost[i]
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and clock.awake[env] == 1 and teacher.want_evade[env] == 1:
            best_x, best_y, mean_x, mean_y = _chosen(env, teacher, ego, teacher_cfg, vehicle_cfg)
            cx, cy = f16x(best_x), f16x(best_y)
            cx[1], cy[1] = mean_x, mean_y
            cost = cost_lanes(env, cx, cy, teacher, forecast, clearance, ego, teacher_cfg, tracking_cfg, tank_cfg, mapping_cfg)
            good = cost[1] <= cost[0] + ti.static(teacher_cfg.softness)
            teacher.evade_vel_w[env] = ti.Vector([ti.select(good, mean_x, best_x), ti.select(good, mean_y, best_y), 0.0])
            teacher.evade_cost[env] = ti.select(good, cost[1], cost[0])


@ti.func
def candidate_lanes(
    env, first, teacher: In[TeacherState], ego: In[Proprioception], teacher_cfg: Const[TeacherConfig], vehicle_cfg: Const[VehicleConfig]
):
    """World velocities (lanes x, y [m/s]) of candidates first .. first + 15."""
    cx, cy = f16x(0.0), f16x(0.0)
    for i in ti.static(range(LANES)):
        velocity = candidate(env, first + i, teacher, ego, teacher_cfg, vehicle_cfg)
        cx[i], cy[i] = velocity[0], velocity[1]
    return cx, cy


@ti.func
def candidate(
    env, index, teacher: In[TeacherState], ego: In[Proprioception], teacher_cfg: Const[TeacherConfig], vehicle_cfg: Const[VehicleConfig]
):
    """World velocity of one candidate. Heading 0 is the follow direction, so that slowing down on the route is among them."""
    n_heading, n_speed = ti.static(teacher_cfg.n_heading, teacher_cfg.n_speed)
    follow, last = teacher.follow_vel_w[env], teacher.last_vel_w[env]
    out = ti.Vector([0.0, 0.0])
    if index < n_heading * n_speed:
        heading = ti.atan2(follow[1], follow[0]) + TWO_PI * (index % n_heading) / n_heading
        top = ti.min(ti.static(teacher_cfg.evade_m_s), speed_limit(heading - ego.rpy[env][2], vehicle_cfg))
        speed = top * (index // n_heading + 1) / n_speed
        out = ti.Vector([ti.cos(heading), ti.sin(heading)]) * speed
    elif index == n_heading * n_speed + 1:
        out = ti.Vector([last[0], last[1]])
    elif index == n_heading * n_speed + 2:
        out = ti.Vector([follow[0], follow[1]])
    return out


@ti.func
def speed_limit(angle, cfg: Const[VehicleConfig]):
    """Fastest level speed in a direction of the body frame: surge and sway are limited one by one, so diagonals are faster."""
    along = ti.abs(ti.cos(angle)) / ti.static(cfg.max_surge_m_s)
    across = ti.abs(ti.sin(angle)) / ti.static(cfg.max_sway_m_s)
    return 1.0 / ti.max(along, across)


@ti.func
def cost_lanes(
    env,
    cx,
    cy,
    teacher: In[TeacherState],
    forecast: In[ForecastState],
    clearance: In[ClearanceState],
    ego: In[Proprioception],
    teacher_cfg: Const[TeacherConfig],
    tracking_cfg: Const[TrackingConfig],
    tank_cfg: Const[TankConfig],
    mapping_cfg: Const[MappingConfig],
):
    """Cost of sixteen commanded velocities. Violations count by depth: a flat penalty drives straight on when every candidate is bad."""
    pos = ti.Vector([ego.pos_w[env][0], ego.pos_w[env][1]])
    vel = turned_z(ti.Vector([ego.vel_b[env][0], ego.vel_b[env][1]]), ego.rpy[env][2])
    peak, mean, contact, _ = body_depths(env, cx, cy, pos, vel, forecast, teacher_cfg, tracking_cfg)
    static_mean, static_contact = static_depths(env, cx, cy, pos, vel, clearance, teacher_cfg, tank_cfg, mapping_cfg)
    off = _distance_lanes(cx, cy, teacher.follow_vel_w[env]) * ti.static(teacher_cfg.weight_deviation / teacher_cfg.cruise_m_s)
    change = _distance_lanes(cx, cy, teacher.last_vel_w[env]) * ti.static(teacher_cfg.weight_change / teacher_cfg.cruise_m_s)
    moving = peak * ti.static(teacher_cfg.weight_peak) + mean * ti.static(teacher_cfg.weight_mean)
    touching = contact * ti.static(teacher_cfg.weight_contact) + static_contact * ti.static(teacher_cfg.weight_static_contact)
    return moving + touching + static_mean * ti.static(teacher_cfg.weight_static) + off + change


@ti.func
def _distance_lanes(cx, cy, velocity):
    dx = cx - velocity[0]
    dy = cy - velocity[1]
    return ti.sqrt(dx * dx + dy * dy)


@ti.func
def _chosen(env, teacher: In[TeacherState], ego: In[Proprioception], teacher_cfg: Const[TeacherConfig], vehicle_cfg: Const[VehicleConfig]):
    """Candidate of least cost (first of equals), and the mean of the candidates weighted by exp(-cost / softness)."""
    n_used = ti.static(teacher_cfg.n_heading * teacher_cfg.n_speed + 3)
    best_cost, best = FAR_M, 0
    for index in range(n_used):
        if teacher.candidate_cost[env, index] < best_cost:
            best_cost = teacher.candidate_cost[env, index]
            best = index
    total, mean_x, mean_y = 0.0, 0.0, 0.0
    for index in range(n_used):
        excess = (teacher.candidate_cost[env, index] - best_cost) * ti.static(1.0 / teacher_cfg.softness)
        if excess < 12.0:
            weight = ti.exp(-excess)
            velocity = candidate(env, index, teacher, ego, teacher_cfg, vehicle_cfg)
            total += weight
            mean_x += weight * velocity[0]
            mean_y += weight * velocity[1]
    chosen = candidate(env, best, teacher, ego, teacher_cfg, vehicle_cfg)
    return chosen[0], chosen[1], mean_x / total, mean_y / total
