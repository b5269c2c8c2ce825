"""Tick of a behaviour tree stored as preorder arrays, for one env, without recursion.

Returned statuses and ticked leaves follow BehaviorTree.CPP 4: ``Sequence`` and ``Fallback`` go on with the child that was running, their
``Reactive`` forms begin at the first child in every tick and halt the siblings after the one that decides. Kept statuses follow py_trees
(2.x), node by node: a finished node keeps its status until its parent enters it anew or a sibling halts it, where BehaviorTree.CPP resets
the children of a finished node to IDLE at once. The kept form shows in a log what the newest tick found.
"""

import taichi as ti

from uuvtai.kernels.core.signature import In, Out, quick_launch
from uuvtai.state import TeacherState, TreeTable
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
def tick_nodes(env, teacher: Out[TeacherState], table: In[TreeTable]):
    """Tick the tree once; leaves answer ``teacher.result``. Returns the last action that was ticked and did not fail, -1 if none."""
    node = 0
    acting = -1
    while node >= 0:
        kind = table.kind[node]
        while kind < CONDITION:  # down to the leaf with which the tick goes on
            teacher.ticks[env, node] += 1
            node = _first_child(env, node, kind, teacher, table)
            kind = table.kind[node]
        teacher.ticks[env, node] += 1
        answer = ti.cast(teacher.result[env, node], ti.i32)
        teacher.status[env, node] = ti.cast(answer, ti.i8)
        acting = ti.select(kind == ACTION and answer != FAILURE, node, acting)
        following = -1
        while node >= 0 and following < 0:  # up until a parent has another child to tick
            parent = table.parent[node]
            if parent >= 0:
                following, answer = _next_child(env, node, parent, answer, teacher, table)
            node = parent
        node = following
    return acting


@ti.func
def _halt(env, first, end, teacher: Out[TeacherState]):
    for node in range(first, end):
        teacher.status[env, node] = ti.cast(IDLE, ti.i8)


@ti.func
def _first_child(env, node, kind, teacher: Out[TeacherState], table: In[TreeTable]):
    """Child with which a tick of an inner node begins."""
    child = node + 1
    if teacher.status[env, node] == RUNNING:
        if kind == SEQUENCE:
            child = ti.cast(teacher.running_child[env, node], ti.i32)
        if kind == FALLBACK:
            child = ti.cast(teacher.running_child[env, node], ti.i32)
            _halt(env, node + 1, child, teacher)
    else:
        teacher.running_child[env, node] = ti.cast(child, ti.i16)
        if kind <= REACTIVE_SEQUENCE:
            _halt(env, child, table.end[node], teacher)
    return child


@ti.func
def _next_child(env, child, parent, answer, teacher: Out[TeacherState], table: In[TreeTable]):
    """(sibling to tick after ``child`` answered, or -1 when that decides its parent, status of the parent, which is then set)."""
    following, decided = -1, answer
    kind, end = table.kind[parent], table.end[child]
    is_sequence = kind <= REACTIVE_SEQUENCE
    is_fallback = kind >= FALLBACK and kind <= REACTIVE_FALLBACK
    goes_on = (is_sequence and answer == SUCCESS) or (is_fallback and answer == FAILURE)
    if goes_on and end < table.end[parent]:
        following = end
        if is_sequence:
            teacher.running_child[env, parent] = ti.cast(following, ti.i16)
    else:
        if not goes_on:
            if kind == REACTIVE_SEQUENCE or (is_fallback and teacher.running_child[env, parent] != child):
                _halt(env, end, table.end[parent], teacher)
            if is_fallback:
                teacher.running_child[env, parent] = ti.cast(child, ti.i16)
        decided = _decorated(kind, answer)
        teacher.status[env, parent] = ti.cast(decided, ti.i8)
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
def tick_with_given_statuses(result: ti.types.ndarray(), teacher: Out[TeacherState], table: In[TreeTable]):  # pyright: ignore
    """Tick every env with leaf answers given from outside, result[env, node]: for tests of the engine against another one."""
    for env in range(ti.static(teacher.leaf.shape[0])):
        for node in range(table.n_node[None]):
            teacher.result[env, node] = ti.cast(result[env, node], ti.i8)
        teacher.leaf[env] = tick_nodes(env, teacher, table)
