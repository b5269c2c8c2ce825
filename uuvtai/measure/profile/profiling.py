"""Time per stage, env-steps per second and memory, warm-up and compile time apart."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch

from uuvtai.config import Config
from uuvtai.config.learning import LearningConfig
from uuvtai.measure.profile.latency import latency_rows
from uuvtai.measure.profile.sim_batch import SimBatch
from uuvtai.run_folder import hardware, versions
from uuvtai.sim import Sim
from uuvtai.sizes import check_size, memory_bytes
from uuvtai.stages import STAGES

WARM_STEPS = 60
"""More than every divider's period, so that each stage has run several times before the clock starts."""
_MAX_STEPS = 100_000
_DENSITY = (0, 3, 6, 9, 15)

PAPER_DENSITY = {0: (19.7, 51.9), 3: (25.2, 62.7), 6: (28.6, 54.4), 9: (31.6, 48.8), 15: (38.0, 42.7)}
"""D: (loop [ms], replans an episode) of the paper's table "Runtime versus dynamic-obstacle density", as
printed"""


def profile(
    config: LearningConfig,
    sizes: list[int],
    controller: str,
    device: str,
    seconds: float,
    density: bool,
    say: Callable[[str], None],
) -> dict[str, Any]:
    """The ``uuv profile --json`` document; raises ValueError or MemoryError for sizes that cannot work,
    before anything runs."""
    from uuvtai.tree import read_tree

    tree = read_tree(controller, config.teacher.max_node)
    for n in sizes:
        check_size(config, n, device)
    rows, latency, real_time, device_used = [], [], None, device
    for n in sizes:
        say(f"{n} env(s): starting")
        begun = time.perf_counter()
        sim = Sim(config, n, tree, device)
        device_used = sim.device.type
        batch = SimBatch(sim)
        for _ in range(WARM_STEPS):
            batch.step()
        compile_s = time.perf_counter() - begun
        rows.append(_row(config, batch, controller, seconds, compile_s))
        if n == 1:
            latency, real_time = latency_rows(batch, config, seconds)
        rows[-1]["env_steps_per_s"] |= _learning_rates(config, sim)
    return {
        "schema": 1,
        "machine": {**hardware(), "device": device_used, "versions": versions()},
        "rows": rows,
        "paper_latency": latency,
        "real_time": real_time,
        "paper_density": _density(config, tree, device, seconds, say) if density else [],
    }


def _learning_rates(config: LearningConfig, sim: Sim) -> dict[str, float]:
    """Env-steps per second with a policy that decides, and with everything that learns as well: one iteration
    of the training preset."""
    from uuvtai.env import VectorEnv
    from uuvtai.learn.train import Trainer

    with VectorEnv(sim) as env:
        trainer = Trainer(env, config)
        trainer.iterate()  # allocates
        timed = trainer.iterate()
    samples = config.ppo.rollout_steps * config.policy.hold_steps * sim.num_envs
    driving_s = timed["time/simulate_s"] + timed["time/infer_s"]
    return {"step_inference": samples / driving_s, "train": samples / (driving_s + timed["time/learn_s"])}


def _row(
    config: Config, batch: SimBatch, controller: str, seconds: float, compile_s: float
) -> dict[str, Any]:
    sim = batch.sim
    step = env_steps_per_s(batch, seconds, lambda: 2 * torch.rand(sim.num_envs, 4, device=sim.device) - 1)
    driven = env_steps_per_s(batch, seconds, lambda: None)
    sim.stage_s = {}
    env_steps_per_s(batch, seconds, lambda: None)
    stages, steps = sim.stage_s, batch.env_steps
    sim.stage_s = None
    return {
        "num_envs": sim.num_envs,
        "controller": controller,
        **config.world.bodies,
        "depth_every": config.sensors.depth.period_steps,
        "env_steps_per_s": {"step": step, "tree": driven},
        "compile_s": compile_s,
        "memory_mb": memory_bytes(config, sim.num_envs) / 1e6,
        "memory_kb_per_env": memory_bytes(config, sim.num_envs) / 1e3 / sim.num_envs,
        "stages_us_per_env_step": {name: 1e6 * stages.get(name, 0.0) / steps for name in STAGES},
    }


def env_steps_per_s(batch: SimBatch, seconds: float, action: Callable[[], torch.Tensor | None]) -> float:
    """Env-steps per second over about ``seconds``."""
    batch.env_steps, elapsed = 0, 0.0
    begun = time.perf_counter()
    for _ in range(_MAX_STEPS):
        batch.step(action())
        elapsed = time.perf_counter() - begun
        if elapsed >= seconds:
            break
    return batch.env_steps / elapsed


def _density(
    config: Config, tree: Any, device: str, seconds: float, say: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Loop time of one env and replans per episode against D: one simulator, D as data."""
    room = config.world.model_copy(update={"dynamic_capacity": max(_DENSITY)})
    sim = Sim(config.model_copy(update={"world": room}), 1, tree, device)
    rows = []
    for n_dynamic in _DENSITY:
        say(f"D = {n_dynamic}")
        sim.set_scenes([(config.world.n_static, n_dynamic, config.world.dynamic_speed_m_s)])
        batch = SimBatch(sim)
        for _ in range(WARM_STEPS):
            batch.step()
        batch.replans = batch.episodes = 0
        rate = env_steps_per_s(batch, seconds, lambda: None)
        loop, replans = PAPER_DENSITY[n_dynamic]
        rows.append(
            {
                "D": n_dynamic,
                "loop_ms": 1e3 / rate,
                "replans_per_episode": batch.replans / batch.episodes if batch.episodes else None,
                "paper_loop_ms": loop,
                "paper_replans": replans,
            }
        )
    return rows
