"""The whole stack with its tree: env-steps per second, time per stage, memory (pool, S = 8, D = 6, depth each
5th step, resets on)."""

from __future__ import annotations

import time

from benchmarks.common import Job, Row
from uuvtai.config.loader import load_config
from uuvtai.evaluation.profile import WARM_STEPS, SimBatch, env_steps_per_s
from uuvtai.sim.behavior_tree import read_tree
from uuvtai.sim.setup import memory_bytes
from uuvtai.sim.sim import Sim
from uuvtai.sim.stages import STAGES

DEVICES = ("cpu", "cuda")
FLOORS = {"paper": 15_000.0, "nominal": 30_000.0}
"""[env-steps/s] at 1,024 envs on two CPU cores"""
_FLOOR_ENVS = 1024
_WINDOWS = 3
"""Windows of equal length: does the cost change while maps fill and episodes end?"""
_SENSING = {"paper": "sonar and map each step", "nominal": "at 10 Hz"}


def measure(job: Job) -> list[Row]:
    """One row per sensing preset and batch size."""
    sizes = job.num_envs or ((8,) if job.quick else (1024,))
    return [_row(job, sensors, n) for sensors in FLOORS for n in sizes]


def _row(job: Job, sensors: str, n_env: int) -> Row:
    job.say(f"{n_env} envs, {sensors} sensing")
    config = load_config("pool", sensors)
    begun = time.perf_counter()
    sim = Sim(config, n_env, read_tree("bt"), job.device)
    batch = SimBatch(sim)
    for _ in range(WARM_STEPS):
        batch.step()
    start_s = time.perf_counter() - begun
    cpu, env_steps, speeds = time.process_time(), 0, []
    for _ in range(_WINDOWS):
        speeds.append(env_steps_per_s(batch, 6 * job.seconds / _WINDOWS, lambda: None))
        env_steps += batch.env_steps
    cpu_us = 1e6 * (time.process_time() - cpu) / env_steps
    speed, steps, episodes = sum(speeds) / _WINDOWS, env_steps // n_env, batch.episodes
    sim.stage_s = {}
    env_steps_per_s(batch, job.seconds, lambda: None)
    stages = {name: 1e6 * sim.stage_s.get(name, 0.0) / batch.env_steps for name in STAGES}
    memory = memory_bytes(config, n_env) / 1e3 / n_env
    bounded = n_env == _FLOOR_ENVS and job.device == "cpu"
    return Row(
        what=f"{sensors} sensing ({_SENSING[sensors]}), {n_env:,} envs",
        ours=speed,
        unit="env-steps/s",
        floor=FLOORS[sensors] if bounded else None,
        note=f"{cpu_us:.1f} us of CPU time a step, {memory:,.0f} kB/env, start {start_s:.0f} s",
        details={
            "num_envs": n_env, "cpu_us_per_env_step": cpu_us, "memory_kb_per_env": memory, "start_s": start_s,
            "env_steps_per_s_by_window": speeds, "steps_measured": steps, "episodes_ended": episodes,
            "table": {"us per env-step": {**stages, "sum": sum(stages.values())}},
        },
    )  # fmt: skip
