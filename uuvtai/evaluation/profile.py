"""The paper's timing table for one vehicle: every row, mean and max, and whether the loop keeps 50 Hz.

"Global planner" is the mean over steps in which a route is planned, as a planner's time is meant; "Planner
stage, every step" is the mean over all steps, most of which only check whether to plan. "Full loop" is a
whole step of the simulator (truth, sensing, mapping, planning, tree) and one decision of the networks (world
model and policy); "Loop without networks" is the step alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from uuvtai.config import Config
from uuvtai.config.learning import LearningConfig
from uuvtai.logs.run_folder import hardware, versions
from uuvtai.sim.setup import check_size, memory_bytes
from uuvtai.sim.sim import Sim
from uuvtai.sim.stages import STAGES

PAPER_MS: dict[str, tuple[float, float | None]] = {
    "WM encoder": (0.015, None),
    "WM dynamics": (0.015, None),
    "WM decoder": (0.027, None),
    "PPO policy": (0.110, 0.127),
    "Mapping update": (3.33, 6.17),
    "Global planner": (5.22, 9.89),
    "Full loop": (28.63, 39.88),
}
"""(mean, max [ms]) of the paper's table "Workstation deployability timing", as printed (RTX 5090
workstation); None = not given"""
PAPER_REPLANS = {"paper_hz": 6.21, "paper_replans_per_episode": 52.1}
_CALLS, _WARM_CALLS = 2000, 200
EVERY_STEP, NO_NETWORKS = "Planner stage, every step", "Loop without networks"
_STAGES = {"Mapping update": ("mapping", "clearance"), EVERY_STEP: ("planning",)}
_LEAST_STEPS = 4  # a loop of fewer steps has no quantiles to speak of
_ENOUGH_PLANS = 20


def latency_rows(
    batch: SimBatch, config: LearningConfig, seconds: float
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Rows of the paper's table for a batch of one env, and the loop against its real-time budget.

    The loop is one control step driven by the tree, all stages; its stages are timed in every second step,
    the whole in the others, since waiting after every stage costs time itself.
    """
    networks = _networks(config)
    samples = {name: _times_ms(call) for name, call in networks.items()}
    found = _loop_samples(batch, seconds, list(networks.values()))
    loop = found["Full loop"]
    rows = [_latency_row(name, values) for name, values in (samples | found).items()]
    if batch.episodes:
        rate = batch.replans / (batch.env_steps * config.episode.control_dt_s)
        rows.append(
            {
                "component": "Replanning rate",
                **dict.fromkeys(("mean_ms", "max_ms", "paper_mean_ms", "paper_max_ms")),
                "replans_per_episode": batch.replans / batch.episodes,
                "hz": rate,
                **PAPER_REPLANS,
            }
        )
    return rows, _real_time(loop, 1e3 * config.episode.control_dt_s)


def _latency_row(name: str, samples_ms: list[float]) -> dict[str, Any]:
    """A row; means are None where nothing was sampled, the paper's columns where it has no such row."""
    paper_mean, paper_max = PAPER_MS.get(name, (None, None))
    return {
        "component": name,
        "mean_ms": float(np.mean(samples_ms)) if samples_ms else None,
        "max_ms": float(np.max(samples_ms)) if samples_ms else None,
        "samples": len(samples_ms),
        "paper_mean_ms": paper_mean,
        "paper_max_ms": paper_max,
    }


def _real_time(loop_ms: list[float], budget_ms: float) -> dict[str, Any]:
    p50, p99 = (float(value) for value in np.quantile(loop_ms, (0.5, 0.99)))
    late = sum(value > budget_ms for value in loop_ms)
    return {
        "budget_ms": budget_ms, "p50_ms": p50, "p99_ms": p99, "max_ms": max(loop_ms), "steps": len(loop_ms),
        "late": late,
        "within": p99 < budget_ms,
    }  # fmt: skip


def _loop_samples(
    batch: SimBatch, seconds: float, networks: list[Callable[[], Any]]
) -> dict[str, list[float]]:
    """[ms] of the stages that the table names, of the planner in steps that plan, and of whole steps without
    and with the networks.

    Routes are planned once in hundreds of steps: where ``seconds`` saw few of them, stages are timed for up
    to twice as long again.
    """
    found: dict[str, list[float]] = {
        name: [] for name in (*_STAGES, "Global planner", NO_NETWORKS, "Full loop")
    }
    batch.replans = batch.episodes = batch.env_steps = 0
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or len(found["Full loop"]) < _LEAST_STEPS:
        _time_stages(batch, found)
        _time_loop(batch, networks, found)
    while len(found["Global planner"]) < _ENOUGH_PLANS and time.perf_counter() < end + 2 * seconds:
        _time_stages(batch, found)
    return found


def _time_stages(batch: SimBatch, found: dict[str, list[float]]) -> None:
    """One step with the stages timed, each waited for."""
    sim, before = batch.sim, _replans(batch)
    sim.stage_s = {}
    sim.step(None)
    for name, parts in _STAGES.items():
        found[name].append(1e3 * sum(sim.stage_s.get(part, 0.0) for part in parts))
    sim.stage_s = None
    if _replans(batch) > before:
        found["Global planner"].append(found[EVERY_STEP][-1])
    batch.env_steps += sim.num_envs
    batch.renew()


