"""``gymnasium.Env`` of one vehicle: ``gymnasium.make("uuvtai/Nav-v0")``."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch

from uuvtai.env import VectorEnv
from uuvtai.gym.decision import carry_out, checked_hold_steps, public_info
from uuvtai.gym.frame import draw_frame
from uuvtai.gym.seeding import episode_seed
from uuvtai.gym.simulator import simulator
from uuvtai.gym.spaces import action_space, observation_space
from uuvtai.sim import Sim


class UuvEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One vehicle that plays the episodes 0, 1, 2, ... of its seed (of a simulator with n envs: 0, n, 2n,
    ..., in its first row).

    Observation float32 (n_obs,) in raw SI units (``native.observation_table`` names the columns), action
    float32 (4,): surge, sway, heave, yaw rate in parts of the vehicle's limits. Thousands of vehicles step at
    once in ``UuvVectorEnv``, at hundreds of times the speed of as many of these.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 50}

    def __init__(
        self,
        world: str = "pool",
        *,
        sensors: str | None = None,
        vehicle: str | None = None,
        overrides: dict[str, Any] | None = None,
        device: str = "cpu",
        teacher: str = "bt",
        hold_steps: int = 1,
        render_mode: str | None = None,
        sim: Sim | None = None,
    ) -> None:
        """As ``UuvVectorEnv``; ``render_mode`` 'rgb_array': ``render`` draws the pool from above. ValueError
        for other modes."""
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode {render_mode!r} does not exist; there are: None, 'rgb_array'")
        self.render_mode, self.hold_steps = render_mode, checked_hold_steps(hold_steps)
        self.native = VectorEnv(
            sim or simulator(world, 1, sensors, vehicle, overrides, device, teacher),
            autoreset=False,
            owns_sim=sim is None,
        )
        config, n = self.native.config, self.native.num_envs
        fps = round(1 / (config.episode.control_dt_s * hold_steps))
        self.metadata = {**self.metadata, "render_fps": fps}  # type: ignore[misc]
        self.observation_space = observation_space(self.native.observation_table, config)
        self.action_space = action_space()
        self._actions = torch.zeros(n, self.native.num_actions, device=self.native.device)
        self._first = torch.arange(n, device=self.native.device) == 0
        self._begun = self._over = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin episode 0 of ``seed``, or, with None, the next one (the first time of a random seed); (obs,
        info). There are no options."""
        if options:
            raise ValueError(f"reset options {sorted(options)} do not exist; there are none")
        obs, info = self.native.reset(episode_seed(self, seed), self._first if self._begun else None)
        self._begun, self._over = True, False
        return self._row(obs), self._info(info)

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Hold ``action`` (4,) for ``hold_steps``: (obs, reward, terminated, truncated, info); info as
        ``UuvVectorEnv.step`` names it.

        Raises RuntimeError before the first reset, after the end of an episode and after close, ValueError
        for unfit actions.
        """
        if self._over:
            raise RuntimeError("step after the end of the episode: call reset() first")
        given = torch.as_tensor(action, dtype=torch.float32)
        if given.shape != self.action_space.shape:
            raise ValueError(f"action must have shape {self.action_space.shape}, got {tuple(given.shape)}")
        self._actions[0] = given
        obs, reward, terminated, truncated, info = carry_out(self.native, self._actions, self.hold_steps)
        self._over = bool(terminated[0] | truncated[0])
        return self._row(obs), float(reward[0]), bool(terminated[0]), bool(truncated[0]), self._info(info)

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """The tank from above: map, true bodies, route, goal and vehicle, (height, width, 3) uint8; None
        without a render mode."""
        if self.render_mode is None:
            return None
        return draw_frame(self.native.sim, 0)

    def close(self) -> None:
        """Let go of the simulator; may be called again."""
        self.native.close()

    def _info(self, info: dict[str, torch.Tensor]) -> dict[str, Any]:
        out = {
            name: value[0].item() if value.ndim == 1 else self._row(value)
            for name, value in public_info(info).items()
        }
        return out | {"outcome": self.native.outcomes[int(out["outcome"])]}

    @staticmethod
    def _row(value: torch.Tensor) -> np.ndarray:
        """First row in memory of its own."""
        return value[0].cpu().numpy().copy()
