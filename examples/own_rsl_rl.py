"""rsl_rl: ``python examples/train_rsl_rl.py --out runs/rsl_rl``, then
``uuv eval --agent examples/own_rsl_rl.py:load=runs/rsl_rl``."""

from pathlib import Path

import torch
from judge import HOLD_STEPS
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from train_rsl_rl import CONFIG

from uuvtai import About, plugin


@plugin(arrays="torch", hold_steps=HOLD_STEPS)
def load(about: About):
    """The actor alone, which scales its observations itself."""
    saved = torch.load(Path(about.argument or "runs/rsl_rl") / "model.pt", weights_only=False)
    options = {name: value for name, value in CONFIG["actor"].items() if name != "class_name"}

    def seen(obs):
        return TensorDict({"policy": obs}, batch_size=[len(obs)])

    actor = MLPModel(seen(torch.zeros(1, about.n_obs)), CONFIG["obs_groups"], "actor", 4, **options)
    actor.load_state_dict(saved["actor_state_dict"])
    actor.eval()
    return lambda obs: actor(seen(obs))
