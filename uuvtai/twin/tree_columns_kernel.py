"""Kernel of ``tree_columns``."""

import taichi as ti

from uuvtai import tree_codes as codes
from uuvtai.kernels.core.signature import Bundle, FloatMatrix, IntVector
from uuvtai.twin.set_codes import AT_WISH, N_LEAF
from uuvtai.twin.tree_columns import TreeColumnsIO

HORIZON_S, SIGHT_M, NARROW_M, CALM_STEPS, EPISODE_STEPS = 5.0, 4.0, 2.0, 150, 3000


@ti.func
def put_way(env, at, way, flip, columns: FloatMatrix):
    """Three columns of a velocity."""
    for i in ti.static(range(3)):
        columns[env, at + i] = flip[i] * way[i]


@ti.func
def capped(value, most):
    """Part of the most that is told."""
    return ti.math.clamp(value / most, -1.0, 1.0)


@ti.kernel
def write_tree_columns(io: Bundle[TreeColumnsIO], due: IntVector, wish: FloatMatrix, columns: FloatMatrix):
    """``columns`` (n, TREE_WIDTH) of the rows where ``due`` is 1; ``wish`` (n, 3) is the policy's."""
    for env in range(due.shape[0]):
        if due[env] == 1:
            flip = ti.Vector([1.0, 1.0, 1.0])
            for i in ti.static(range(2)):
                if io.mission.goal_w[env][i] < io.mission.start_w[env][i]:
                    flip[i] = -1.0
            put_way(env, 0, io.teacher.evade_vel_w[env], flip, columns)
            put_way(env, 3, io.teacher.follow_vel_w[env], flip, columns)
            put_way(env, 6, io.teacher.last_vel_w[env], flip, columns)
            cost = io.teacher.evade_cost[env]
            values = ti.Vector(
                [
                    cost / (1.0 + ti.abs(cost)),
                    float(io.teacher.want_evade[env]),
                    capped(io.teacher.conflict_s[env], HORIZON_S),
                    capped(io.teacher.hold_conflict_s[env], HORIZON_S),
                    capped(io.teacher.ttc_s[env], HORIZON_S),
                    capped(io.teacher.nearest_m[env], SIGHT_M),
                    capped(io.teacher.body_near_m[env], SIGHT_M),
                    capped(io.teacher.clearance_m[env], NARROW_M),
                    capped(io.teacher.path_clearance_m[env], NARROW_M),
                    io.teacher.speed_share[env],
                    capped(float(io.teacher.calm_steps[env]), float(CALM_STEPS)),
                    capped(float(io.teacher.evading_steps[env]), float(CALM_STEPS)),
                    capped(float(io.clock.step[env]), float(EPISODE_STEPS)),
                ]
            )
            for i in ti.static(range(13)):
                columns[env, 9 + i] = values[i]
            leaf = io.teacher.leaf[env]
            for i in ti.static(range(N_LEAF)):
                columns[env, 22 + i] = 0.0
            if leaf >= 0:
                action = io.table.leaf[leaf] - codes.BACK_OFF
                if 0 <= action < N_LEAF:
                    columns[env, 22 + action] = 1.0
            for i in ti.static(range(3)):
                columns[env, AT_WISH + i] = wish[env, i]
