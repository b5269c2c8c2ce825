"""PPO of Stable-Baselines3 on the batch: ``python examples/train_sb3.py`` (pip install 'uuvtai[sb3]')."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from judge import HOLD_STEPS, Act, Watched, main
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from uuvtai import Sb3VecEnv, Sim

ROLLOUT_STEPS = 64


def train(sim: Sim, iterations: int, out: Path | None = None) -> Act:
    """The policy after so many rollouts and updates, saved in ``out``; observations and rewards are scaled by
    SB3's own wrapper."""
    envs = VecNormalize(Sb3VecEnv(Watched(sim=sim, hold_steps=HOLD_STEPS)), gamma=0.99)
    model = PPO(
        "MlpPolicy",
        envs,
        seed=0,
        device="cpu",
        n_steps=ROLLOUT_STEPS,
        batch_size=ROLLOUT_STEPS * envs.num_envs // 4,
        n_epochs=5,
        learning_rate=1e-3,
        ent_coef=0.0,
        policy_kwargs={"log_std_init": -0.7},
    )
    if iterations:
        model.learn(iterations * ROLLOUT_STEPS * envs.num_envs)
    if out:
        model.save(out / "model.zip")
        envs.save(str(out / "scales.pkl"))
    return _acting(model, envs)


def play(sim: Sim, folder: Path) -> Act:
    """The policy that ``train`` saved. SB3 unpickles both files: load your own only."""
    envs = VecNormalize.load(str(folder / "scales.pkl"), Sb3VecEnv(Watched(sim=sim, hold_steps=HOLD_STEPS)))
    return _acting(PPO.load(folder / "model.zip", device="cpu"), envs)


def _acting(model: PPO, envs: VecNormalize) -> Act:
    def act(obs: np.ndarray) -> np.ndarray:
        return model.predict(np.asarray(envs.normalize_obs(obs)), deterministic=True)[0]

    return act


if __name__ == "__main__":
    main(train, play, iterations=36)
