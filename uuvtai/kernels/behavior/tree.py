"""The behaviour tree's leaves and its tick: conditions read the blackboard, one action drives the vehicle."""

import math

import taichi as ti

from uuvtai.common import tree_codes as codes
from uuvtai.common.tree_codes import (
    ACTION,
    CONDITION,
    FAILURE,
    FALLBACK,
    FORCE_FAILURE,
    FORCE_SUCCESS,
    IDLE,
    INVERTER,
    REACTIVE_FALLBACK,
    REACTIVE_SEQUENCE,
    RUNNING,
    SEQUENCE,
    SUCCESS,
)
from uuvtai.compile.launch import quick_launch
from uuvtai.config.behavior import CALM, RANGE, TTC, WITHIN
from uuvtai.kernels.behavior.io import TeacherIO
from uuvtai.kernels.behavior.rollout import held_heave, tuned
from uuvtai.kernels.behavior.threats import cruising_speed, kept_in_sight
from uuvtai.kernels.core.geometry import FAR_M, PI, quaternion_wb, rotation_wb, turned_z, wrapped_angle
from uuvtai.kernels.core.stage import AnyTensor, Bundle, IntVector, spread

# ------------------------------------------------------------------------------------------------------------
# Tick of a behaviour tree stored as preorder arrays, for one env, without recursion.
#
# Returned statuses and ticked leaves follow BehaviorTree.CPP 4: ``Sequence`` and ``Fallback`` go on with the
# child that was running, their ``Reactive`` forms begin at the first child in every tick and halt the
# siblings
# after the one that decides. Kept statuses follow py_trees (2.x), node by node: a finished node keeps its
# status until its parent enters it anew or a sibling halts it, where BehaviorTree.CPP resets the children of
# a
# finished node to IDLE at once. The kept form shows in a log what the newest tick found.


@ti.func
def tick_nodes(env, io: Bundle[TeacherIO]):
    """Tick the tree once; leaves answer ``teacher.result``. Returns the last action that was ticked and did
    not fail, -1 if none."""
    node = 0
    acting = -1
    while node >= 0:
        kind = io.table.kind[node]
        while kind < CONDITION:  # down to the leaf with which the tick goes on
            io.teacher.ticks[env, node] += 1
            node = _first_child(env, node, kind, io)
            kind = io.table.kind[node]
        io.teacher.ticks[env, node] += 1
        answer = ti.cast(io.teacher.result[env, node], ti.i32)
        io.teacher.status[env, node] = ti.cast(answer, ti.i8)
        acting = ti.select(kind == ACTION and answer != FAILURE, node, acting)
        following = -1
        while node >= 0 and following < 0:  # up until a parent has another child to tick
            parent = io.table.parent[node]
            if parent >= 0:
                following, answer = _next_child(env, node, parent, answer, io)
            node = parent
        node = following
    return acting


@ti.func
def _halt(env, first, end, io: Bundle[TeacherIO]):
    for node in range(first, end):
        io.teacher.status[env, node] = ti.cast(IDLE, ti.i8)


@ti.func
def _first_child(env, node, kind, io: Bundle[TeacherIO]):
    """Child with which a tick of an inner node begins."""
    child = node + 1
    if io.teacher.status[env, node] == RUNNING:
        if kind == SEQUENCE:
            child = ti.cast(io.teacher.running_child[env, node], ti.i32)
        if kind == FALLBACK:
            child = ti.cast(io.teacher.running_child[env, node], ti.i32)
            _halt(env, node + 1, child, io)
    else:
        io.teacher.running_child[env, node] = ti.cast(child, ti.i16)
        if kind <= REACTIVE_SEQUENCE:
            _halt(env, child, io.table.end[node], io)
    return child


