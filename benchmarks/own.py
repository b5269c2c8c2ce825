"""Plugins of the user's in the loop: env-steps per second of the whole step with a NumPy controller for 64
envs and a batched torch one for 1,024 (pool, S = 8, D = 6, paper sensing, resets on)."""

from __future__ import annotations

import time
from pathlib import Path

import torch

from benchmarks.common import Job, Row
from uuvtai.config.loader import load_config
from uuvtai.evaluation.agents import AgentSpec, load_agents
from uuvtai.evaluation.profile import WARM_STEPS, SimBatch
from uuvtai.sim.sim import Sim

CODE = ("examples.own_field", "examples.own_torch")
EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
PLUGINS = (
    ("NumPy controller", 64, "own_field.py:act", 500.0),
    ("batched torch controller", 1024, "own_torch.py:Pilot", 10_000.0),
)
"""what, envs, example, floor [env-steps/s]"""


def measure(job: Job) -> list[Row]:
    """One row a plugin."""
    return [_row(job, what, 8 if job.quick else n, name, floor) for what, n, name, floor in PLUGINS]


def _row(job: Job, what: str, n_env: int, name: str, floor: float) -> Row:
    job.say(f"{n_env} envs, {name}")
    config = load_config("pool", "paper")
    (own,) = load_agents([f"controller:{EXAMPLES / name}"])
    sim = Sim(config, n_env, own.tree, job.device)
    cpu = time.process_time()
    speed, steps = _speed(sim, own, 4 * job.seconds)
    cpu_us = 1e6 * (time.process_time() - cpu) / steps
    assert own.own is not None
    told = own.own.document()
    own.own.close()
    return Row(
        what=f"{what} (examples/{name.partition(':')[0]}), {n_env:,} envs",
        ours=speed,
        unit="env-steps/s",
        floor=None if job.quick else floor,
        note=f"{cpu_us:.1f} us of CPU time a step, {1e3 * told['decision_ms']:.1f} us of it in her code",
        details={
            "num_envs": n_env,
            "cpu_us_per_env_step": cpu_us,
            "own": {key: told[key] for key in ("calls", "decision_ms", "slowest_ms")},
        },
    )


def _speed(sim: Sim, agent: AgentSpec, seconds: float) -> tuple[float, int]:
    """(env-steps/s while an agent drives, env steps with those to warm up); ended rows begin anew at once."""
    note, obs = agent.agent_for(sim), sim.observe()
    acting = note.agent if note else None
    batch = SimBatch(sim)
    everybody = torch.ones(sim.num_envs, dtype=torch.int32, device=sim.device)
    if acting:
        acting.reset(everybody)

    def step() -> None:
        batch.step(acting.decide(obs).action if acting else None)
        if acting:
            acting.advance()
            acting.reset(sim.terminated | sim.truncated)

    for _ in range(WARM_STEPS):
        step()
    warm, batch.env_steps, begun = batch.env_steps, 0, time.perf_counter()
    while (took := time.perf_counter() - begun) < seconds:
        step()
    return batch.env_steps / took, batch.env_steps + warm
