"""Seeds as Gymnasium means them, as seeds of our episodes."""

from __future__ import annotations

import operator
from typing import Any

import gymnasium
from gymnasium.utils import seeding

from uuvtai.env import checked_seed

_SEEDS = 2**31


def episode_seed(env: gymnasium.Env | gymnasium.vector.VectorEnv, seed: Any) -> int | None:
    """Seed whose episodes ``env`` is to begin with; None = go on with the episodes that follow.

    An int is that seed, folded as ``uuvtai.make`` does. None goes on where the env has been seeded, and draws
    a seed where it has not. The env's generator is seeded along. Raises TypeError or ValueError for what is
    no seed; lists are refused, since env i plays episode i of one seed.
    """
    if seed is not None:
        given = _integer(seed)
        number = checked_seed(given)
        env._np_random, env._np_random_seed = seeding.np_random(given)
        return number
    if env._np_random_seed is not None:
        return None
    return int(env.np_random.integers(_SEEDS))


def _integer(seed: Any) -> int:
    try:
        return operator.index(seed)
    except TypeError:
        message = (
            f"seed must be an int or None, got a {type(seed).__name__}; one seed serves all envs: env i "
            "begins at its episode i"
        )
        raise TypeError(message) from None