@ti.func
def _next_child(env, child, parent, answer, io: Bundle[TeacherIO]):
    """(sibling to tick after ``child`` answered, or -1 when that decides its parent, status of the parent,
    which is then set)."""
    following, decided = -1, answer
    kind, end = io.table.kind[parent], io.table.end[child]
    is_sequence = kind <= REACTIVE_SEQUENCE
    is_fallback = kind >= FALLBACK and kind <= REACTIVE_FALLBACK
    goes_on = (is_sequence and answer == SUCCESS) or (is_fallback and answer == FAILURE)
    if goes_on and end < io.table.end[parent]:
        following = end
        if is_sequence:
            io.teacher.running_child[env, parent] = ti.cast(following, ti.i16)
    else:
        if not goes_on:
            if kind == REACTIVE_SEQUENCE or (is_fallback and io.teacher.running_child[env, parent] != child):
                _halt(env, end, io.table.end[parent], io)
            if is_fallback:
                io.teacher.running_child[env, parent] = ti.cast(child, ti.i16)
        decided = _decorated(kind, answer)
        io.teacher.status[env, parent] = ti.cast(decided, ti.i8)
    return following, decided


@ti.func
def _decorated(kind, answer):
    """Status of a parent whose child decided it."""
    status = answer
    if kind == INVERTER and answer != RUNNING:
        status = SUCCESS + FAILURE - answer
    if kind == FORCE_SUCCESS and answer != RUNNING:
        status = SUCCESS
    if kind == FORCE_FAILURE and answer != RUNNING:
        status = FAILURE
    return status


@quick_launch
@ti.kernel
def tick_with_given_statuses(io: Bundle[TeacherIO], result: AnyTensor):  # pyright: ignore
    """Tick every env with leaf answers given from outside, result[env, node]: for tests of the engine against
    another one."""
    for env in range(ti.static(io.teacher.leaf.shape[0])):
        for node in range(io.table.n_node[None]):
            io.teacher.result[env, node] = ti.cast(result[env, node], ti.i8)
        io.teacher.leaf[env] = tick_nodes(env, io)


# ------------------------------------------------------------------------------------------------------------


