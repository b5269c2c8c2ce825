"""One env in real time: time of a whole step against the number of moving and static bodies, and its 99th
percentile."""

from __future__ import annotations

import statistics
import time

from benchmarks.common import Job, Row
from uuvtai.loader import load_config
from uuvtai.measure.profile.profiling import PAPER_DENSITY, WARM_STEPS
from uuvtai.measure.profile.sim_batch import SimBatch
from uuvtai.sim import Sim
from uuvtai.tree import read_tree

FLAT = 1.25
"""The slowest D may take at most this times the step of D = 0"""
P99_MS = 5.0
N_STATIC = (0, 8, 15)
_PAPER_LOOP_MS = 28.63


def measure(job: Job) -> list[Row]:
    """Milliseconds a step of one env: against D and S, one simulator with room for 15 of each, and its 99th
    percentile."""
    config = load_config("pool", "paper")
    room = config.world.model_copy(
        update={"dynamic_capacity": max(PAPER_DENSITY), "static_capacity": max(N_STATIC)}
    )
    roomy = config.model_copy(update={"world": room})
    tree = read_tree("bt", config.teacher.max_node)
    world = config.world
    scenes = [(world.n_static, d) for d in PAPER_DENSITY] + [
        (s, world.n_dynamic) for s in N_STATIC if s != world.n_static
    ]
    sim = Sim(roomy, 1, tree, job.device)
    loops = _loops(sim, scenes, world.dynamic_speed_m_s, job)
    rows = []
    for (s, d), loop in loops.items():
        paper = PAPER_DENSITY[d][0] if s == world.n_static else None
        rows.append(
            Row(
                what=f"loop, S = {s}, D = {d}",
                ours=loop,
                unit="ms, one env",
                less_is_better=True,
                peer=paper,
                peer_name="(the paper, printed)" if paper else "",
            )
        )
    by_d = {d: loop for (s, d), loop in loops.items() if s == world.n_static}
    rows.append(
        Row(
            what=f"slowest D against D = 0, S = {world.n_static}",
            ours=max(by_d.values()) / by_d[0],
            unit="times the loop",
            less_is_better=True,
            floor=FLAT,
            peer=max(loop for loop, _ in PAPER_DENSITY.values()) / PAPER_DENSITY[0][0],
            peer_name="(the paper, printed)",
        )
    )
    sim.set_scenes()
    return [*rows, _real_time(sim, world.n_static, world.n_dynamic, job)]


def _loops(
    sim: Sim, scenes: list[tuple[int, int]], speed_m_s: float, job: Job
) -> dict[tuple[int, int], float]:
    """Mean milliseconds of a step of each (S, D), in turns, resets included."""
    spent = dict.fromkeys(scenes, 0.0)
    steps = 10 if job.quick else 250
    turns = 2 if job.quick else 4
    for turn in range(turns):
        for scene in scenes:
            job.say(f"turn {turn + 1} of {turns}: S = {scene[0]}, D = {scene[1]}")
            sim.set_scenes([(*scene, speed_m_s)])
            batch = SimBatch(sim, first_episode=turn)
            for _ in range(WARM_STEPS):
                batch.step()
            begun = time.perf_counter()
            for _ in range(steps):
                batch.step()
            spent[scene] += time.perf_counter() - begun
    return {scene: 1e3 * total / (turns * steps) for scene, total in spent.items()}


def _real_time(sim: Sim, n_static: int, n_dynamic: int, job: Job) -> Row:
    """99th percentile of ``Sim.step`` alone, as a vehicle would run it."""
    batch = SimBatch(sim)
    for _ in range(WARM_STEPS):
        batch.step()
    samples = []
    for _ in range(30 if job.quick else 3000):
        begun = time.perf_counter()
        sim.step()
        samples.append(1e3 * (time.perf_counter() - begun))
        batch.renew()
    mean, cuts = statistics.fmean(samples), statistics.quantiles(samples, n=100)
    return Row(
        what=f"99th percentile of a step, S = {n_static}, D = {n_dynamic}",
        ours=cuts[98],
        unit="ms, one env",
        less_is_better=True,
        floor=P99_MS,
        peer=_PAPER_LOOP_MS,
        peer_name="(the paper's mean, printed)",
        note=f"mean {mean:.2f}, median {cuts[49]:.2f}, longest {max(samples):.2f}",
        details={"steps": len(samples)},
    )
