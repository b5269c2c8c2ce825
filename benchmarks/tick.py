"""Tick of the behaviour tree ``bt`` with the statuses of all nodes kept, against py_trees on the same tree
and the same leaf answers."""

from __future__ import annotations

import itertools

import numpy as np
import torch

from benchmarks.common import Job, Row, seconds_per_call
from benchmarks.peers.tick_py_trees import PyTree
from uuvtai import state
from uuvtai.compile.runtime import start_taichi
from uuvtai.config import Config
from uuvtai.kernels.behavior import tree as tree_tick
from uuvtai.kernels.behavior.io import BehaviorIO
from uuvtai.sim.behavior_tree import load_tree, read_tree
from uuvtai.sim.setup import array_sizes
from uuvtai.sim.stages import bind

THREADS = 1
FLOOR = 200.0
_BLACKBOARDS = 64
"""Different leaf answers that py_trees ticks in turn, the first envs of ours."""
_TURNS = 4
"""Sets of such answers, taken in turn."""


def measure(job: Job) -> list[Row]:
    """Ticks per second of one core."""
    n_env = 256 if job.quick else 4096
    start_taichi(job.device)
    tree, config = read_tree("bt"), Config()
    sizes = array_sizes(config, n_env)
    behavior, table = state.allocate(state.BehaviorState, sizes), state.allocate(state.TreeTable, sizes)
    load_tree(table, tree)
    shape = (_TURNS, n_env, config.behavior.max_node)
    answers = np.random.default_rng(0).integers(
        tree_tick.RUNNING, tree_tick.FAILURE + 1, shape, dtype=np.int8
    )
    given = [torch.from_numpy(a) for a in answers]
    n_node = len(tree.kind)
    peers = [PyTree(tree) for _ in range(_BLACKBOARDS)]
    check(behavior, table, peers, answers, n_node)
    prepared = [[peers[0].prepared(row[:n_node]) for row in a[:_BLACKBOARDS]] for a in answers]
    ours_next, theirs_next = itertools.cycle(given), itertools.cycle(prepared)

    io = bind(BehaviorIO, behavior, table, partial=True)

    def ours() -> None:
        tree_tick.tick_with_given_statuses(io, next(ours_next))

    def theirs() -> None:
        for peer, answer in zip(peers, next(theirs_next), strict=True):
            peer.tick_prepared(answer)

    cost = seconds_per_call({"ours": ours, "peer": theirs}, job.seconds)
    return [
        Row(
            what=f"tree ticks, {n_node} nodes",
            ours=n_env / cost["ours"],
            peer=_BLACKBOARDS / cost["peer"],
            peer_name="py_trees",
            unit="ticks/s per core",
            floor=FLOOR,
            floor_on="ratio",
            note=f"{1e9 * cost['ours'] / n_env:.0f} ns against {1e6 * cost['peer'] / _BLACKBOARDS:.1f} us a "
            "tick",
            details={"num_envs": n_env},
        )
    ]


def check(
    behavior: state.BehaviorState,
    table: state.TreeTable,
    peers: list[PyTree],
    answers: np.ndarray,
    n_node: int,
) -> None:
    """Raise AssertionError unless every node's status is the peers', tick by tick, memories included."""
    io = bind(BehaviorIO, behavior, table, partial=True)
    for answer in answers:
        tree_tick.tick_with_given_statuses(io, torch.from_numpy(answer))
        found = behavior.status.to_numpy()[: len(peers), :n_node]
        np.testing.assert_array_equal(found, [peer.tick(answer[i, :n_node]) for i, peer in enumerate(peers)])
