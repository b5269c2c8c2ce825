"""Columns of what the behaviour tree says: its action, and why. It sees sensor data and memory only, so
whoever reads it does too."""

import taichi as ti

from uuvtai import tree_codes as codes
from uuvtai.kernels.core.columns import ColumnGroup
from uuvtai.kernels.core.signature import Bundle
from uuvtai.kernels.planning.bundles import FeaturesIO

CLASSES = (
    (codes.BACK_OFF,),
    (codes.EVADE,),
    (codes.HOLD,),
    (codes.UNSTICK,),
    (codes.FOLLOW_ROUTE, codes.DRIVE_STRAIGHT),
)
"""Leaves by class: emergency, evade, wait, unstick, travel."""

N_CLASS = len(CLASSES)


@ti.func
def _leaf(env, io: Bundle[FeaturesIO]):
    """Code of the leaf that acts, -1 = none."""
    node, leaf = io.teacher.leaf[env], -1
    if node >= 0:
        leaf = io.table.leaf[node]
    return leaf


@ti.func
def _action(env, io: Bundle[FeaturesIO]):
    return io.teacher.action[env]


@ti.func
def _conflict(env, io: Bundle[FeaturesIO]):
    return ti.Vector([ti.min(io.teacher.conflict_s[env], io.features_cfg.ttc_cap_s)])


@ti.func
def _evade_cost(env, io: Bundle[FeaturesIO]):
    return ti.Vector([ti.select(_leaf(env, io) == codes.EVADE, io.teacher.evade_cost[env], 0.0)])


@ti.func
def _class(env, io: Bundle[FeaturesIO]):
    leaf = _leaf(env, io)
    out = ti.Vector([0.0] * N_CLASS)
    for i, leaves in ti.static(enumerate(CLASSES)):
        for code in ti.static(leaves):
            if leaf == code:
                out[i] = 1.0
    return out


TEACHER_COLUMNS = (
    ColumnGroup(
        "teacher_action",
        4,
        "1",
        "body",
        "surge, sway, heave, yaw rate of the tree, in parts of the vehicle's limits",
        _action,
    ),
    ColumnGroup(
        "teacher_conflict",
        1,
        "s",
        "route",
        "until following the route comes too close to a forecast body, capped",
        _conflict,
    ),
    ColumnGroup(
        "teacher_evade_cost", 1, "1", "route", "cost of the evasion that is driven; 0 = none is", _evade_cost
    ),
    ColumnGroup(
        "teacher_class",
        N_CLASS,
        "1",
        "route",
        "1 = acts: emergency, evade, wait, unstick, travel; all 0 = no leaf",
        _class,
    ),
)
