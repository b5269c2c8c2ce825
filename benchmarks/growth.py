"""Cost of an env-step against the number of envs: a big batch beside small ones that play the very same
episodes."""

from __future__ import annotations

import time
from collections.abc import Iterator

from benchmarks.common import Job, Row
from uuvtai.loader import load_config
from uuvtai.measure.profile.sim_batch import SimBatch
from uuvtai.sim import Sim
from uuvtai.sizes import memory_bytes
from uuvtai.tree import read_tree

DEVICES = ("cpu", "cuda")
FLOOR = 1.10
"""Cost per env-step at the biggest size may be at most this times that at the smallest"""
_WARM, _TURNS, _TURN_STEPS = 10, 4, 10
"""Control steps: before the clock starts; turns that the sizes take; steps of each turn"""


def measure(job: Job) -> list[Row]:
    """Microseconds per env-step of each size and the growth between the ends, paper sensing."""
    sizes = sorted(job.num_envs or ((8, 16) if job.quick else (1024, 8192)))
    config = load_config("pool", "paper")
    tree = read_tree("bt", config.teacher.max_node)
    spent = {n: [0.0, 0.0] for n in sizes}
    players = {}
    for n in sizes:
        job.say(f"{n} envs: starting")
        sim = Sim(config, n, tree, job.device)
        SimBatch(sim).step()  # compiled before any clock runs
        players[n] = _played(sim, sizes[-1], spent[n])
    for turn in range(_TURNS):
        for n in sizes:
            job.say(f"turn {turn + 1} of {_TURNS}: {n} envs")
            for _ in range(sizes[-1] // n):
                next(players[n], None)
    rows = [_row(n, sizes[-1], spent[n], memory_bytes(config, n) / 1e3 / n) for n in sizes]
    return [*rows, _growth(rows[0], rows[-1], job.device)]


def _row(n: int, most: int, spent_s: list[float], memory_kb: float) -> Row:
    wall_us, cpu_us = (1e6 * s / (most // n * n * _TURNS * _TURN_STEPS) for s in spent_s)
    return Row(
        what=f"{n:,} envs",
        ours=wall_us,
        unit="us per env-step",
        less_is_better=True,
        note=f"{cpu_us:.1f} us of CPU time, {memory_kb:,.0f} kB/env",
        details={"num_envs": n, "cpu_us_per_env_step": cpu_us, "memory_kb_per_env": memory_kb},
    )


def _growth(small: Row, big: Row, device: str) -> Row:
    """How many times the cost of the smallest size the biggest has."""
    ends = small.details["num_envs"], big.details["num_envs"]
    cpu = big.details["cpu_us_per_env_step"] / small.details["cpu_us_per_env_step"]
    return Row(
        what=f"growth, {ends[0]:,} to {ends[1]:,} envs",
        ours=big.ours / small.ours,  # type: ignore[operator]
        unit="times the cost",
        less_is_better=True,
        floor=FLOOR if ends == (1024, 8192) and device == "cpu" else None,
        note=f"{cpu:.3f} in CPU time",
    )


def _played(sim: Sim, episodes: int, spent: list[float]) -> Iterator[None]:
    """Play that many episodes in groups of the simulator's size, a turn at a time; adds wall and CPU time to
    ``spent``."""
    for first in range(0, episodes - sim.num_envs + 1, sim.num_envs):
        batch = SimBatch(sim, first)
        for _ in range(_WARM):
            batch.step()
        for _ in range(_TURNS):
            wall, cpu = time.perf_counter(), time.process_time()
            for _ in range(_TURN_STEPS):
                batch.step()
            spent[0] += time.perf_counter() - wall
            spent[1] += time.process_time() - cpu
            yield