def _time_loop(batch: SimBatch, networks: list[Callable[[], Any]], found: dict[str, list[float]]) -> None:
    """One whole step, then the networks; drawing the next episode's scenario is no part of a control loop and
    not counted."""
    ended, begun = batch.episodes, time.perf_counter()
    batch.step()
    stepped = time.perf_counter()
    with torch.no_grad():
        for network in networks:
            network()
    if batch.episodes == ended:
        found[NO_NETWORKS].append(1e3 * (stepped - begun))
        found["Full loop"].append(1e3 * (time.perf_counter() - begun))


def _replans(batch: SimBatch) -> int:
    """Routes planned so far in the episode of the one env."""
    return int(batch.sim.rows(batch.sim.s.route.replans, [0]).sum())


def _networks(config: LearningConfig) -> dict[str, Callable[[], Any]]:
    """One call of each network for one vehicle on the CPU, of the sizes that ``config`` gives; their weights
    do not matter."""
    from uuvtai.kernels.planning.observation import observation_width
    from uuvtai.learning.networks import ActorCritic
    from uuvtai.learning.world_model import N_FEATURES, WorldModel

    generator, n_obs = torch.Generator().manual_seed(0), observation_width(config.observation)
    model = WorldModel(n_obs, config.world_model, generator)
    policy = ActorCritic(n_obs + N_FEATURES, config.policy, generator)
    obs, action, x = torch.randn(1, n_obs), torch.rand(1, 4), torch.randn(1, n_obs + N_FEATURES)
    latent = torch.randn(1, config.world_model.latent)
    return {
        "WM encoder": lambda: model.encode(obs),
        "WM dynamics": lambda: model.advance(latent, action),
        "WM decoder": lambda: model.decode(latent),
        "PPO policy": lambda: policy.mean_of(policy.prepared({"x": x})),
    }


def _times_ms(call: Callable[[], Any]) -> list[float]:
    """[ms] of many calls, without the first ones."""
    samples = []
    with torch.no_grad():
        for _ in range(_WARM_CALLS + _CALLS):
            begun = time.perf_counter()
            call()
            samples.append(1e3 * (time.perf_counter() - begun))
    return samples[_WARM_CALLS:]


# ---- A simulator kept busy, for measurements of speed.


@dataclass
class SimBatch:
    """A simulator kept running: ended rows begin their next episode at once."""

    sim: Sim
    first_episode: int = 0
    """number of row 0's first episode; the other rows begin with the numbers after it"""
    env_steps: int = 0
    replans: int = 0
    episodes: int = 0

    def __post_init__(self) -> None:
        n, device = self.sim.num_envs, self.sim.device
        self._number = torch.arange(n, dtype=torch.int32, device=device) + self.first_episode
        self._seed = torch.zeros(n, dtype=torch.int32, device=device)
        self.sim.reset(torch.ones(n, dtype=torch.int32, device=device), self._seed, self._number)

    def step(self, action: torch.Tensor | None = None) -> None:
        """One step of every env, resets included."""
        self.sim.step(action)
        self.env_steps += self.sim.num_envs
        self.renew()

    def renew(self) -> None:
        """Begin the next episode of every row whose episode has ended."""
        ended = self.sim.terminated | self.sim.truncated
        if bool(ended.any()):
            rows = ended.nonzero().flatten().tolist()
            self.replans += int(self.sim.rows(self.sim.s.route.replans, rows).sum())
            self.episodes += len(rows)
            self._number += ended * self.sim.num_envs
            self.sim.reset(ended, self._seed, self._number)


# ---- Time per stage, env-steps per second and memory, warm-up and compile time apart.

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
    agent: str,
    device: str,
    seconds: float,
    density: bool,
    say: Callable[[str], None],
) -> dict[str, Any]:
    """The ``uuv profile --json`` document; raises ValueError or MemoryError for sizes that cannot work,
    before anything runs."""
    from uuvtai.sim.behavior_tree import read_tree

    tree = read_tree(agent)
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
        rows.append(_rate_row(config, batch, agent, seconds, compile_s))
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
    from uuvtai.envs.vector_env import VectorEnv
    from uuvtai.learning.environments import Simulated
    from uuvtai.learning.trainer import Trainer

    with VectorEnv(sim) as env:
        trainer = Trainer(Simulated(env, config), config)
        trainer.iterate()  # allocates
        timed = trainer.iterate()
    samples = config.ppo.rollout_steps * config.policy.hold_steps * sim.num_envs
    driving_s = timed["time/simulate_s"] + timed["time/infer_s"]
    return {"step_inference": samples / driving_s, "train": samples / (driving_s + timed["time/learn_s"])}


def _rate_row(
    config: Config, batch: SimBatch, agent: str, seconds: float, compile_s: float
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
        "agent": agent,
        **config.world.obstacles,
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
