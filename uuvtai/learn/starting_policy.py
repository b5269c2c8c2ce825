"""The policy that a training of a policy over a set of bodies begins with (``twin.start``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from uuvtai.config.learning import LearningConfig
from uuvtai.errors import SettingError
from uuvtai.learn import checkpoint
from uuvtai.learn.set_networks import actor_of

if TYPE_CHECKING:
    from uuvtai.learn.set_policy import SetActor, SetCritic

_SAME = ("body_hidden", "head_hidden", "goal_gain")
"""keys of the config that are part of the networks"""


@dataclass(frozen=True)
class StartingPolicy:
    """Networks to begin with."""

    actor: Mapping[str, torch.Tensor]
    critic: Mapping[str, torch.Tensor] | None
    """None where the checkpoint has networks that drive, and nothing else: a critic then begins anew"""

    def give(self, actor: SetActor, critic: SetCritic) -> None:
        """Put them into a trainer's networks; how much it explores stays the trainer's."""
        own = actor.log_std.detach().clone()
        actor.load_state_dict(self.actor)
        with torch.no_grad():
            actor.log_std.copy_(own)
        if self.critic is not None:
            critic.load_state_dict(self.critic)


def starting_policy(config: LearningConfig) -> StartingPolicy | None:
    """What ``twin.start`` names: of a run folder the best checkpoint; None where it names nothing. Raises
    SettingError or CheckpointError for what does not fit."""
    from uuvtai.twin.observer import SET_TABLE

    if not config.twin.start:
        if config.twin.simulator:
            raise SettingError(
                "twin.start: names no policy to begin with in the simulator; train one (uuv train twin "
                "--run-dir runs/twin), then: uuv train finetune --set twin.start=runs/twin"
            )
        return None
    path = Path(config.twin.start)
    found = checkpoint.best(path) if (path / "checkpoints").is_dir() else checkpoint.open_checkpoint(path)
    if not found.config.twin.enabled:
        raise SettingError(
            f"twin.start={path}: was not trained in the twin; train one: uuv train twin --run-dir {path}"
        )
    for name in _SAME:
        own, theirs = getattr(config.twin, name), getattr(found.config.twin, name)
        if own != theirs:
            raise SettingError(
                f"twin.start={path}: has twin.{name}={theirs}, this run {own}: --set twin.{name}={theirs}"
            )
    found.check_table(SET_TABLE, config)
    critic = found.training().get("critic") if found.manifest.training is not None else None
    return StartingPolicy(actor_of(found).state_dict(), critic)
