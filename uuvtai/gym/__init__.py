"""Gymnasium's interfaces: the batch ``UuvVectorEnv`` and the single env ``uuvtai/Nav-v0``, registered when
this is imported.

``gymnasium.make("uuvtai.gym:uuvtai/Nav-v0")`` imports it by itself; Gymnasium reads no entry points from 1.0
on.
"""

from __future__ import annotations

try:
    import gymnasium
except ModuleNotFoundError as error:
    if error.name != "gymnasium":
        raise
    raise ModuleNotFoundError(
        "uuvtai.gym needs Gymnasium; install it with: pip install 'uuvtai[gym]'", name="gymnasium"
    ) from None

from uuvtai.gym.single import UuvEnv
from uuvtai.gym.vector import UuvVectorEnv

__all__ = ["ENV_ID", "UuvEnv", "UuvVectorEnv"]

ENV_ID = "uuvtai/Nav-v0"
"""for ``gymnasium.make`` and ``gymnasium.make_vec``"""

gymnasium.register(
    ENV_ID, entry_point="uuvtai.gym.single:UuvEnv", vector_entry_point="uuvtai.gym.vector:UuvVectorEnv"
)
