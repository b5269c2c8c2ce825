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
    from uuvtai.config.loader import load_config as load_config
    from uuvtai.envs.gymnasium import UuvEnv as UuvEnv
    from uuvtai.envs.gymnasium import UuvVectorEnv as UuvVectorEnv
    from uuvtai.envs.gymnasium import draw_frame as draw_frame
    from uuvtai.envs.rsl_rl import RslRlVecEnv as RslRlVecEnv
    from uuvtai.envs.sb3 import Sb3VecEnv as Sb3VecEnv
    from uuvtai.envs.vector_env import VectorEnv as VectorEnv
    from uuvtai.evaluation.simulate import Trial as Trial
    from uuvtai.evaluation.simulate import simulate as simulate
    from uuvtai.plugins import About as About
    from uuvtai.plugins import Forecast as Forecast
    from uuvtai.plugins import View as View
    from uuvtai.plugins import plugin as plugin
    from uuvtai.sim.sim import Sim as Sim

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
_OF_PLUGINS = ("About", "Forecast", "View", "plugin")
_OF_GYMNASIUM = ("UuvEnv", "UuvVectorEnv", "draw_frame")
_OF_SIMULATE = ("Trial", "simulate")
_SINGLE = ("RslRlVecEnv", "Sb3VecEnv", "Sim", "VectorEnv", "load_config")
_LATE = (*_OF_API, *_OF_PLUGINS, *_OF_GYMNASIUM, *_OF_SIMULATE, *_SINGLE)


def __getattr__(name: str) -> Any:
    """The commands as functions, what plugins need, and the environments, imported when one is asked for:
    they take a second or two, and some need an extra."""
    if name in _OF_API:
        from uuvtai import api as found
    elif name in _OF_PLUGINS:
        from uuvtai import plugins as found
    elif name in _OF_GYMNASIUM:
        from uuvtai.envs import gymnasium as found
    elif name in _OF_SIMULATE:
        from uuvtai.evaluation import simulate as found
    elif name == "load_config":
        from uuvtai.config import loader as found
    elif name == "RslRlVecEnv":
        from uuvtai.envs import rsl_rl as found
    elif name == "Sb3VecEnv":
        from uuvtai.envs import sb3 as found
    elif name == "VectorEnv":
        from uuvtai.envs import vector_env as found
    elif name == "Sim":
        from uuvtai.sim import sim as found
    else:
        raise AttributeError(f"module 'uuvtai' has no attribute {name!r}")
    return getattr(found, name)


def __dir__() -> list[str]:
    return [*globals(), *_LATE]
