"""The batch as Stable-Baselines3 wants it: NumPy arrays, a list of infos with the terminal observation."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv

from uuvtai.envs.gymnasium import UuvVectorEnv


class Sb3VecEnv(VecEnv):
    """``UuvVectorEnv`` for Stable-Baselines3's trainers, with the returns of episodes that they log."""

    def __init__(self, envs: UuvVectorEnv) -> None:
        """ValueError for an env that is not in mode SAME_STEP with NumPy results: that is what SB3
        assumes."""
        if envs.autoreset_mode is not AutoresetMode.SAME_STEP or envs.backend != "numpy":
            raise ValueError(
                f"Stable-Baselines3 needs SAME_STEP and backend 'numpy', got {envs.autoreset_mode.name} and "
                f"{envs.backend!r}"
            )
        self.envs = envs
        self._action = np.zeros(envs.action_space.shape or (), np.float32)
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> np.ndarray:
        """Begin an episode in every env, of the seed that was given by ``seed``."""
        obs, _info = self.envs.reset(seed=self._seeds[0])
        self._reset_seeds()
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for ``step_wait``."""
        self._action = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """One step of all envs; infos of those that ended tell what SB3 looks for: last observation, kind of
        end, return and length."""
        obs, reward, terminated, truncated, info = self.envs.step(self._action)
        ended = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row in np.flatnonzero(ended):
            final = info["final_info"]
            infos[row] = {
                "terminal_observation": info["final_obs"][row],
                "TimeLimit.truncated": bool(truncated[row] and not terminated[row]),
                "is_success": bool(final["is_success"][row]),
                "episode": {
                    "r": float(final["episode_return"][row]),
                    "l": -(-int(final["episode_steps"][row]) // self.envs.hold_steps),
                },
            }
        return obs, reward, ended, infos

    def close(self) -> None:
        """Close the envs."""
        self.envs.close()

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """No wrappers."""
        return [False] * len(self._rows(indices))

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The batch's attribute for each of these envs. Raises AttributeError where it has none."""
        return [getattr(self.envs, attr_name)] * len(self._rows(indices))

    def _rows(self, indices: Any) -> np.ndarray:
        """None = all, an int or several. Raises IndexError for an env that is not there."""
        rows = np.arange(self.num_envs) if indices is None else np.atleast_1d(indices)
        if odd := [row for row in rows if not -self.num_envs <= row < self.num_envs]:
            raise IndexError(f"there is no env {odd[0]}: the batch has {self.num_envs}")
        return rows

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """There are no single envs."""
        raise NotImplementedError("Sb3VecEnv has no attributes or methods of single envs")

    def env_method(self, agent_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """There are no single envs."""
        raise NotImplementedError("Sb3VecEnv has no attributes or methods of single envs")
