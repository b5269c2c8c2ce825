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
from uuvtai.config.behavior import HYSTERESIS, RANGE, TTC, WITHIN
from uuvtai.kernels.behavior.io import BehaviorIO
from uuvtai.kernels.behavior.rollout import UNSTICK_M_S, held_heave, tuned
from uuvtai.kernels.behavior.threats import cruising_speed, kept_in_sight
from uuvtai.kernels.core.geometry import FAR_M, PI, quaternion_wb, rotation_wb, turned_z, wrapped_angle
from uuvtai.kernels.core.stage import AnyTensor, Bundle, IntVector, n_envs

BLOCKED_M, STUCK_S, GOAL_NEAR_M, UNSTICK_S = 0.25, 4.0, 1.5, 1.5
"""What leaves take whose port is not given: static clearance below which the way to the look-ahead point is
blocked; time without motion; distance to the goal; time of creeping away (EC)."""

# ------------------------------------------------------------------------------------------------------------
# Tick of a behaviour tree stored as preorder arrays, for one env, without recursion.
#
# Returned statuses and ticked leaves follow BehaviorTree.CPP 4: ``Sequence`` and ``Fallback`` go on with the
# child that was running, their ``Reactive`` forms begin at the first child in every tick and halt the
# siblings after the one that decides. Kept statuses follow py_trees (2.x), node by node: a finished node
# keeps its status until its parent enters it anew or a sibling halts it, where BehaviorTree.CPP resets the
# children of a finished node to IDLE at once. The kept form shows in a log what the newest tick found.


@ti.func
def tick_nodes(env, io: Bundle[BehaviorIO]):
    """Tick the tree once; leaves answer ``behavior.result``. Returns the last action that was ticked and did
    not fail, -1 if none."""
    node = 0
    acting = -1
    while node >= 0:
        kind = io.table.kind[node]
        while kind < CONDITION:  # down to the leaf with which the tick goes on
            io.behavior.ticks[env, node] += 1
            node = _first_child(env, node, kind, io)
            kind = io.table.kind[node]
        io.behavior.ticks[env, node] += 1
        answer = ti.cast(io.behavior.result[env, node], ti.i32)
        io.behavior.status[env, node] = ti.cast(answer, ti.i8)
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
def _halt(env, first, end, io: Bundle[BehaviorIO]):
    for node in range(first, end):
        io.behavior.status[env, node] = ti.cast(IDLE, ti.i8)


@ti.func
def _first_child(env, node, kind, io: Bundle[BehaviorIO]):
    """Child with which a tick of an inner node begins."""
    child = node + 1
    if io.behavior.status[env, node] == RUNNING:
        if kind == SEQUENCE:
            child = ti.cast(io.behavior.running_child[env, node], ti.i32)
        if kind == FALLBACK:
            child = ti.cast(io.behavior.running_child[env, node], ti.i32)
            _halt(env, node + 1, child, io)
    else:
        io.behavior.running_child[env, node] = ti.cast(child, ti.i16)
        if kind <= REACTIVE_SEQUENCE:
            _halt(env, child, io.table.end[node], io)
    return child


@ti.func
def _next_child(env, child, parent, answer, io: Bundle[BehaviorIO]):
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
            io.behavior.running_child[env, parent] = ti.cast(following, ti.i16)
    else:
        if not goes_on:
            if kind == REACTIVE_SEQUENCE or (is_fallback and io.behavior.running_child[env, parent] != child):
                _halt(env, end, io.table.end[parent], io)
            if is_fallback:
                io.behavior.running_child[env, parent] = ti.cast(child, ti.i16)
        decided = _decorated(kind, answer)
        io.behavior.status[env, parent] = ti.cast(decided, ti.i8)
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
def tick_with_given_statuses(io: Bundle[BehaviorIO], result: AnyTensor):  # pyright: ignore
    """Tick every env with leaf answers given from outside, result[env, node]: for tests of the engine against
    another one."""
    for env in range(ti.static(io.behavior.leaf.shape[0])):
        for node in range(io.table.n_node[None]):
            io.behavior.result[env, node] = ti.cast(result[env, node], ti.i8)
        io.behavior.leaf[env] = tick_nodes(env, io)


# ------------------------------------------------------------------------------------------------------------


