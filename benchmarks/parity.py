"""The surrogate beside the simulator: success of one policy on the same scenarios.

Trains nothing: ``--policy RUN`` names a policy that learnt in the surrogate. It drives the same episodes in
both, in six scenes.
"""

from __future__ import annotations

import time

import numpy as np
import torch

from benchmarks.common import Job, Row
from uuvtai.common.enums import RUNNING, SUCCESS
from uuvtai.common.statistics import wilson_interval
from uuvtai.config.learning import LearningConfig
from uuvtai.evaluation.episodes import Job as Episode
from uuvtai.evaluation.episodes import run_episodes
from uuvtai.learning.agents import find_policy, load_set_agent
from uuvtai.learning.checkpoint import Checkpoint
from uuvtai.learning.parameter_search import simulator_of
from uuvtai.learning.set_networks import MOST_WISH, SetActor, actor_of
from uuvtai.sim.setup import Scene
from uuvtai.sim.sim import Sim
from uuvtai.surrogate.world import Surrogate, draw_bank

LONGEST_S = 3600
THREADS = 1
SCENES: tuple[tuple[str, Scene], ...] = tuple(
    (world, scene) for world in ("gauntlet", "pool") for scene in ((8, 9, 1.5), (8, 9, 1.0), (8, 6, 0.6))
)
SEED, EPISODES, NUM_ENVS = 77503, 1024, 256
POINTS = 3.0
"""success may differ by so many"""


def measure(job: Job) -> list[Row]:
    """Success of both sides, scene by scene."""
    checkpoint = _policy(job.policy)
    count = 8 if job.quick else EPISODES
    scenes = SCENES[:1] if job.quick else SCENES
    rows, sims = [], {}
    for world, scene in scenes:
        began = time.perf_counter()
        config = _config(checkpoint.config, world, scene, min(count, NUM_ENVS))
        surrogate = in_surrogate(config, scene, actor_of(checkpoint), count)
        if world not in sims:
            sims[world] = simulator_of(config, world, tuple(scene for name, scene in SCENES if name == world))
        sim = in_simulator(sims[world], scene, checkpoint, count)
        rows.append(_row(f"success, {world} {scene}", surrogate, sim))
        job.say(f"{rows[-1].what}: {rows[-1].note}; {time.perf_counter() - began:.0f} s")
    return rows


def _policy(run: str) -> Checkpoint:
    if not run:
        raise SystemExit(
            "parity: give a policy that learnt in the surrogate: --policy RUN (uuv train policy)"
        )
    found = find_policy(run)
    if not found.config.surrogate.enabled:
        raise SystemExit(f"parity: {run} did not learn in the surrogate; train one: uuv train policy")
    return found


def _config(config: LearningConfig, world: str, scene: Scene, num_envs: int) -> LearningConfig:
    """The run's config for one scene."""
    return config.model_copy(
        update={
            "surrogate": config.surrogate.model_copy(update={"worlds": (world,)}),
            "train": config.train.model_copy(update={"num_envs": num_envs, "scenes": (scene,)}),
        }
    )


@torch.no_grad()
def in_surrogate(config: LearningConfig, scene: Scene, actor: SetActor, count: int) -> np.ndarray:
    """Successes (count,) in the surrogate, by the mean action."""
    surrogate = Surrogate(config, draw_bank(config, (scene,), SEED, count), count, SEED)
    surrogate.begin(torch.ones(count, dtype=torch.bool), torch.arange(count))
    outcome = np.full(count, RUNNING)
    while (running := outcome == RUNNING).any():
        view = surrogate.look()
        _, now = surrogate.step(actor(view["obstacles"], view["own"]).clamp(-MOST_WISH, MOST_WISH))
        outcome[running] = now.numpy()[running]
    return outcome == SUCCESS


def in_simulator(sim: Sim, scene: Scene, checkpoint: Checkpoint, count: int) -> np.ndarray:
    """Successes (count,) in the simulator."""
    episodes = [Episode(SEED, i, scene) for i in range(count)]
    results, _ = run_episodes(sim, episodes, agent=load_set_agent(checkpoint, sim))
    return np.array([result.outcome == "success" for result in results])


def _row(what: str, surrogate: np.ndarray, sim: np.ndarray) -> Row:
    difference = 100.0 * (surrogate.astype(float) - sim)
    mean, half = float(difference.mean()), 1.96 * float(difference.std()) / len(difference) ** 0.5
    sides = {"surrogate": surrogate, "simulator": sim}
    counts = {
        name: {"success": int(k.sum()), "episodes": len(k), "interval": wilson_interval(int(k.sum()), len(k))}
        for name, k in sides.items()
    }
    apart = {"only surrogate": int((surrogate & ~sim).sum()), "only simulator": int((sim & ~surrogate).sum())}
    within = "within" if abs(mean) <= POINTS else "NOT within"
    note = f"{mean:+.1f} points, 95 % in {mean - half:+.1f} .. {mean + half:+.1f}: {within} {POINTS:g}"
    return Row(
        what, float(surrogate.mean()), "surrogate", float(sim.mean()), "simulator", note=note,
        details={**counts, **apart, "difference": mean, "half": half},
    )  # fmt: skip
