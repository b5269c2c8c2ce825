"""Our environment as Stable-Baselines3 wants it: NumPy arrays, a list of infos with the terminal observation."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from uuvtai.env import VectorEnv


class Sb3Env(VecEnv):
    """``VectorEnv`` for Stable-Baselines3's trainers."""

    def __init__(self, env: VectorEnv) -> None:
        self.env = env
        self._action = torch.zeros(env.num_envs, env.num_actions)
        super().__init__(
            env.num_envs,
            spaces.Box(-np.inf, np.inf, (env.num_obs,), np.float32),
            spaces.Box(-1.0, 1.0, (env.num_actions,), np.float32),
        )

    def reset(self) -> np.ndarray:
        """Begin an episode in every env."""
        obs, _info = self.env.reset()
        return obs.numpy().copy()

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for ``step_wait``."""
        self._action.copy_(torch.from_numpy(actions))

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """One control step of all envs."""
        obs, reward, terminated, truncated, info = self.env.step(self._action)
        ended = (terminated | truncated).numpy()
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row in np.flatnonzero(ended):
            infos[row] = {"terminal_observation": info["final_obs"][row].numpy().copy(), "TimeLimit.truncated": bool(truncated[row])}
        return obs.numpy().copy(), reward.numpy().copy(), ended.copy(), infos

    def close(self) -> None:
        """Give the environment back."""
        self.env.close()

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """No wrappers."""
        return [False] * self.num_envs

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The same attribute for every env."""
        return [getattr(self.env, attr_name, None)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Its trainers do not ask for it."""
        raise NotImplementedError("Sb3Env has no attributes or methods of single envs")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Its trainers do not ask for it."""
        raise NotImplementedError("Sb3Env has no attributes or methods of single envs")
