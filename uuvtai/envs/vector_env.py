"""Vectorised environment on top of the simulator: reset and step, automatic resets, the table of the
observation.

Every tensor is torch's own memory, written by the kernels: nothing is copied, and the same tensors come back
from every call. Clone what must outlive the next ``step`` or ``reset``.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import operator
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from uuvtai.common.enums import OUTCOMES
from uuvtai.config import Config
from uuvtai.config.base import folded_seed
from uuvtai.config.task import TERMS
from uuvtai.kernels.behavior.tree import write_leaf
from uuvtai.kernels.planning.observation import placed_columns
from uuvtai.kernels.task.reward import write_ends, write_results
from uuvtai.kernels.vehicle.control import take_action
from uuvtai.sim.sim import Sim
from uuvtai.sim.snapshot import capture, check_arrays, check_setting, restore

NUM_ACTIONS = 4
"""surge, sway, heave, yaw rate"""

_STEP_RESULTS = ("reward_terms", "episode_terms", "episode_return", "episode_steps", "outcome")
"""What ``tell_step`` writes, in its order."""

Slice = slice


@dataclass(frozen=True)
class ObservationColumn:
    """Neighbouring columns of the observation that hold one quantity."""

    name: str
    slice: Slice
    unit: str
    frame: str
    meaning: str


def observation_sha256(table: tuple[ObservationColumn, ...]) -> str:
    """Fingerprint of names, widths, units and frames in their order: policies of another one cannot read this
    observation."""
    rows = [
        (column.name, column.slice.stop - column.slice.start, column.unit, column.frame) for column in table
    ]
    return hashlib.sha256(json.dumps(rows).encode()).hexdigest()


class VectorEnv(AbstractContextManager["VectorEnv"]):
    """``num_envs`` episodes side by side; an env whose episode ends begins its next one in the same step
    (``autoreset``).

    Env i runs the episodes i, i + num_envs, i + 2 num_envs, ... of its seed, the same scenarios whatever is
    done in them. Actions are float32 (num_envs, 4): surge, sway, heave, yaw rate in parts of the vehicle's
    limits, body frame; beyond [-1, 1] they are clamped. Observations are float32 (num_envs, num_obs) in raw
    SI units, as ``observation_table`` says: scaling is the policy's business.

    ``sim`` may be shared, for example with an evaluation: whoever else has reset it, call ``reset`` before
    the next ``step``.
    """

    outcomes = OUTCOMES
    """names of ``info["outcome"]``, by index"""
    reward_terms = TERMS
    """names of the columns of ``info["reward_terms"]`` and ``info["episode_terms"]``"""

    def __init__(
        self,
        sim: Sim,
        seed: int = 0,
        check_actions: bool | None = None,
        autoreset: bool = True,
        owns_sim: bool = False,
    ) -> None:
        """``check_actions``: refuse actions that are not finite (default: on the CPU; a GPU would wait).
        Unchecked, NaN = stop.

        Without ``autoreset`` an env whose episode has ended rests: it earns 0 and tells its end again in
        every step, until a ``reset`` with a mask begins its next episode. ``owns_sim``: ``close`` closes the
        simulator, too.
        """
        self.sim, self.num_envs, self.device = sim, sim.num_envs, sim.device
        self.config, self.autoreset = sim.config, autoreset
        self.check_actions = sim.device.type == "cpu" if check_actions is None else check_actions
        self.observation_table = tuple(
            ObservationColumn(
                column.name, slice(first, first + width), column.unit, column.frame, column.meaning
            )
            for column, first, width in placed_columns(sim.config.observation)
        )
        self.columns = {column.name: column.slice for column in self.observation_table}
        self.observation_sha256 = observation_sha256(self.observation_table)
        self.num_obs, self.num_actions = self.observation_table[-1].slice.stop, NUM_ACTIONS
        self._obs = torch.zeros(self.num_envs, self.num_obs, device=self.device)
        self._first_number = torch.arange(self.num_envs, dtype=torch.int32, device=self.device)
        self._seed = torch.full_like(self._first_number, checked_seed(seed))
        self._number = self._first_number.clone()
        self._terminated, self._truncated = (
            torch.zeros(self.num_envs, dtype=torch.bool, device=self.device) for _ in range(2)
        )
        self._ends = self._terminated.view(torch.uint8), self._truncated.view(torch.uint8)
        self._asked = torch.zeros(self.num_envs, NUM_ACTIONS, device=self.device)
        self._info = {
            "teacher_action": sim.action,
            "leaf": torch.full_like(self._number, -1),
            "seed": self._seed,
            "episode": self._number,
            "final_obs": torch.zeros_like(self._obs),
            "outcome": torch.zeros_like(self._number),
            "reward_terms": torch.zeros(self.num_envs, len(TERMS), device=self.device),
            "episode_terms": torch.zeros(self.num_envs, len(TERMS), device=self.device),
            "episode_return": torch.zeros(self.num_envs, device=self.device),
            "episode_steps": torch.zeros_like(self._number),
        }
        self._begun = self._closed = False
        self._owns_sim = owns_sim
        self._ask: Callable[[], Mapping[str, torch.Tensor]] | None = None
        self.driven = torch.zeros_like(self._asked)
        """(num_envs, 4) the action of the last step, where terms were added"""

    def add_terms(self, ask: Callable[[], Mapping[str, torch.Tensor]]) -> None:
        """Add to the reward what ``ask`` says after each step, float32 (num_envs,) by name. It is asked once
        before the first step, for the names."""
        self.reset()
        self.reward_terms = (*TERMS, *ask())
        for name in ("reward_terms", "episode_terms"):
            self._info[name] = torch.zeros(self.num_envs, len(self.reward_terms), device=self.device)
        self._ask, self._begun = ask, False

    def _add_own_terms(self, ask: Callable[[], Mapping[str, torch.Tensor]]) -> None:
        """Of the step that was just taken: rows that rest earn nothing."""
        sim, info = self.sim, self._info
        running = torch.as_tensor(sim.rows(sim.s.clock.active) == 1, device=self.device)
        own = torch.stack([*ask().values()], dim=1) * running[:, None]
        sums = info["episode_terms"][:, len(TERMS) :]
        sums.masked_fill_((running & (info["episode_steps"] <= 1))[:, None], 0.0)
        sums += own
        info["reward_terms"][:, len(TERMS) :] = own
        info["episode_return"] += sums.sum(dim=1)
        sim.reward += own.sum(dim=1)

    def reset(
        self, seed: int | None = None, mask: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Begin an episode in every env, or in those where ``mask`` (num_envs,) is true; returns (obs, info)
        as ``step`` does.

        With a ``seed``, env i begins at episode i of it. Without, the first reset begins at episode i of the
        constructor's seed, later ones go on with each env's next episode.
        """
        self._require_open()
        rows = self._rows_of(mask)
        if not self._begun and not bool(rows.all()):
            raise RuntimeError("the first reset must begin every env: call reset() without a mask first")
        if seed is not None:
            self._seed.masked_fill_(rows, checked_seed(seed))
            torch.where(rows, self._first_number, self._number, out=self._number)
        elif self._begun:
            self._number += self.num_envs * rows
        self.sim.observation = self._obs
        self._begin(rows)
        write_leaf(self.sim.io.behavior, self._info["leaf"])
        self._begun = True
        for name in ("outcome", "episode_return", "episode_steps"):
            self._info[name].masked_fill_(rows, 0)
        for name in ("reward_terms", "episode_terms"):
            self._info[name].masked_fill_(rows[:, None], 0)
        torch.where(rows[:, None], self._obs, self._info["final_obs"], out=self._info["final_obs"])
        return self._obs, dict(self._info)

    def step(
        self, action: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
        """Apply ``action`` for one control step: (obs, reward, terminated, truncated, info).

        terminated: success, or a stop by the termination check; truncated: the horizon was reached; both bool
        (num_envs,). Envs that ended have already begun their next episode: obs, ``info["teacher_action"]``
        (what the behaviour tree would do now), ``info["leaf"]`` (which of its nodes says so, an index into
        ``node_names``, -1 = none), ``info["seed"]`` and ``info["episode"]`` belong to it. To the step itself
        belong reward and ``info["final_obs"]`` (the observation the step led to, of every env: the next state
        to bootstrap from), ``info["outcome"]`` (index into ``outcomes``), ``info["reward_terms"]`` (num_envs,
        number of terms: what each weighted term of ``reward_terms`` adds to the reward), and
        ``info["episode_terms"]`` (their sums), ``info["episode_return"]`` and ``info["episode_steps"]`` of
        the episode so far, whole where it ended.
        """
        self._require_open()
        if not self._begun:
            raise RuntimeError("step before reset: call reset() first")
        self._check_action(action)
        sim, info = self.sim, self._info
        sim.observation = self._obs
        self._take(action.detach())
        if self._ask:
            self.driven.copy_(sim.action)
        sim.step()
        info["final_obs"].copy_(self._obs)
        write_results(sim.io.reward, *(info[name] for name in _STEP_RESULTS))
        if self._ask:
            self._add_own_terms(self._ask)
        write_ends(sim.io.reward, *self._ends)
        told = sim.counts.any_ended
        if sim.counts.number(sim.s.reward.n_ended) if told is None else told:
            self._go_on(self._terminated | self._truncated)
        write_leaf(sim.io.behavior, info["leaf"])
        return self._obs, sim.reward, self._terminated, self._truncated, dict(info)

    @property
    def node_names(self) -> tuple[str, ...]:
        """What the nodes of the behaviour tree are called, in the order of ``info["leaf"]``."""
        return self.sim.tree.names

    def capture(self) -> dict[str, np.ndarray]:
        """All that the next steps depend on, as arrays that a file can hold: ``restore`` goes on from them
        bit for bit (on the CPU).

        About 0.3 MB an env, most of it maps that compress well. Copies; the environment is not changed.
        """
        self._require_open()
        if not self._begun:
            raise RuntimeError("capture before reset: call reset() first")
        out = {f"sim.{name}": array for name, array in capture(self.sim.memory()).items()}
        out |= {f"env.{name}": tensor.cpu().numpy().copy() for name, tensor in self._carried().items()}
        return out | {"setting": np.frombuffer(self._setting().encode(), dtype=np.uint8).copy()}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Go on from what ``capture`` gave, here or in another process; returns (obs, info) as they were. No
        ``reset`` is needed before.

        ValueError, with nothing changed, for arrays that are missing, unknown or of another size, and for
        another config or tree.
        """
        self._require_open()
        arrays = dict(arrays)
        check_setting(arrays.pop("setting", None), self._setting())
        own = self._carried()
        of_env = {
            name.removeprefix("env."): array for name, array in arrays.items() if name.startswith("env.")
        }
        check_arrays(of_env, {name: tensor.cpu().numpy() for name, tensor in own.items()})
        of_sim = {
            name.removeprefix("sim."): array for name, array in arrays.items() if not name.startswith("env.")
        }
        restore(self.sim.memory(), of_sim)
        for name, tensor in own.items():
            tensor.copy_(torch.from_numpy(of_env[name]))
        self._begun = True
        return self._obs, dict(self._info)

    def _carried(self) -> dict[str, torch.Tensor]:
        """Every tensor that is carried from step to step, or was returned by the last one."""
        own = {"obs": self._obs, "terminated": self._terminated, "truncated": self._truncated}
        return own | self._info | {"reward": self.sim.reward}

    def _setting(self) -> str:
        """JSON of what a captured state fits to."""
        nodes = dataclasses.asdict(self.sim.tree)
        for origin in ("source", "xml"):  # where it was read from changes nothing
            nodes.pop(origin)
        return json.dumps(
            {
                "num_envs": self.num_envs,
                "tree": nodes,
                **self.config.model_dump(mode="json", include=set(Config.model_fields)),
            }
        )

    def close(self) -> None:
        """Stop asking the simulator for observations, and give its memory back where it is nobody else's; may
        be called again."""
        if self._closed:
            return
        self._closed = True
        if self.sim.observation is self._obs:
            self.sim.observation = None
        if self._owns_sim:
            self.sim.close()

    def __exit__(self, *_error: Any) -> None:
        self.close()

    def _go_on(self, ended: torch.Tensor) -> None:
        """The next episodes of the rows that ended, or rest."""
        if not self.autoreset:
            self.sim.deactivate_ended()
            return
        self._number += self.num_envs * ended
        self._begin(ended)

    def _begin(self, rows: torch.Tensor) -> None:
        self.sim.reset(rows.to(torch.int32), self._seed, self._number)

    def _require_open(self) -> None:
        if self._closed:
            raise RuntimeError("this environment is closed; make another one")

    def _rows_of(self, mask: torch.Tensor | None) -> torch.Tensor:
        """Rows to reset as bool; raises TypeError or ValueError for a mask that does not fit."""
        if mask is None:
            return torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        if not isinstance(mask, torch.Tensor) or mask.dtype not in (torch.bool, torch.int32):
            raise TypeError(f"mask must be a torch tensor of bool or int32, got {_described(mask)}")
        if mask.shape != (self.num_envs,) or mask.device.type != self.device.type:
            raise ValueError(
                f"mask must have shape ({self.num_envs},) on {self.device}, got {_described(mask)}"
            )
        return mask != 0

    def _check_action(self, action: torch.Tensor) -> None:
        if not isinstance(action, torch.Tensor) or action.dtype != torch.float32:
            raise TypeError(
                f"action must be a float32 torch tensor, got {_described(action)}; use "
                "torch.as_tensor(action).float()"
            )
        if action.layout != torch.strided:
            raise TypeError(
                f"action must be a dense tensor, got one of layout {action.layout}; use action.to_dense()"
            )
        if action.shape != (self.num_envs, NUM_ACTIONS):
            raise ValueError(
                f"action must have shape ({self.num_envs}, {NUM_ACTIONS}), got {_described(action)}"
            )
        if action.device.type != self.device.type:
            raise ValueError(
                f"action must be on {self.device}, got {_described(action)}; use action.to(env.device)"
            )

    def _take(self, action: torch.Tensor) -> None:
        """Have the simulator drive by it; raises ValueError, with nothing changed, where it is to be looked
        at and not finite."""
        sim = self.sim
        if not self.check_actions:
            sim.action.copy_(action)
            return
        self._asked.copy_(action)
        take_action(sim.io.actuation, self._asked, sim.action)
        if sim.counts.number(sim.s.actuation.n_not_finite):
            bad = (~torch.isfinite(action).all(dim=1)).nonzero().flatten().tolist()
            raise ValueError(
                f"action is not finite in env {', '.join(map(str, bad[:8]))}{' ...' if len(bad) > 8 else ''}"
            )


def _described(value: Any) -> str:
    if isinstance(value, torch.Tensor):
        return f"a {value.dtype} tensor of shape {tuple(value.shape)} on {value.device}"
    return f"a {type(value).__name__}"


def checked_seed(seed: int) -> int:
    """The seed as kernels count with it (``folded_seed``); TypeError or ValueError where it cannot be one."""
    if isinstance(seed, bool) or not hasattr(type(seed), "__index__"):
        raise TypeError(f"seed must be an int, got a {type(seed).__name__}")
    number = operator.index(seed)
    if number < 0:
        raise ValueError(f"seed {number} is negative; give one of 0 and more")
    return folded_seed(number)
