"""Simulators of the worlds that a trainer plays in."""

from __future__ import annotations

from typing import TYPE_CHECKING

from uuvtai.config.learning import LearningConfig

if TYPE_CHECKING:
    from uuvtai.scenario import Scene
    from uuvtai.sim import Sim


def simulator_of(config: LearningConfig, world: str, scenes: tuple[Scene, ...]) -> Sim:
    """A simulator of a world with room for every scene, on the run's sensors and stack. Raises
    ConfigError."""
    from uuvtai.loader import load_config
    from uuvtai.shipped import TRAINING_TREE
    from uuvtai.sim import Sim
    from uuvtai.tree import read_tree

    most = [("world.n_static", max(s[0] for s in scenes)), ("world.n_dynamic", max(s[1] for s in scenes))]
    config = config.model_copy(update={"world": load_config(world, overrides=[*most]).world})
    return Sim(config, config.train.num_envs, read_tree(TRAINING_TREE, config.teacher.max_node))
