"""The batch as rsl_rl wants it: tensors, time-outs apart, observations in a TensorDict."""

from __future__ import annotations

from typing import Any

import torch
from gymnasium.vector import AutoresetMode
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from uuvtai.envs.gymnasium import UuvVectorEnv


class RslRlVecEnv(VecEnv):
    """``UuvVectorEnv`` for rsl_rl's runners; the observations are the group "policy"."""

    def __init__(self, envs: UuvVectorEnv, seed: int | None = None) -> None:
        """Begins the first episodes. ValueError for an env not in mode SAME_STEP with torch results: that is
        what rsl_rl assumes."""
        if envs.autoreset_mode is not AutoresetMode.SAME_STEP or envs.backend != "torch":
            raise ValueError(
                f"rsl_rl needs SAME_STEP and backend 'torch', got {envs.autoreset_mode.name} and "
                f"{envs.backend!r}"
            )
        self.envs, self.device, self.cfg = envs, envs.device, {}
        self.num_envs, self.num_actions = envs.num_envs, envs.native.num_actions
        self.max_episode_length = -(-envs.native.config.episode.horizon_steps // envs.hold_steps)
        self._steps = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)
        self._obs, _info = envs.reset(seed=seed)

    @property
    def episode_length_buf(self) -> torch.Tensor:  # type: ignore[override]
        """Steps of the running episodes, (num_envs,)."""
        return self._steps

    @episode_length_buf.setter
    def episode_length_buf(self, value: torch.Tensor) -> None:  # type: ignore[override]
        raise RuntimeError("episodes begin at their beginning: call learn(..., init_at_random_ep_len=False)")

    def get_observations(self) -> TensorDict:
        """The newest observations."""
        return TensorDict({"policy": self._obs}, batch_size=[self.num_envs])

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """One step of all envs; ``extras["time_outs"]`` tells ends by the horizon apart, ``extras["log"]``
        how the ended episodes went."""
        self._obs, reward, terminated, truncated, info = self.envs.step(actions)
        ended = terminated | truncated
        self._steps = (self._steps + 1) * ~ended
        log = {}
        if "final_info" in info:
            names = ("episode_return", "is_success")
            log = {f"/{name}": info["final_info"][name][ended].float().mean() for name in names}
        return self.get_observations(), reward, ended, {"time_outs": truncated.float(), "log": log}
