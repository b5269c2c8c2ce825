"""PPO of rsl_rl on the batch: ``python examples/train_rsl_rl.py`` (pip install 'uuvtai[rsl-rl]')."""

from __future__ import annotations

import contextlib
import os
from copy import deepcopy
from pathlib import Path

import numpy as np
import torch
from judge import HOLD_STEPS, Act, Watched, main
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

from uuvtai import RslRlVecEnv, Sim

NETWORK = {"class_name": "MLPModel", "hidden_dims": [64, 64], "activation": "tanh", "obs_normalization": True}
CONFIG = {
    "num_steps_per_env": 64,
    "save_interval": 1000,
    "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
    "actor": {**NETWORK, "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 0.5}},
    "critic": NETWORK,
    "algorithm": {
        "class_name": "PPO",
        "num_learning_epochs": 5,
        "num_mini_batches": 4,
        "learning_rate": 1e-3,
        "schedule": "fixed",
        "entropy_coef": 0.0,
    },
}


@contextlib.contextmanager
def quiet():
    """It prints every layer and iteration."""
    with open(os.devnull, "w") as nothing, contextlib.redirect_stdout(nothing):
        yield


def make(sim: Sim) -> OnPolicyRunner:
    """What trains an untrained policy; observations are scaled inside the network."""
    torch.manual_seed(0)
    envs = RslRlVecEnv(Watched(sim=sim, hold_steps=HOLD_STEPS, backend="torch"), seed=0)
    with quiet():
        return OnPolicyRunner(envs, deepcopy(CONFIG), device=str(envs.device))


def train(sim: Sim, iterations: int, out: Path | None = None) -> Act:
    """The policy after so many rollouts and updates, saved in ``out``."""
    runner = make(sim)
    with quiet():
        runner.learn(iterations)
    if out:
        runner.save(str(out / "model.pt"))
    return _acting(runner)


def play(sim: Sim, folder: Path) -> Act:
    """The policy that ``train`` saved."""
    runner = make(sim)
    runner.load(str(folder / "model.pt"))
    return _acting(runner)


def _acting(runner: OnPolicyRunner) -> Act:
    policy = runner.get_inference_policy()

    def act(obs: np.ndarray) -> np.ndarray:
        with torch.inference_mode():
            return policy(TensorDict({"policy": torch.from_numpy(obs)}, batch_size=[len(obs)])).numpy()

    return act


if __name__ == "__main__":
    main(train, play, iterations=36)
