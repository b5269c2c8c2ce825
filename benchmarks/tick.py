"""Tick of the behaviour tree ``bt`` with the statuses of all nodes kept, against py_trees and
BehaviorTree.CPP on the same tree and the same leaf answers."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import torch

from benchmarks.common import Job, Row, seconds_per_call
from benchmarks.peers.tick_behaviortree_cpp import CppTree, fixed_tree
from benchmarks.peers.tick_py_trees import PyTree
from uuvtai import state
from uuvtai.common import tree_codes as codes
from uuvtai.compile.runtime import start_taichi
from uuvtai.config import Config
from uuvtai.kernels.behavior import tree as tree_tick
from uuvtai.kernels.behavior.io import BehaviorIO
from uuvtai.sim.behavior_tree import FlatTree, load_tree, read_tree
from uuvtai.sim.setup import array_sizes
from uuvtai.sim.stages import bind

THREADS = 1
FLOOR = 200.0
"""times the rate of py_trees"""
_BLACKBOARDS = 64
"""Different leaf answers that the peers tick in turn, the first envs of ours."""
_TURNS = 4
"""Sets of such answers, taken in turn."""
_NOTES = {
    "py_trees": "",
    "BehaviorTree.CPP": "; its leaves are Python functions",
    "BehaviorTree.CPP, fixed leaves": "; in C++, the first set of answers only",
}


def measure(job: Job) -> list[Row]:
    """Ticks per second of one core."""
    n_env = 256 if job.quick else 4096
    start_taichi(job.device)
    tree, config = read_tree("bt"), Config()
    sizes = array_sizes(config, n_env)
    behavior, table = state.allocate(state.BehaviorState, sizes), state.allocate(state.TreeTable, sizes)
    load_tree(table, tree)
    shape = (_TURNS, n_env, codes.MAX_NODES)
    answers = np.random.default_rng(0).integers(
        tree_tick.RUNNING, tree_tick.FAILURE + 1, shape, dtype=np.int8
    )
    given = [torch.from_numpy(a) for a in answers]
    n_node = len(tree.kind)
    io = bind(BehaviorIO, behavior, table, partial=True)
    python, cpp = [PyTree(tree) for _ in range(_BLACKBOARDS)], [CppTree(tree) for _ in range(_BLACKBOARDS)]
    check(io, tree, python, cpp, answers)
    fixed = [fixed_tree(tree, row) for row in answers[0, :_BLACKBOARDS]]
    check_fixed(io, fixed, given[0])
    given_next = itertools.cycle(given)

    def of(trees):
        prepared = [[trees[0].prepared(row[:n_node]) for row in a[:_BLACKBOARDS]] for a in answers]
        prepared_next = itertools.cycle(prepared)

        def tick_all() -> None:
            for peer, answer in zip(trees, next(prepared_next), strict=True):
                peer.tick_prepared(answer)

        return tick_all

    theirs = dict(zip(_NOTES, (of(python), of(cpp), lambda: [tick() for tick in fixed]), strict=True))
    sides = {"ours": lambda: tree_tick.tick_with_given_statuses(io, next(given_next)), **theirs}
    cost = seconds_per_call(sides, job.seconds)
    rate = {side: (n_env if side == "ours" else _BLACKBOARDS) / seconds for side, seconds in cost.items()}
    return [
        Row(
            f"tree ticks, {n_node} nodes", rate["ours"], "ticks/s per core", rate[name], name,
            floor=FLOOR if name == "py_trees" else None, floor_on="ratio",
            note=f"{1e9 / rate['ours']:.0f} ns against {1e6 / rate[name]:.1f} us a tick{_NOTES[name]}",
            details={"num_envs": n_env},
        )
        for name in theirs
    ]  # fmt: skip


def check(io: Any, tree: FlatTree, python: list[PyTree], cpp: list[CppTree], answers: np.ndarray) -> None:
    """Raise AssertionError unless every node's status is py_trees' tick by tick, memories included, and
    BehaviorTree.CPP comes to the same leaves in the same order with the same status of the root."""
    for answer in answers:
        tree_tick.tick_with_given_statuses(io, torch.from_numpy(answer))
        found = io.behavior.status.to_numpy()[:, : len(tree.kind)]
        for row, told, one, other in zip(found, answer, python, cpp, strict=False):
            visited = [node for node in one.visited(told) if tree.kind[node] >= codes.CONDITION]
            np.testing.assert_array_equal(row, one.statuses())
            assert other.tick(told) == (row[0], visited)


def check_fixed(io: Any, fixed: list, answer: torch.Tensor) -> None:
    """Raise AssertionError unless trees of fixed leaves end as ours from the start, and where a sequence
    goes on."""
    io.behavior.status.fill(codes.IDLE)
    io.behavior.running_child.fill(0)
    for _ in range(2):
        tree_tick.tick_with_given_statuses(io, answer)
        ends = io.behavior.status.to_numpy()[: len(fixed), 0]
        np.testing.assert_array_equal(ends, [tick().value for tick in fixed])
