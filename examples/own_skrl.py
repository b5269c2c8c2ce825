"""skrl: ``python examples/train_skrl.py --out runs/skrl``, then
``uuv eval --agent examples/own_skrl.py:load=runs/skrl``."""

from pathlib import Path

import numpy as np
import torch
from gymnasium.spaces import Box
from judge import HOLD_STEPS
from skrl.resources.preprocessors.torch import RunningStandardScaler
from train_skrl import Policy

from uuvtai import About, plugin


@plugin(arrays="torch", hold_steps=HOLD_STEPS)
def load(about: About):
    """The policy and the scales of its observations."""
    saved = torch.load(Path(about.argument or "runs/skrl") / "agent.pt", weights_only=False)
    seen, done = Box(-np.inf, np.inf, (about.n_obs,)), Box(-1.0, 1.0, (4,))
    policy = Policy(observation_space=seen, action_space=done, device="cpu")
    policy.load_state_dict(saved["policy"])
    scales = RunningStandardScaler(size=seen, device="cpu")
    scales.load_state_dict(saved["observation_preprocessor"])
    return lambda obs: policy.net(scales(obs))
