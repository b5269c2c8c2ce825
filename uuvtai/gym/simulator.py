"""The simulator behind an env of this package."""

from __future__ import annotations

from typing import Any

from uuvtai.loader import load_config
from uuvtai.sim import Sim
from uuvtai.tree import read_tree


def simulator(
    world: str,
    num_envs: int,
    sensors: str | None,
    vehicle: str | None,
    overrides: dict[str, Any] | None,
    device: str,
    teacher: str,
) -> Sim:
    """A new simulator; arguments and errors are those of ``uuvtai.make``."""
    if type(num_envs) is not int:
        raise TypeError(f"num_envs must be an int, got {num_envs!r}")
    config = load_config(world, sensors, vehicle, overrides)
    return Sim(config, num_envs, read_tree(teacher, config.teacher.max_node), device)
