"""Stable-Baselines3: ``python examples/train_sb3.py --out runs/sb3``, then
``uuv eval --agent examples/own_sb3.py:load=runs/sb3``. SB3 unpickles both files: load your own only."""

import pickle
from pathlib import Path

from judge import HOLD_STEPS
from stable_baselines3 import PPO

from uuvtai import About, plugin


@plugin(hold_steps=HOLD_STEPS)
def load(about: About):
    """Scaled as in training, without exploration."""
    folder = Path(about.argument or "runs/sb3")
    model = PPO.load(folder / "model.zip", device="cpu")
    scales = pickle.loads((folder / "scales.pkl").read_bytes())
    return lambda obs: model.predict(scales.normalize_obs(obs), deterministic=True)[0]
