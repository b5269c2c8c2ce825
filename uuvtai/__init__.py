"""uuvtai: train, measure and inspect observation-only navigation for underwater vehicles."""

from __future__ import annotations

import os

from uuvtai.common.version import __version__ as __version__
from uuvtai.compile.first_import import watch_for_taichi

# without typing, which takes longer to import than this file: signals are not heard before it is done
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from uuvtai.api import evaluate as evaluate
    from uuvtai.api import load_log as load_log
    from uuvtai.api import show as show
    from uuvtai.api import sweep as sweep
    from uuvtai.api import train as train
    from uuvtai.envs.vector_env import VectorEnv

# Taichi prints a banner to stdout when it is imported; stdout belongs to results
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
# and it asks a server for its newest version, once a day; nothing here uses the network that was not told to
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")
watch_for_taichi()


def make(
    world: str = "pool",
    num_envs: int = 1024,
    seed: int = 0,
    device: str = "cpu",
    overrides: dict[str, Any] | None = None,
    sensors: str | None = None,
    vehicle: str | None = None,
    teacher: str = "bt",
    check_actions: bool | None = None,
) -> VectorEnv:
    """Torch-native batch of ``num_envs`` vehicles in a world; presets are names or paths of files (see ``uuv
    presets``).

    ``overrides`` maps dotted config keys to values, ``{"world.n_dynamic": 9}``; ``teacher`` is the behaviour
    tree behind ``info["teacher_action"]``; ``device`` is 'cpu', 'cuda' or 'auto'. Raises ConfigError, a
    ValueError, for presets, keys and values that do not exist or fit, ValueError or MemoryError for
    impossible sizes, RuntimeError for a missing device. The rest is told at
    ``uuvtai.envs.vector_env.VectorEnv``.
    """
    from uuvtai.config.loader import load_config
    from uuvtai.envs.vector_env import VectorEnv, checked_seed
    from uuvtai.sim.behavior_tree import read_tree
    from uuvtai.sim.sim import Sim

    if type(num_envs) is not int:
        raise TypeError(f"num_envs must be an int, got {num_envs!r}")
    checked_seed(seed)
    config = load_config(world, sensors, vehicle, overrides)
    return VectorEnv(Sim(config, num_envs, read_tree(teacher), device), seed, check_actions, owns_sim=True)


_OF_API = ("evaluate", "load_log", "show", "sweep", "train")


def __getattr__(name: str) -> Any:
    """The commands as functions, imported when one is asked for: they take a second or two."""
    if name not in _OF_API:
        raise AttributeError(f"module 'uuvtai' has no attribute {name!r}")
    from uuvtai import api

    return getattr(api, name)


def __dir__() -> list[str]:
    return [*globals(), *_OF_API]