@quick_launch
@ti.kernel
def reset_behavior(io: Bundle[BehaviorIO]):
    """Forget everything of the last episode in the active rows."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
            for node in range(ti.static(io.behavior.status.shape[1])):
                io.behavior.status[env, node] = ti.cast(codes.IDLE, ti.i8)
                io.behavior.running_child[env, node] = ti.cast(0, ti.i16)
                io.behavior.result[env, node] = ti.cast(codes.IDLE, ti.i8)
                io.behavior.since_step[env, node] = 0
                io.behavior.ticks[env, node] = 0
                io.behavior.acted[env, node] = 0
            for index in range(ti.static(io.behavior.candidate_cost.shape[1])):
                io.behavior.candidate_cost[env, index] = 0.0
            for number in range(ti.static(io.behavior.tuned.shape[1])):
                io.behavior.tuned[env, number] = io.table.factor[number]
            _reset_blackboard(env, io)


@quick_launch
@ti.kernel
def write_leaf(io: Bundle[BehaviorIO], leaf: IntVector):
    """The node that drives each env, -1 = none."""
    for env in range(leaf.shape[0]):
        leaf[env] = io.behavior.leaf[env]


@ti.func
def _reset_blackboard(env, io: Bundle[BehaviorIO]):
    zero = ti.Vector([0.0, 0.0, 0.0])
    io.behavior.action[env] = ti.Vector([0.0, 0.0, 0.0, 0.0])
    io.behavior.leaf[env] = -1
    io.behavior.follow_vel_w[env], io.behavior.evade_vel_w[env], io.behavior.last_vel_w[env] = (
        zero,
        zero,
        zero,
    )
    io.behavior.evade_cost[env] = 0.0
    io.behavior.evade_candidate[env] = -1
    io.behavior.want_evade[env] = 0
    io.behavior.ttc_s[env], io.behavior.nearest_m[env] = FAR_M, FAR_M
    io.behavior.threat_bearing[env], io.behavior.nearest_bearing[env] = 0.0, 0.0
    io.behavior.clearance_m[env], io.behavior.path_clearance_m[env] = 0.0, 0.0
    level = ti.Vector([0.0, 0.0])
    io.behavior.away_w[env], io.behavior.heading_w[env], io.behavior.steer_w[env] = level, level, level
    io.behavior.conflict_s[env], io.behavior.hold_conflict_s[env], io.behavior.obstacle_near_m[env] = (
        FAR_M,
        FAR_M,
        FAR_M,
    )
    io.behavior.hysteresis_steps[env], io.behavior.evading_steps[env] = 0, 0
    io.behavior.alert[env] = -1.0
    io.behavior.waited_s[env], io.behavior.patience[env] = 0.0, 1.0
    io.behavior.speed_share[env], io.behavior.cruise_z_m[env] = 0.0, io.mission.goal_w[env][2]


@quick_launch
@ti.kernel
def tick_tree(io: Bundle[BehaviorIO], action: AnyTensor):
    """Tick the tree of every active env once and write its action, here and into ``action`` (n_env, 4) [-1,
    1]."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
            for node in range(io.table.n_node[None]):
                if io.table.kind[node] >= codes.CONDITION:
                    answer = _answer(env, node, io)
                    io.behavior.result[env, node] = ti.cast(answer, ti.i8)
            acting = tick_nodes(env, io)
            leaf = -1
            if acting >= 0:
                leaf = io.table.leaf[acting]
                io.behavior.acted[env, acting] += 1
            io.behavior.leaf[env] = acting
            io.behavior.evading_steps[env] = ti.select(
                leaf == codes.EVADE, io.behavior.evading_steps[env] + 1, 0
            )
            velocity = _wanted_velocity(env, leaf, acting, io)
            io.behavior.last_vel_w[env] = velocity
            turn = _turn(
                env,
                leaf,
                velocity,
                _wanted_heading(env, leaf, acting, io),
                io.ego.rpy[env][2],
                io.behavior.path_clearance_m[env],
                io,
            )
            io.behavior.action[env] = _action_of(env, velocity, turn, io)
            for i in ti.static(range(4)):
                action[env, i] = ti.cast(io.behavior.action[env][i], ti.f32)


@ti.func
def _port(node, index, fallback, io: Bundle[BehaviorIO]):
    """Number of a leaf's port; negative in the table = not given, so the config's."""
    given = io.table.param[node][index]
    return ti.select(given >= 0.0, given, fallback)


