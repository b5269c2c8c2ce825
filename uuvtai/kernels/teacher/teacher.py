"""The behaviour tree's leaves and its tick: conditions read the blackboard, one action drives the vehicle."""

import math

import taichi as ti

from uuvtai import tree_codes as codes
from uuvtai.config import EpisodeConfig, TankConfig, TeacherConfig, VehicleConfig
from uuvtai.kernels.core.geometry import FAR_M, PI, quaternion_wb, rotation_wb, turned_z, wrapped_angle
from uuvtai.kernels.core.signature import Const, In, Out, quick_launch, spread
from uuvtai.kernels.teacher.rollout import held_heave
from uuvtai.kernels.teacher.tree_tick import tick_nodes
from uuvtai.state import ClockState, MissionState, Proprioception, RouteState, TeacherState, TreeTable


@quick_launch
@ti.kernel
def reset_teacher(teacher: Out[TeacherState], clock: In[ClockState]):
    """Forget everything of the last episode in the awake rows."""
    n = ti.static(clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and clock.awake[env] == 1:
            for node in range(ti.static(teacher.status.shape[1])):
                teacher.status[env, node] = ti.cast(codes.IDLE, ti.i8)
                teacher.running_child[env, node] = ti.cast(0, ti.i16)
                teacher.result[env, node] = ti.cast(codes.IDLE, ti.i8)
                teacher.since_step[env, node] = 0
                teacher.ticks[env, node] = 0
                teacher.acted[env, node] = 0
            for index in range(ti.static(teacher.candidate_cost.shape[1])):
                teacher.candidate_cost[env, index] = 0.0
            _reset_blackboard(env, teacher)


@ti.func
def _reset_blackboard(env, teacher: Out[TeacherState]):
    zero = ti.Vector([0.0, 0.0, 0.0])
    teacher.action[env] = ti.Vector([0.0, 0.0, 0.0, 0.0])
    teacher.leaf[env] = -1
    teacher.follow_vel_w[env], teacher.evade_vel_w[env], teacher.last_vel_w[env] = zero, zero, zero
    teacher.evade_cost[env] = 0.0
    teacher.want_evade[env] = 0
    teacher.ttc_s[env], teacher.nearest_m[env] = FAR_M, FAR_M
    teacher.threat_bearing[env], teacher.nearest_bearing[env] = 0.0, 0.0
    teacher.clearance_m[env], teacher.path_clearance_m[env] = 0.0, 0.0
    level = ti.Vector([0.0, 0.0])
    teacher.away_w[env], teacher.gaze_w[env], teacher.steer_w[env] = level, level, level
    teacher.conflict_s[env], teacher.hold_conflict_s[env], teacher.body_near_m[env] = FAR_M, FAR_M, FAR_M
    teacher.calm_steps[env], teacher.evading_steps[env] = 0, 0


@quick_launch
@ti.kernel
def tick_tree(
    teacher: Out[TeacherState],
    action: ti.types.ndarray(),  # pyright: ignore[reportInvalidTypeForm]
    table: In[TreeTable],
    route: In[RouteState],
    ego: In[Proprioception],
    mission: In[MissionState],
    clock: In[ClockState],
    teacher_cfg: Const[TeacherConfig],
    vehicle_cfg: Const[VehicleConfig],
    tank_cfg: Const[TankConfig],
    episode_cfg: Const[EpisodeConfig],
):
    """Tick the tree of every awake env once and write its action, here and into ``action`` (n_env, 4) [-1, 1]."""
    n = ti.static(clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and clock.awake[env] == 1:
            for node in range(table.n_node[None]):
                if table.kind[node] >= codes.CONDITION:
                    answer = _answer(env, node, teacher, table, route, ego, mission, clock, teacher_cfg, episode_cfg)
                    teacher.result[env, node] = ti.cast(answer, ti.i8)
            acting = tick_nodes(env, teacher, table)
            leaf = -1
            if acting >= 0:
                leaf = table.leaf[acting]
                teacher.acted[env, acting] += 1
            teacher.leaf[env] = acting
            teacher.evading_steps[env] = ti.select(leaf == codes.EVADE, teacher.evading_steps[env] + 1, 0)
            velocity = _wanted_velocity(env, leaf, acting, teacher, table, ego, mission, teacher_cfg, vehicle_cfg, tank_cfg)
            teacher.last_vel_w[env] = velocity
            turn = _turn(
                leaf, velocity, _gaze(env, leaf, acting, teacher, table), ego.rpy[env][2], teacher.path_clearance_m[env], teacher_cfg
            )
            teacher.action[env] = _action_of(env, velocity, turn, ego, teacher_cfg, vehicle_cfg)
            for i in ti.static(range(4)):
                action[env, i] = ti.cast(teacher.action[env][i], ti.f32)


@ti.func
def _port(node, index, fallback, table: In[TreeTable]):
    """Number of a leaf's port; negative in the table = not given, so the config's."""
    given = table.param[node][index]
    return ti.select(given >= 0.0, given, fallback)


@ti.func
def _answer(
    env,
    node,
    teacher: Out[TeacherState],
    table: In[TreeTable],
    route: In[RouteState],
    ego: In[Proprioception],
    mission: In[MissionState],
    clock: In[ClockState],
    cfg: Const[TeacherConfig],
    episode_cfg: Const[EpisodeConfig],
):
    """What a leaf answers if it is ticked now."""
    leaf = table.leaf[node]
    dt = ti.static(episode_cfg.control_dt_s)
    holds = 0
    if leaf == codes.EMERGENCY_TTC:
        near = teacher.nearest_m[env] < _port(node, 1, ti.static(cfg.emergency_range_m), table)
        closing = teacher.ttc_s[env] < FAR_M
        holds = ti.cast(teacher.ttc_s[env] < _port(node, 0, ti.static(cfg.emergency_ttc_s), table) or (near and closing), ti.i32)
    elif leaf == codes.PREDICTED_CONFLICT:
        seen = teacher.conflict_s[env] <= _port(node, 0, ti.static(cfg.conflict_within_s), table)
        lately = teacher.evading_steps[env] > 0 and teacher.calm_steps[env] * dt <= _port(node, 1, ti.static(cfg.calm_s), table)
        holds = ti.cast(seen or lately, ti.i32)
    elif leaf == codes.ROUTE_BLOCKED:
        blocked = teacher.path_clearance_m[env] < _port(node, 0, ti.static(cfg.blocked_clearance_m), table)
        holds = ti.cast(route.n_way[env] > 0 and blocked, ti.i32)
    elif leaf == codes.STUCK:
        holds = ti.cast(route.stuck_steps[env] * dt >= _port(node, 0, ti.static(cfg.stuck_s), table), ti.i32)
    elif leaf == codes.HAS_ROUTE:
        holds = ti.cast(route.n_way[env] > 0, ti.i32)
    elif leaf == codes.SAFE_HERE:
        holds = ti.cast(teacher.hold_conflict_s[env] >= _port(node, 0, FAR_M, table), ti.i32)
    elif leaf == codes.GOAL_NEAR:
        away = (mission.goal_w[env] - ego.pos_w[env]).norm()
        holds = ti.cast(away <= _port(node, 0, ti.static(cfg.goal_near_m), table), ti.i32)
    out = ti.select(holds == 1, codes.SUCCESS, codes.FAILURE)
    if table.kind[node] == codes.ACTION:
        out = codes.RUNNING
        if leaf == codes.FOLLOW_ROUTE and route.n_way[env] == 0:
            out = codes.FAILURE
        if teacher.status[env, node] != codes.RUNNING:
            teacher.since_step[env, node] = clock.step[env]
        if leaf == codes.UNSTICK:
            lasted = (clock.step[env] - teacher.since_step[env, node]) * dt
            if lasted >= _port(node, 0, ti.static(cfg.unstick_s), table):
                out = codes.SUCCESS
    return out


@ti.func
def _wanted_velocity(
    env,
    leaf,
    node,
    teacher: In[TeacherState],
    table: In[TreeTable],
    ego: In[Proprioception],
    mission: In[MissionState],
    cfg: Const[TeacherConfig],
    vehicle_cfg: Const[VehicleConfig],
    tank_cfg: Const[TankConfig],
):
    """World velocity [m/s] that an action asks for; without an action, stop."""
    out = ti.Vector([0.0, 0.0, 0.0])
    away = teacher.away_w[env]
    if leaf == codes.FOLLOW_ROUTE:
        out = teacher.follow_vel_w[env] * (_port(node, 0, ti.static(cfg.cruise_m_s), table) / ti.static(cfg.cruise_m_s))
        out[2] = teacher.follow_vel_w[env][2]
        if _port(node, 1, 1.0, table) < 0.5:
            out[2] = held_heave(mission.goal_w[env][2] - ego.pos_w[env][2], cfg, vehicle_cfg)
    elif leaf == codes.EVADE:
        out = teacher.evade_vel_w[env]
    elif leaf == codes.BACK_OFF:
        back = turned_z(ti.Vector([-1.0, 0.0]), teacher.threat_bearing[env] + ego.rpy[env][2])
        out = _retreat(back, away, teacher.clearance_m[env], cfg) * _port(node, 0, ti.static(cfg.back_off_m_s), table)
    elif leaf == codes.HOLD:
        crowd = ti.math.clamp(ti.static(cfg.hull_reach_m + cfg.contact_m + cfg.static_margin_m) - teacher.clearance_m[env], 0.0, 0.3)
        out = ti.Vector([away[0], away[1], 0.0]) * crowd
    elif leaf == codes.UNSTICK:
        out = ti.Vector([away[0], away[1], 0.0]) * _port(node, 1, ti.static(cfg.unstick_m_s), table)
    elif leaf == codes.DRIVE_STRAIGHT:
        ahead = mission.goal_w[env] - ego.pos_w[env]
        level = ti.Vector([ahead[0], ahead[1]])
        speed = _port(node, 0, ti.static(cfg.cruise_m_s), table) / ti.max(level.norm(), 1.0e-6)
        out = ti.Vector([level[0] * speed, level[1] * speed, held_heave(ahead[2], cfg, vehicle_cfg)])
    return out


@ti.func
def _retreat(back, away, clearance_m, cfg: Const[TeacherConfig]):
    """Direction of retreat: not into mapped obstacles; near one, what of the direction points into it is taken out."""
    into = ti.min(back.dot(away), 0.0)
    near = clearance_m < ti.static(cfg.hull_reach_m + cfg.contact_m + 2.0 * cfg.static_margin_m)
    slid = back - ti.select(near, into, 0.0) * away
    unit = slid / ti.max(slid.norm(), 1.0e-3)
    return ti.Vector([unit[0], unit[1], 0.0])


@ti.func
def _action_of(env, velocity, turn, ego: In[Proprioception], cfg: Const[TeacherConfig], vehicle_cfg: Const[VehicleConfig]):
    """Normalised action of a world velocity and an angle to turn by: body axes, direction kept where an axis saturates."""
    rpy = ego.rpy[env]
    body = rotation_wb(quaternion_wb(rpy[0], rpy[1], rpy[2])).transpose() @ velocity
    surge, sway = body[0] / ti.static(vehicle_cfg.max_surge_m_s), body[1] / ti.static(vehicle_cfg.max_sway_m_s)
    excess = ti.max(1.0, ti.max(ti.abs(surge), ti.abs(sway)))
    heave = ti.math.clamp(body[2] / ti.static(vehicle_cfg.max_heave_m_s), -1.0, 1.0)
    rate = ti.math.clamp(turn * ti.static(cfg.yaw_gain / vehicle_cfg.max_yaw_rate_rad_s), -1.0, 1.0)
    return ti.Vector([surge / excess, sway / excess, heave, rate])


@ti.func
def _gaze(env, leaf, node, teacher: In[TeacherState], table: In[TreeTable]):
    """[m] horizontal way to what is to be looked at, zero = nothing; the yardsticks, which heed no bodies, look at none."""
    blind = leaf == codes.DRIVE_STRAIGHT
    if leaf == codes.FOLLOW_ROUTE:
        blind = _port(node, 1, 1.0, table) < 0.5
    return ti.select(blind, ti.Vector([0.0, 0.0]), teacher.gaze_w[env])


@ti.func
def _turn(leaf, velocity, gaze, yaw, room, cfg: Const[TeacherConfig]):
    """Angle to turn by: nose towards what is to be looked at, else along the way (where that is narrow, tail first is as slim).

    In danger a diagonal of the body goes along the way, because diagonals are faster: that whose nose is nearest to what is to be looked
    at, not farther off than the camera sees well, or else nearest to the present heading.
    """
    gazes = gaze[0] * gaze[0] + gaze[1] * gaze[1] > 0.0
    look = wrapped_angle(ti.atan2(gaze[1], gaze[0]) - yaw)
    turn = ti.select(gazes, look, 0.0)
    if velocity[0] * velocity[0] + velocity[1] * velocity[1] > 0.01:
        way = wrapped_angle(ti.atan2(velocity[1], velocity[0]) - yaw)
        if leaf >= codes.BACK_OFF and leaf <= codes.EVADE:
            off, quarter = wrapped_angle(way - turn), 0.5 * PI
            aside = off - quarter * (ti.floor(off / quarter) + 0.5)
            most = ti.select(gazes, ti.static(math.radians(cfg.gaze_off_deg)), PI)
            turn = wrapped_angle(turn + ti.math.clamp(aside, -most, most))
        elif not gazes:
            tail_first = room < ti.static(cfg.gaze_clearance_m) and leaf == codes.FOLLOW_ROUTE
            turn = way - ti.select(tail_first, PI * ti.floor(way / PI + 0.5), 0.0)
    return turn
