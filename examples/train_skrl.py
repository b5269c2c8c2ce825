"""PPO of skrl on the batch: ``python examples/train_skrl.py`` (pip install 'uuvtai[skrl]')."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from judge import HOLD_STEPS, Act, Watched, main
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.resources.preprocessors.torch import RunningStandardScaler
from skrl.trainers.torch import SequentialTrainer
from skrl.utils import set_seed
from torch import nn

from uuvtai import Sim

ROLLOUT_STEPS = 64


def network(inputs: int, outputs: int) -> nn.Sequential:
    """Two hidden layers; the last one starts small, so that the first policy hardly acts."""
    last = nn.Linear(64, outputs)
    nn.init.orthogonal_(last.weight, 0.01)
    return nn.Sequential(nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), last)


class Policy(GaussianMixin, Model):
    """Mean of the actions; their spread is learnt apart."""

    def __init__(self, **spaces) -> None:
        Model.__init__(self, **spaces)
        GaussianMixin.__init__(self)
        self.net = network(self.num_observations, self.num_actions)
        self.log_std = nn.Parameter(torch.full((self.num_actions,), -0.7))

    def compute(self, inputs, role=""):
        """(mean, log of the spread)."""
        return self.net(inputs["observations"]), {"log_std": self.log_std}


class Value(DeterministicMixin, Model):
    """Return to be expected."""

    def __init__(self, **spaces) -> None:
        Model.__init__(self, **spaces)
        DeterministicMixin.__init__(self)
        self.net = network(self.num_observations, 1)

    def compute(self, inputs, role=""):
        """(value, nothing else)."""
        return self.net(inputs["observations"]), {}


def make(sim: Sim):
    """(envs, untrained agent); observations and values are scaled by skrl's own preprocessors."""
    set_seed(0)
    envs = wrap_env(Watched(sim=sim, hold_steps=HOLD_STEPS), wrapper="gymnasium", verbose=False)
    spaces = {name: getattr(envs, name) for name in ("observation_space", "action_space", "device")}
    config = PPO_CFG(
        rollouts=ROLLOUT_STEPS, learning_epochs=5, time_limit_bootstrap=True,
        observation_preprocessor=RunningStandardScaler, value_preprocessor=RunningStandardScaler,
        observation_preprocessor_kwargs={"size": envs.observation_space}, mini_batches=4, learning_rate=1e-3,
        value_preprocessor_kwargs={"size": 1}, experiment={"write_interval": 0, "checkpoint_interval": 0},
    )  # fmt: skip
    memory = RandomMemory(memory_size=ROLLOUT_STEPS, num_envs=envs.num_envs, device=envs.device)
    models = {"policy": Policy(**spaces), "value": Value(**spaces)}
    return envs, PPO(models=models, memory=memory, cfg=config, **spaces)


def train(sim: Sim, iterations: int, out: Path | None = None) -> Act:
    """The policy after so many rollouts and updates, saved in ``out``."""
    envs, agent = make(sim)
    quiet = {"headless": True, "disable_progressbar": True, "close_environment_at_exit": False}
    SequentialTrainer(env=envs, agents=agent, cfg={"timesteps": iterations * ROLLOUT_STEPS, **quiet}).train()
    if out:
        agent.save(str(out / "agent.pt"))
    return _acting(agent)


def play(sim: Sim, folder: Path) -> Act:
    """The policy that ``train`` saved."""
    _envs, agent = make(sim)
    agent.load(str(folder / "agent.pt"))
    return _acting(agent)


def _acting(agent: PPO) -> Act:
    @torch.no_grad()
    def act(obs: np.ndarray) -> np.ndarray:
        return agent.act(torch.from_numpy(obs), None, timestep=0, timesteps=0)[1]["mean_actions"].numpy()

    return act


if __name__ == "__main__":
    main(train, play, iterations=36)