@ti.func
def _answer(env, node, io: Bundle[BehaviorIO]):
    """What a leaf answers if it is ticked now."""
    leaf = io.table.leaf[node]
    dt = ti.static(io.episode_cfg.control_dt_s)
    holds = 0
    if leaf == codes.EMERGENCY_TTC:
        usual_s = io.behavior_cfg.emergency_ttc_s * tuned(env, TTC, io)
        usual_m = io.behavior_cfg.emergency_range_m * tuned(env, RANGE, io)
        near = io.behavior.nearest_m[env] < _port(node, 1, usual_m, io)
        closing = io.behavior.ttc_s[env] < FAR_M
        holds = ti.cast(io.behavior.ttc_s[env] < _port(node, 0, usual_s, io) or (near and closing), ti.i32)
    elif leaf == codes.PREDICTED_CONFLICT:
        usual_s = io.behavior_cfg.conflict_within_s * tuned(env, WITHIN, io)
        seen = io.behavior.conflict_s[env] <= _port(node, 0, usual_s, io)
        lately = io.behavior.evading_steps[env] > 0 and io.behavior.hysteresis_steps[env] * dt <= _port(
            node, 1, io.behavior_cfg.hysteresis_s * tuned(env, HYSTERESIS, io), io
        )
        holds = ti.cast(seen or lately, ti.i32)
    elif leaf == codes.ROUTE_BLOCKED:
        blocked = io.behavior.path_clearance_m[env] < _port(node, 0, BLOCKED_M, io)
        holds = ti.cast(io.route.n_way[env] > 0 and blocked, ti.i32)
    elif leaf == codes.STUCK:
        holds = ti.cast(io.route.stuck_steps[env] * dt >= _port(node, 0, STUCK_S, io), ti.i32)
    elif leaf == codes.HAS_ROUTE:
        holds = ti.cast(io.route.n_way[env] > 0, ti.i32)
    elif leaf == codes.SAFE_HERE:
        holds = ti.cast(io.behavior.hold_conflict_s[env] >= _port(node, 0, FAR_M, io), ti.i32)
    elif leaf == codes.GOAL_NEAR:
        away = (io.mission.goal_w[env] - io.ego.pos_w[env]).norm()
        holds = ti.cast(away <= _port(node, 0, GOAL_NEAR_M, io), ti.i32)
    out = ti.select(holds == 1, codes.SUCCESS, codes.FAILURE)
    if io.table.kind[node] == codes.ACTION:
        out = codes.RUNNING
        if (leaf == codes.FOLLOW_ROUTE or leaf >= codes.FIRST_BASELINE) and io.route.n_way[env] == 0:
            out = codes.FAILURE
        if io.behavior.status[env, node] != codes.RUNNING:
            io.behavior.since_step[env, node] = io.clock.step[env]
        if leaf == codes.UNSTICK:
            lasted = (io.clock.step[env] - io.behavior.since_step[env, node]) * dt
            if lasted >= _port(node, 0, UNSTICK_S, io):
                out = codes.SUCCESS
    return out


@ti.func
def _wanted_velocity(env, leaf, node, io: Bundle[BehaviorIO]):
    """World velocity [m/s] that an action asks for; without an action, stop."""
    out = ti.Vector([0.0, 0.0, 0.0])
    away = io.behavior.away_w[env]
    if leaf == codes.FOLLOW_ROUTE:
        out = io.behavior.follow_vel_w[env]
        if io.table.param[node][0] >= 0.0:
            left, room = io.behavior.speed_share[env], io.behavior.path_clearance_m[env]
            usual = cruising_speed(io.behavior_cfg.cruise_m_s, left, room, io)
            asked = cruising_speed(io.table.param[node][0], left, room, io)
            share = asked / ti.max(usual, 1.0e-6)
            out[0], out[1] = share * out[0], share * out[1]
        if _port(node, 1, 1.0, io) < 0.5:
            out[2] = held_heave(io.mission.goal_w[env][2] - io.ego.pos_w[env][2], io)
    elif leaf == codes.EVADE:
        out = io.behavior.evade_vel_w[env]
    elif leaf == codes.BACK_OFF:
        back = turned_z(ti.Vector([-1.0, 0.0]), io.behavior.threat_bearing[env] + io.ego.rpy[env][2])
        out = _retreat(back, away, io.behavior.clearance_m[env], io) * _port(
            node, 0, ti.static(io.behavior_cfg.back_off_m_s), io
        )
    elif leaf == codes.HOLD:
        crowd = ti.math.clamp(
            ti.static(
                io.behavior_cfg.hull_reach_m + io.behavior_cfg.contact_m + io.behavior_cfg.static_margin_m
            )
            - io.behavior.clearance_m[env],
            0.0,
            0.3,
        )
        out = ti.Vector([away[0], away[1], 0.0]) * crowd
    elif leaf == codes.UNSTICK:
        out = ti.Vector([away[0], away[1], 0.0]) * _port(node, 1, UNSTICK_M_S, io)
    elif leaf >= codes.FIRST_BASELINE:
        out = io.baselines.vel_w[env]
    elif leaf == codes.DRIVE_STRAIGHT:
        ahead = io.mission.goal_w[env] - io.ego.pos_w[env]
        level = ti.Vector([ahead[0], ahead[1]])
        speed = _port(node, 0, ti.static(io.behavior_cfg.cruise_m_s), io) / ti.max(level.norm(), 1.0e-6)
        out = ti.Vector([level[0] * speed, level[1] * speed, held_heave(ahead[2], io)])
    return out


