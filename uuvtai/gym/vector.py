"""``gymnasium.vector.VectorEnv`` on top of the batched environment: three autoreset modes, results as NumPy
arrays or torch tensors."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from uuvtai.env import VectorEnv
from uuvtai.gym.decision import carry_out, checked_hold_steps, public_info
from uuvtai.gym.seeding import episode_seed
from uuvtai.gym.simulator import simulator
from uuvtai.gym.spaces import action_space, observation_space
from uuvtai.sim import Sim

BACKENDS = ("numpy", "torch")


class UuvVectorEnv(gymnasium.vector.VectorEnv):
    """``num_envs`` vehicles in their worlds; env i plays the episodes i, i + num_envs, i + 2 num_envs, ... of
    the seed.

    Observations are float32 (num_envs, n_obs) in raw SI units (``native.observation_table`` names the
    columns), actions float32 (num_envs, 4): surge, sway, heave, yaw rate in parts of the vehicle's limits.
    Every result is in memory of its own: no later call writes into it. Who wants tensors without copies takes
    ``uuvtai.make`` or ``native``.

    Episodes end as ``metadata["autoreset_mode"]`` says. SAME_STEP: an env that ends begins its next episode
    in the same step, its last observation and info are ``info["final_obs"]`` and ``info["final_info"]`` where
    ``info["_final_obs"]``. NEXT_STEP: the step after the last one ignores the action and begins the episode
    with reward 0. DISABLED: the user does, by ``reset(options={"reset_mask": mask})``.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}

    def __init__(
        self,
        world: str = "pool",
        num_envs: int = 64,
        *,
        sensors: str | None = None,
        vehicle: str | None = None,
        overrides: dict[str, Any] | None = None,
        device: str = "cpu",
        teacher: str = "bt",
        hold_steps: int = 1,
        autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
        backend: str = "numpy",
        sim: Sim | None = None,
    ) -> None:
        """World to teacher as in ``uuvtai.make``, with its errors; ``sim`` = a simulator that is there
        already, with its own of these.

        ``hold_steps``: control steps (0.02 s) that an action is held for, one step to the user; ``backend``:
        'numpy' or 'torch' results. ValueError for modes and backends that do not exist.
        """
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}  # type: ignore[misc]
        self.backend, self.hold_steps = _checked_backend(backend), checked_hold_steps(hold_steps)
        owns_sim = sim is None
        sim = sim or simulator(world, num_envs, sensors, vehicle, overrides, device, teacher)
        self.native = VectorEnv(sim, autoreset=False, owns_sim=owns_sim)
        self.num_envs, self.device = sim.num_envs, sim.device
        self.single_observation_space = observation_space(self.native.observation_table, sim.config)
        self.single_action_space = action_space()
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._ended = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in every env, or where ``options["reset_mask"]`` (num_envs,) is true; (obs, info).

        With an int ``seed``, env i begins at episode i of it; with None each goes on with its next episode,
        the first time of a random seed. Raises TypeError or ValueError for other seeds (lists too), options
        and masks.
        """
        rows = self._rows(options)
        obs, info = self.native.reset(episode_seed(self, seed), rows)
        self._ended = self._ended & ~rows
        return self._given(obs), self._info(public_info(info), rows)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Hold ``actions`` (num_envs, 4), NumPy or torch, for ``hold_steps``: (obs, reward, terminated,
        truncated, info).

        info holds arrays (num_envs, ...) with their masks: ``outcome`` (index into ``native.outcomes``),
        ``is_success``, ``episode_return``, ``episode_steps`` (control steps), ``episode_terms`` (sums by
        ``native.reward_terms``), ``seed``, ``episode_number`` and ``teacher_action`` (what the behaviour tree
        would do now). Raises RuntimeError before the first reset, after close, and in mode DISABLED while an
        env that has ended is not reset; ValueError or TypeError for unfit actions.
        """
        self._refuse_ended()
        obs, reward, terminated, truncated, info = carry_out(
            self.native, self._action(actions), self.hold_steps
        )
        ended, final = terminated | truncated, {}
        if self.autoreset_mode is AutoresetMode.SAME_STEP and bool(ended.any()):
            final = self._final(obs, info, ended)
            obs, info = self.native.reset(mask=ended)
        elif self.autoreset_mode is AutoresetMode.NEXT_STEP and bool(self._ended.any()):
            obs, info = self.native.reset(mask=self._ended)
            terminated, truncated = terminated & ~self._ended, truncated & ~self._ended
        self._ended = (terminated | truncated) & (self.autoreset_mode is not AutoresetMode.SAME_STEP)
        everyone = torch.ones_like(ended)
        results = (self._given(value) for value in (obs, reward, terminated, truncated))
        return *results, self._info(public_info(info), everyone) | final  # type: ignore[return-value]

    def close_extras(self, **_kwargs: Any) -> None:
        """Let go of the simulator."""
        self.native.close()

    def _final(self, obs: torch.Tensor, info: dict[str, torch.Tensor], ended: torch.Tensor) -> dict[str, Any]:
        """Last observation and info of the rows that ended; as objects, None elsewhere, where Gymnasium's own
        NumPy envs do so."""
        last = self._given(obs)
        if self.backend == "numpy":
            rows, last = last, np.full(self.num_envs, None, dtype=object)
            for row in np.flatnonzero(self._given(ended)):
                last[row] = rows[row].copy()
        mask = {"_final_obs": self._given(ended), "_final_info": self._given(ended)}
        return {"final_obs": last, "final_info": self._info(public_info(info), ended), **mask}

    def _info(self, values: dict[str, torch.Tensor], rows: torch.Tensor) -> dict[str, Any]:
        """Every value with the mask of the rows that have it."""
        out = {name: self._given(value) for name, value in values.items()}
        return out | {f"_{name}": self._given(rows) for name in values}

    def _given(self, value: torch.Tensor) -> Any:
        """In the user's kind of array, in memory of its own."""
        return value.clone() if self.backend == "torch" else value.cpu().numpy().copy()

    def _action(self, actions: Any) -> torch.Tensor:
        """(num_envs, 4) float32 on the device; the environment refuses other shapes."""
        return torch.as_tensor(actions, dtype=torch.float32, device=self.device)

    def _rows(self, options: dict[str, Any] | None) -> torch.Tensor:
        """Rows to reset; TypeError or ValueError for options that do not exist or fit."""
        given = dict(options or {})
        mask = given.pop("reset_mask", None)
        if given:
            raise ValueError(
                f"reset options {sorted(given)} do not exist; there is 'reset_mask', a bool array of shape "
                f"({self.num_envs},)"
            )
        if mask is None:
            return torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        rows = torch.as_tensor(mask, device=self.device)
        if rows.dtype != torch.bool:
            raise TypeError(f"reset_mask must be bool, got {rows.dtype}")
        if rows.shape != (self.num_envs,) or not bool(rows.any()):
            raise ValueError(
                f"reset_mask must have shape ({self.num_envs},) and be true somewhere, got "
                f"{tuple(rows.shape)}"
            )
        return rows

    def _refuse_ended(self) -> None:
        if self.autoreset_mode is AutoresetMode.DISABLED and bool(self._ended.any()):
            rows = ", ".join(map(str, self._ended.nonzero().flatten().tolist()[:8]))
            raise RuntimeError(
                f'step after the end of env {rows}: call reset(options={{"reset_mask": terminated | '
                f"truncated}}) first"
            )


def _checked_backend(backend: str) -> str:
    if backend not in BACKENDS:
        raise ValueError(f"backend {backend!r} does not exist; there are: {', '.join(BACKENDS)}")
    return backend
