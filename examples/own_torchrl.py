"""TorchRL: ``python examples/train_torchrl.py --out runs/torchrl``, then
``uuv eval --agent examples/own_torchrl.py:load=runs/torchrl``."""

from pathlib import Path

import torch
from judge import HOLD_STEPS
from train_torchrl import policy

from uuvtai import About, plugin


@plugin(arrays="torch", hold_steps=HOLD_STEPS)
def load(about: About):
    """Scaled as in training; the mean of the actions."""
    saved = torch.load(Path(about.argument or "runs/torchrl") / "policy.pt", weights_only=True)
    spread = policy(*saved["shape"])
    spread.load_state_dict(saved["policy"])
    return lambda obs: spread((obs - saved["loc"]) / saved["scale"])[0]
