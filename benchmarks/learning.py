"""Env-steps per second of `uuv train` with everything on, beside Stable-Baselines3's PPO on the same
environment (pool, 1,024 envs)."""

from __future__ import annotations

import time

from benchmarks.common import Job, Row
from uuvtai.config.learning import LearningConfig
from uuvtai.env import VectorEnv
from uuvtai.learn.train import Trainer
from uuvtai.loader import load_training
from uuvtai.sim import Sim
from uuvtai.tree import read_tree

FLOORS = {"paper": 6_000.0, "nominal": 12_000.0}
"""[env-steps/s] at 1,024 envs on two CPU cores"""
BFLOAT16 = (False, True)
"""``ppo.bfloat16``: the hidden layers' products in half of the width, where the CPU can do so"""
_PARTS = {"simulate": "time/simulate_s", "infer": "time/infer_s", "learn": "time/learn_s"}


def measure(job: Job) -> list[Row]:
    """A row for either width of the products under each sensing preset.

    Ours has teacher, distillation, world model and its features on; the peer is plain PPO.
    """
    num_envs, iterations = (8, 1) if job.quick else (1024, 4)
    rows = []
    for sensors in FLOORS:
        config = load_training("curriculum", {"train.num_envs": num_envs}, sensors=sensors)
        sim = Sim(config, num_envs, read_tree("bt", config.teacher.max_node))
        job.say(f"{sensors} sensing: Stable-Baselines3")
        theirs = _theirs(sim, config, iterations)
        for bfloat16 in BFLOAT16:
            job.say(f"{sensors} sensing: ours{', bfloat16' if bfloat16 else ''}")
            ppo = config.ppo.model_copy(update={"bfloat16": bfloat16})
            rows.append(_row(job, sensors, sim, config.model_copy(update={"ppo": ppo}), theirs, iterations))
    return rows


def _row(job: Job, sensors: str, sim: Sim, config: LearningConfig, theirs: float, iterations: int) -> Row:
    num_envs = sim.num_envs
    trainer = Trainer(VectorEnv(sim), config)
    trainer.iterate()  # allocates
    begun, done = time.perf_counter(), [trainer.iterate() for _ in range(iterations)]
    samples = iterations * config.ppo.rollout_steps * num_envs
    ours = samples / (time.perf_counter() - begun)
    parts = {name: 1e6 * sum(metrics[key] for metrics in done) / samples for name, key in _PARTS.items()}
    products = " with ppo.bfloat16=true" if config.ppo.bfloat16 else ""
    return Row(
        what=f"{sensors} sensing, all of `uuv train curriculum`{products}, {num_envs:,} envs",
        ours=ours,
        unit="env-steps/s",
        peer=theirs,
        peer_name="SB3 PPO, no teacher, no world model",
        floor=None if job.quick else FLOORS[sensors],
        note=", ".join(f"{name} {us:.0f}" for name, us in parts.items())
        + f" us per env-step; {config.ppo.epochs} epochs both",
        details={"us_per_env_step": parts, "samples": samples},
    )


def _theirs(sim: Sim, config: LearningConfig, iterations: int) -> float:
    """Env-steps per second of SB3's PPO with our sizes: networks, rollout, epochs, minibatches."""
    from stable_baselines3 import PPO

    from uuvtai.gym import UuvVectorEnv
    from uuvtai.gym.sb3 import Sb3VecEnv

    samples = config.ppo.rollout_steps * sim.num_envs
    model = PPO(
        "MlpPolicy", Sb3VecEnv(UuvVectorEnv(sim=sim)), seed=1, device="cpu",
        n_steps=config.ppo.rollout_steps, batch_size=samples // config.ppo.minibatches,
        n_epochs=config.ppo.epochs, learning_rate=config.ppo.learning_rate,
        policy_kwargs={"net_arch": list(config.policy.hidden)},
    )  # fmt: skip
    model.learn(samples)
    begun = time.perf_counter()
    model.learn(iterations * samples, reset_num_timesteps=False)
    return iterations * samples / (time.perf_counter() - begun)
