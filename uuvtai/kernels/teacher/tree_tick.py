"""Tick of a behaviour tree stored as preorder arrays, for one env, without recursion.

Returned statuses and ticked leaves follow BehaviorTree.CPP 4: ``Sequence`` and ``Fallback`` go on with the
child that was running, their ``Reactive`` forms begin at the first child in every tick and halt the siblings
after the one that decides. Kept statuses follow py_trees (2.x), node by node: a finished node keeps its
status until its parent enters it anew or a sibling halts it, where BehaviorTree.CPP resets the children of a
finished node to IDLE at once. The kept form shows in a log what the newest tick found.
"""

import taichi as ti

from uuvtai.kernels.core.signature import AnyTensor, Bundle
from uuvtai.kernels.teacher.bundles import TeacherIO
from uuvtai.native.launch import quick_launch
from uuvtai.tree_codes import (
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
