"""PPO of rsl_rl on the batch: ``python examples/train_rsl_rl.py`` (pip install 'uuvtai[rsl-rl]')."""

from __future__ import annotations

import contextlib
import os
from copy import deepcopy

import numpy as np
import torch
from judge import HOLD_STEPS, Act, Watched, main
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

from uuvtai.gym.rsl_rl import RslRlVecEnv
from uuvtai.sim import Sim

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


def train(sim: Sim, iterations: int) -> Act:
    """The policy after so many rollouts and updates; observations are scaled inside the network."""
    torch.manual_seed(0)
    envs = RslRlVecEnv(Watched(sim=sim, hold_steps=HOLD_STEPS, backend="torch"), seed=0)
    with open(os.devnull, "w") as nothing, contextlib.redirect_stdout(nothing):  # it prints every layer and iteration
        runner = OnPolicyRunner(envs, deepcopy(CONFIG), device=str(envs.device))
        runner.learn(iterations)
    policy = runner.get_inference_policy()

    def act(obs: np.ndarray) -> np.ndarray:
        with torch.inference_mode():
            return policy(TensorDict({"policy": torch.from_numpy(obs)}, batch_size=[len(obs)])).numpy()

    return act


if __name__ == "__main__":
    main(train, iterations=40)