@quick_launch
@ti.kernel
def reset_teacher(io: Bundle[TeacherIO]):
    """Forget everything of the last episode in the awake rows."""
    n = ti.static(io.clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and io.clock.awake[env] == 1:
            for node in range(ti.static(io.teacher.status.shape[1])):
                io.teacher.status[env, node] = ti.cast(codes.IDLE, ti.i8)
                io.teacher.running_child[env, node] = ti.cast(0, ti.i16)
                io.teacher.result[env, node] = ti.cast(codes.IDLE, ti.i8)
                io.teacher.since_step[env, node] = 0
                io.teacher.ticks[env, node] = 0
                io.teacher.acted[env, node] = 0
            for index in range(ti.static(io.teacher.candidate_cost.shape[1])):
                io.teacher.candidate_cost[env, index] = 0.0
            for number in range(ti.static(io.teacher.tuned.shape[1])):
                io.teacher.tuned[env, number] = io.table.factor[number]
            _reset_blackboard(env, io)


@quick_launch
@ti.kernel
def write_leaf(io: Bundle[TeacherIO], leaf: IntVector):
    """The node that drives each env, -1 = none."""
    for env in range(leaf.shape[0]):
        leaf[env] = io.teacher.leaf[env]


@ti.func
def _reset_blackboard(env, io: Bundle[TeacherIO]):
    zero = ti.Vector([0.0, 0.0, 0.0])
    io.teacher.action[env] = ti.Vector([0.0, 0.0, 0.0, 0.0])
    io.teacher.leaf[env] = -1
    io.teacher.follow_vel_w[env], io.teacher.evade_vel_w[env], io.teacher.last_vel_w[env] = zero, zero, zero
    io.teacher.evade_cost[env] = 0.0
    io.teacher.evade_candidate[env] = -1
    io.teacher.want_evade[env] = 0
    io.teacher.ttc_s[env], io.teacher.nearest_m[env] = FAR_M, FAR_M
    io.teacher.threat_bearing[env], io.teacher.nearest_bearing[env] = 0.0, 0.0
    io.teacher.clearance_m[env], io.teacher.path_clearance_m[env] = 0.0, 0.0
    level = ti.Vector([0.0, 0.0])
    io.teacher.away_w[env], io.teacher.gaze_w[env], io.teacher.steer_w[env] = level, level, level
    io.teacher.conflict_s[env], io.teacher.hold_conflict_s[env], io.teacher.body_near_m[env] = (
        FAR_M,
        FAR_M,
        FAR_M,
    )
    io.teacher.calm_steps[env], io.teacher.evading_steps[env] = 0, 0
    io.teacher.alert[env] = -1.0
    io.teacher.waited_s[env], io.teacher.patience[env] = 0.0, 1.0
    io.teacher.speed_share[env], io.teacher.cruise_z_m[env] = 0.0, io.mission.goal_w[env][2]


@quick_launch
@ti.kernel
def tick_tree(io: Bundle[TeacherIO], action: AnyTensor):
    """Tick the tree of every awake env once and write its action, here and into ``action`` (n_env, 4) [-1,
    1]."""
    n = ti.static(io.clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and io.clock.awake[env] == 1:
            for node in range(io.table.n_node[None]):
                if io.table.kind[node] >= codes.CONDITION:
                    answer = _answer(env, node, io)
                    io.teacher.result[env, node] = ti.cast(answer, ti.i8)
            acting = tick_nodes(env, io)
            leaf = -1
            if acting >= 0:
                leaf = io.table.leaf[acting]
                io.teacher.acted[env, acting] += 1
            io.teacher.leaf[env] = acting
            io.teacher.evading_steps[env] = ti.select(
                leaf == codes.EVADE, io.teacher.evading_steps[env] + 1, 0
            )
            velocity = _wanted_velocity(env, leaf, acting, io)
            io.teacher.last_vel_w[env] = velocity
            turn = _turn(
                env,
                leaf,
                velocity,
                _gaze(env, leaf, acting, io),
                io.ego.rpy[env][2],
                io.teacher.path_clearance_m[env],
                io,
            )
            io.teacher.action[env] = _action_of(env, velocity, turn, io)
            for i in ti.static(range(4)):
                action[env, i] = ti.cast(io.teacher.action[env][i], ti.f32)


@ti.func
def _port(node, index, fallback, io: Bundle[TeacherIO]):
    """Number of a leaf's port; negative in the table = not given, so the config's."""
    given = io.table.param[node][index]
    return ti.select(given >= 0.0, given, fallback)


@ti.func
def _answer(env, node, io: Bundle[TeacherIO]):
    """What a leaf answers if it is ticked now."""
    leaf = io.table.leaf[node]
    dt = ti.static(io.episode_cfg.control_dt_s)
    holds = 0
    if leaf == codes.EMERGENCY_TTC:
        usual_s = io.teacher_cfg.emergency_ttc_s * tuned(env, TTC, io.teacher)
        usual_m = io.teacher_cfg.emergency_range_m * tuned(env, RANGE, io.teacher)
        near = io.teacher.nearest_m[env] < _port(node, 1, usual_m, io)
        closing = io.teacher.ttc_s[env] < FAR_M
        holds = ti.cast(
            io.teacher.ttc_s[env] < _port(node, 0, usual_s, io) or (near and closing),
            ti.i32,
        )
    elif leaf == codes.PREDICTED_CONFLICT:
        usual_s = io.teacher_cfg.conflict_within_s * tuned(env, WITHIN, io.teacher)
        seen = io.teacher.conflict_s[env] <= _port(node, 0, usual_s, io)
        lately = io.teacher.evading_steps[env] > 0 and io.teacher.calm_steps[env] * dt <= _port(
            node, 1, io.teacher_cfg.calm_s * tuned(env, CALM, io.teacher), io
        )
        holds = ti.cast(seen or lately, ti.i32)
    elif leaf == codes.ROUTE_BLOCKED:
        blocked = io.teacher.path_clearance_m[env] < _port(
            node, 0, ti.static(io.teacher_cfg.blocked_clearance_m), io
        )
        holds = ti.cast(io.route.n_way[env] > 0 and blocked, ti.i32)
    elif leaf == codes.STUCK:
        holds = ti.cast(
            io.route.stuck_steps[env] * dt >= _port(node, 0, ti.static(io.teacher_cfg.stuck_s), io), ti.i32
        )
    elif leaf == codes.HAS_ROUTE:
        holds = ti.cast(io.route.n_way[env] > 0, ti.i32)
    elif leaf == codes.SAFE_HERE:
        holds = ti.cast(io.teacher.hold_conflict_s[env] >= _port(node, 0, FAR_M, io), ti.i32)
    elif leaf == codes.GOAL_NEAR:
        away = (io.mission.goal_w[env] - io.ego.pos_w[env]).norm()
        holds = ti.cast(away <= _port(node, 0, ti.static(io.teacher_cfg.goal_near_m), io), ti.i32)
    out = ti.select(holds == 1, codes.SUCCESS, codes.FAILURE)
    if io.table.kind[node] == codes.ACTION:
        out = codes.RUNNING
        if (leaf == codes.FOLLOW_ROUTE or leaf >= codes.FIRST_BASELINE) and io.route.n_way[env] == 0:
            out = codes.FAILURE
        if io.teacher.status[env, node] != codes.RUNNING:
            io.teacher.since_step[env, node] = io.clock.step[env]
        if leaf == codes.UNSTICK:
            lasted = (io.clock.step[env] - io.teacher.since_step[env, node]) * dt
            if lasted >= _port(node, 0, ti.static(io.teacher_cfg.unstick_s), io):
                out = codes.SUCCESS
    return out


@ti.func
def _wanted_velocity(env, leaf, node, io: Bundle[TeacherIO]):
    """World velocity [m/s] that an action asks for; without an action, stop."""
    out = ti.Vector([0.0, 0.0, 0.0])
    away = io.teacher.away_w[env]
    if leaf == codes.FOLLOW_ROUTE:
        out = io.teacher.follow_vel_w[env]
        if io.table.param[node][0] >= 0.0:
            left, room = io.teacher.speed_share[env], io.teacher.path_clearance_m[env]
            usual = cruising_speed(io.teacher_cfg.cruise_m_s, left, room, io.teacher_cfg, io.vehicle_cfg)
            asked = cruising_speed(io.table.param[node][0], left, room, io.teacher_cfg, io.vehicle_cfg)
            share = asked / ti.max(usual, 1.0e-6)
            out[0], out[1] = share * out[0], share * out[1]
        if _port(node, 1, 1.0, io) < 0.5:
            out[2] = held_heave(
                io.mission.goal_w[env][2] - io.ego.pos_w[env][2], io.teacher_cfg, io.vehicle_cfg
            )
    elif leaf == codes.EVADE:
        out = io.teacher.evade_vel_w[env]
    elif leaf == codes.BACK_OFF:
        back = turned_z(ti.Vector([-1.0, 0.0]), io.teacher.threat_bearing[env] + io.ego.rpy[env][2])
        out = _retreat(back, away, io.teacher.clearance_m[env], io) * _port(
            node, 0, ti.static(io.teacher_cfg.back_off_m_s), io
        )
    elif leaf == codes.HOLD:
        crowd = ti.math.clamp(
            ti.static(io.teacher_cfg.hull_reach_m + io.teacher_cfg.contact_m + io.teacher_cfg.static_margin_m)
            - io.teacher.clearance_m[env],
            0.0,
            0.3,
        )
        out = ti.Vector([away[0], away[1], 0.0]) * crowd
    elif leaf == codes.UNSTICK:
        out = ti.Vector([away[0], away[1], 0.0]) * _port(node, 1, ti.static(io.teacher_cfg.unstick_m_s), io)
    elif leaf >= codes.FIRST_BASELINE:
        out = io.baselines.vel_w[env]
    elif leaf == codes.DRIVE_STRAIGHT:
        ahead = io.mission.goal_w[env] - io.ego.pos_w[env]
        level = ti.Vector([ahead[0], ahead[1]])
        speed = _port(node, 0, ti.static(io.teacher_cfg.cruise_m_s), io) / ti.max(level.norm(), 1.0e-6)
        out = ti.Vector(
            [level[0] * speed, level[1] * speed, held_heave(ahead[2], io.teacher_cfg, io.vehicle_cfg)]
        )
    return out


@ti.func
def _retreat(back, away, clearance_m, io: Bundle[TeacherIO]):
    """Direction of retreat: not into mapped obstacles; near one, what of the direction points into it is
    taken out."""
    into = ti.min(back.dot(away), 0.0)
    near = clearance_m < ti.static(
        io.teacher_cfg.hull_reach_m + io.teacher_cfg.contact_m + 2.0 * io.teacher_cfg.static_margin_m
    )
    slid = back - ti.select(near, into, 0.0) * away
    unit = slid / ti.max(slid.norm(), 1.0e-3)
    return ti.Vector([unit[0], unit[1], 0.0])


@ti.func
def _action_of(env, velocity, turn, io: Bundle[TeacherIO]):
    """Normalised action of a world velocity and an angle to turn by: body axes, direction kept where an axis
    saturates."""
    rpy = io.ego.rpy[env]
    body = rotation_wb(quaternion_wb(rpy[0], rpy[1], rpy[2])).transpose() @ velocity
    surge, sway = (
        body[0] / ti.static(io.vehicle_cfg.max_surge_m_s),
        body[1] / ti.static(io.vehicle_cfg.max_sway_m_s),
    )
    excess = ti.max(1.0, ti.max(ti.abs(surge), ti.abs(sway)))
    heave = ti.math.clamp(body[2] / ti.static(io.vehicle_cfg.max_heave_m_s), -1.0, 1.0)
    rate = ti.math.clamp(
        turn * ti.static(io.teacher_cfg.yaw_gain / io.vehicle_cfg.max_yaw_rate_rad_s), -1.0, 1.0
    )
    return ti.Vector([surge / excess, sway / excess, heave, rate])


@ti.func
def _gaze(env, leaf, node, io: Bundle[TeacherIO]):
    """[m] horizontal way to what is to be looked at, zero = nothing; the yardsticks, which heed no bodies,
    look at none."""
    blind = leaf == codes.DRIVE_STRAIGHT
    if leaf == codes.FOLLOW_ROUTE:
        blind = _port(node, 1, 1.0, io) < 0.5
    return ti.select(blind, ti.Vector([0.0, 0.0]), io.teacher.gaze_w[env])


@ti.func
def _turn(env, leaf, velocity, gaze, yaw, room, io: Bundle[TeacherIO]):
    """Angle to turn by: nose towards what is to be looked at, else along the way (where that is narrow, tail
    first is as slim).

    In danger, and to cruise faster than the nose drives ahead, a diagonal of the body goes along the way,
    because diagonals are faster: that whose nose is
    nearest to what is to be looked at, not farther off than the camera sees well, or else nearest to the
    present heading.
    """
    gazes = gaze[0] * gaze[0] + gaze[1] * gaze[1] > 0.0
    look = wrapped_angle(ti.atan2(gaze[1], gaze[0]) - yaw)
    turn = ti.select(gazes, look, 0.0)
    if velocity[0] * velocity[0] + velocity[1] * velocity[1] > 0.01:
        way = wrapped_angle(ti.atan2(velocity[1], velocity[0]) - yaw)
        level_m_s = ti.sqrt(velocity[0] * velocity[0] + velocity[1] * velocity[1])
        fast = leaf == codes.FOLLOW_ROUTE and level_m_s > ti.static(1.01 * io.vehicle_cfg.max_surge_m_s)
        if fast or (leaf >= codes.BACK_OFF and leaf <= codes.EVADE):
            off, quarter = wrapped_angle(way - turn), 0.5 * PI
            aside = off - quarter * (ti.floor(off / quarter) + 0.5)
            most = ti.select(gazes, ti.static(math.radians(io.teacher_cfg.gaze_off_deg)), PI)
            turn = wrapped_angle(turn + ti.math.clamp(aside, -most, most))
        elif not gazes:
            tail_first = room < ti.static(io.teacher_cfg.gaze_clearance_m) and leaf == codes.FOLLOW_ROUTE
            turn = way - ti.select(tail_first, PI * ti.floor(way / PI + 0.5), 0.0)
    if ti.static(not io.sonar_cfg.is_ring) and leaf == codes.FOLLOW_ROUTE:
        steer = io.teacher.steer_w[env]
        way = wrapped_angle(ti.atan2(steer[1], steer[0]) - yaw)
        turn = kept_in_sight(turn, way, io.sonar_cfg, io.teacher_cfg)
    return turn
