"""PPO of TorchRL on the batch: ``python examples/train_torchrl.py`` (pip install 'uuvtai[torchrl]')."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from judge import HOLD_STEPS, Act, Watched, main
from tensordict.nn import TensorDictModule
from tensordict.nn.distributions import NormalParamExtractor
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper, TransformedEnv, VecNormV2
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from uuvtai import Sim

ROLLOUT_STEPS, EPOCHS, MINIBATCHES = 64, 5, 4


def network(inputs: int, outputs: int) -> nn.Sequential:
    """Two hidden layers."""
    return nn.Sequential(
        nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs)
    )


def policy(inputs: int, outputs: int) -> nn.Sequential:
    """Mean and spread of the actions."""
    return nn.Sequential(network(inputs, 2 * outputs), NormalParamExtractor("biased_softplus_0.5"))


def train(sim: Sim, iterations: int, out: Path | None = None) -> Act:
    """The policy after so many rollouts and updates, saved in ``out``; observations are scaled by TorchRL's
    own transform."""
    torch.manual_seed(0)
    norm = VecNormV2(["observation"], decay=1.0, reduce_batch_dims=True)
    envs = TransformedEnv(
        GymWrapper(Watched(sim=sim, hold_steps=HOLD_STEPS, autoreset_mode="Disabled")), norm
    )
    envs.set_seed(0)
    n_obs, n_act = envs.observation_spec["observation"].shape[-1], envs.action_spec.shape[-1]
    spread = policy(n_obs, n_act)
    actor = ProbabilisticActor(
        TensorDictModule(spread, ["observation"], ["loc", "scale"]),
        ["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    critic = ValueOperator(network(n_obs, 1), ["observation"])
    loss, advantage = (
        ClipPPOLoss(actor, critic, entropy_coeff=0.0, critic_coeff=0.5),
        GAE(gamma=0.99, lmbda=0.95, value_network=critic),
    )
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    frames = ROLLOUT_STEPS * sim.num_envs
    quiet = {"auto_register_policy_transforms": False}
    for batch in (
        Collector(envs, actor, frames_per_batch=frames, total_frames=iterations * frames, **quiet)
        if iterations
        else ()
    ):
        for _ in range(EPOCHS):
            advantage(batch)
            for part in batch.reshape(-1)[torch.randperm(frames)].split(frames // MINIBATCHES):
                terms = loss(part)
                optimizer.zero_grad()
                (terms["loss_objective"] + terms["loss_critic"]).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimizer.step()

    if out:
        scales = {"loc": norm.loc["observation"], "scale": norm.scale["observation"]}
        torch.save({"policy": spread.state_dict(), "shape": (n_obs, n_act), **scales}, out / "policy.pt")
    return _acting(spread, norm.loc["observation"], norm.scale["observation"])


def play(_sim: Sim, folder: Path) -> Act:
    """The policy that ``train`` saved."""
    saved = torch.load(folder / "policy.pt", weights_only=True)
    spread = policy(*saved["shape"])
    spread.load_state_dict(saved["policy"])
    return _acting(spread, saved["loc"], saved["scale"])


def _acting(spread: nn.Module, loc: torch.Tensor, scale: torch.Tensor) -> Act:
    def act(obs: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return spread((torch.from_numpy(obs) - loc) / scale)[0].numpy()

    return act


if __name__ == "__main__":
    main(train, play, iterations=36)