@ti.func
def _retreat(back, away, clearance_m, io: Bundle[BehaviorIO]):
    """Direction of retreat: not into mapped obstacles; near one, what of the direction points into it is
    taken out."""
    into = ti.min(back.dot(away), 0.0)
    near = clearance_m < ti.static(
        io.behavior_cfg.hull_reach_m + io.behavior_cfg.contact_m + 2.0 * io.behavior_cfg.static_margin_m
    )
    slid = back - ti.select(near, into, 0.0) * away
    unit = slid / ti.max(slid.norm(), 1.0e-3)
    return ti.Vector([unit[0], unit[1], 0.0])


@ti.func
def _action_of(env, velocity, turn, io: Bundle[BehaviorIO]):
    """Normalised action of a world velocity and an angle to turn by: body axes, direction kept where an axis
    saturates."""
    rpy = io.ego.rpy[env]
    obstacle = rotation_wb(quaternion_wb(rpy[0], rpy[1], rpy[2])).transpose() @ velocity
    surge, sway = (
        obstacle[0] / ti.static(io.vehicle_cfg.max_surge_m_s),
        obstacle[1] / ti.static(io.vehicle_cfg.max_sway_m_s),
    )
    excess = ti.max(1.0, ti.max(ti.abs(surge), ti.abs(sway)))
    heave = ti.math.clamp(obstacle[2] / ti.static(io.vehicle_cfg.max_heave_m_s), -1.0, 1.0)
    rate = ti.math.clamp(
        turn * ti.static(io.behavior_cfg.yaw_gain / io.vehicle_cfg.max_yaw_rate_rad_s), -1.0, 1.0
    )
    return ti.Vector([surge / excess, sway / excess, heave, rate])


@ti.func
def _wanted_heading(env, leaf, node, io: Bundle[BehaviorIO]):
    """[m] horizontal way to what is to be looked at, zero = nothing; the oracles, which heed no obstacles,
    look at none."""
    blind = leaf == codes.DRIVE_STRAIGHT
    if leaf == codes.FOLLOW_ROUTE:
        blind = _port(node, 1, 1.0, io) < 0.5
    return ti.select(blind, ti.Vector([0.0, 0.0]), io.behavior.heading_w[env])


@ti.func
def _turn(env, leaf, velocity, heading, yaw, room, io: Bundle[BehaviorIO]):
    """Angle to turn by: nose towards what is to be looked at, else along the way (where that is narrow, tail
    first is as slim).

    In danger, and to cruise faster than the nose drives ahead, a diagonal of the body goes along the way,
    because diagonals are faster: that whose nose is nearest to what is to be looked at, not farther off than
    the camera sees well, or else nearest to the present heading. With ``travel_diagonal`` one does in all
    open water, the nearest to the present heading, where the sonar sees all around.
    """
    has_heading = heading[0] * heading[0] + heading[1] * heading[1] > 0.0
    look = wrapped_angle(ti.atan2(heading[1], heading[0]) - yaw)
    turn = ti.select(has_heading, look, 0.0)
    if velocity[0] * velocity[0] + velocity[1] * velocity[1] > 0.01:
        way = wrapped_angle(ti.atan2(velocity[1], velocity[0]) - yaw)
        level_m_s = ti.sqrt(velocity[0] * velocity[0] + velocity[1] * velocity[1])
        fast = leaf == codes.FOLLOW_ROUTE and level_m_s > ti.static(1.01 * io.vehicle_cfg.max_surge_m_s)
        is_open = leaf == codes.FOLLOW_ROUTE and room > ti.static(io.behavior_cfg.heading_clearance_m)
        quarter = 0.5 * PI
        if ti.static(io.behavior_cfg.travel_diagonal and io.sonar_cfg.is_ring) and is_open:
            turn = way - quarter * (ti.floor(way / quarter) + 0.5)
        elif fast or (leaf >= codes.BACK_OFF and leaf <= codes.EVADE):
            off = wrapped_angle(way - turn)
            aside = off - quarter * (ti.floor(off / quarter) + 0.5)
            most = ti.select(has_heading, ti.static(math.radians(io.behavior_cfg.heading_off_deg)), PI)
            turn = wrapped_angle(turn + ti.math.clamp(aside, -most, most))
        elif not has_heading:
            tail_first = room < ti.static(io.behavior_cfg.heading_clearance_m) and leaf == codes.FOLLOW_ROUTE
            turn = way - ti.select(tail_first, PI * ti.floor(way / PI + 0.5), 0.0)
    if ti.static(not io.sonar_cfg.is_ring) and leaf == codes.FOLLOW_ROUTE:
        steer = io.behavior.steer_w[env]
        way = wrapped_angle(ti.atan2(steer[1], steer[0]) - yaw)
        turn = kept_in_sight(turn, way, io)
    return turn
