"""Learned agents that need the simulator: the tree with learned numbers, a policy over a set."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from uuvtai.common.enums import EGO_COLUMNS, N_OBSTACLE, N_RAY, OBSTACLE_WIDTH
from uuvtai.common.presets import POLICY
from uuvtai.config.behavior import FAST, SLOW, TUNED
from uuvtai.config.learning import LearningConfig
from uuvtai.config.loader import ConfigError
from uuvtai.learning import checkpoint as checkpoints
from uuvtai.learning.checkpoint import MANIFEST, MODEL, Checkpoint, Note
from uuvtai.learning.policy_agent import AgentDecision, HeldAgent, by_chunk, load_agent
from uuvtai.learning.set_networks import MOST_WISH, NUM_WISHES, SetActor, actor_of

if TYPE_CHECKING:
    from uuvtai.sim.sim import Sim


_FEWEST = 25  # numbers that a checkpoint holds; later ones, which it may lack, are not changed


class TunedAgent(HeldAgent):
    """Lets the simulator's tree drive, with other numbers from the first decision after a reset on."""

    def __init__(self, log_factor: Tensor, sim: Sim) -> None:
        """``log_factor`` (n_tuned, 2) natural logarithms of the factors, for slow obstacles and fast ones."""
        super().__init__(sim.num_envs, 1, sim.device)
        self.simulator = sim
        rows = sim.s.behavior.tuned.shape[0]
        self.log_factor = log_factor.float().cpu().numpy()[None].repeat(rows, axis=0)
        """(rows, n_tuned, 2) of every row that is allocated"""

    def reset(self, rows: Tensor) -> None:
        """A reset has set the numbers of these rows back."""
        self.simulator.put(self.simulator.s.behavior.tuned, self.log_factor)

    def decide(self, obs: Tensor) -> AgentDecision:
        self.decision = self.decision._replace(action=self.simulator.action.clone())
        return self.decision


def load_tuned(checkpoint: Checkpoint, sim: Sim) -> TunedAgent:
    """Agent of a checkpoint that holds numbers of the tree. Raises CheckpointError for impossible ones."""
    model = checkpoint.model()
    with checkpoints.refused(checkpoint.path / MODEL, "holds no numbers of the tree"):
        found = model["tree"]["log_factor"]
        known = len(found)
        if tuple(found.shape) != (known, 2) or not _FEWEST <= known <= len(TUNED):
            raise ValueError(f"log_factor is {tuple(found.shape)} instead of {(len(TUNED), 2)}")
        found = torch.cat([found, found.new_zeros(len(TUNED) - known, 2)])
        for number, factors in zip(TUNED, found.exp().tolist(), strict=True):
            for factor in factors:
                if not number.least * 0.999 <= factor <= number.most * 1.001:
                    raise ValueError(f"{number.name} is multiplied by {factor:g}")
    return TunedAgent(found, sim)


def tuned_sections(log_factor: Tensor) -> dict[str, dict[str, float]]:
    """Sections ``slow`` and ``fast`` of a stack that drives by these factors (n_tuned, 2), to four digits."""
    names, factors = [number.name for number in TUNED], np.exp(log_factor.double().numpy())
    return {
        section: {name: float(f"{x:.4g}") for name, x in zip(names, factors[:, part], strict=True)}
        for section, part in (("slow", SLOW), ("fast", FAST))
    }


class SetAgent(HeldAgent):
    """A policy over a set of obstacles driving the rows of a simulator: a wish for a velocity ten times a
    second, laid on the hull in every control step. It looks at tracks, map and pose itself."""

    def __init__(self, actor: SetActor, sim: Sim, config: LearningConfig) -> None:
        """``config``: what the policy learnt with, how long it holds a decision and what keeps it safe."""
        from uuvtai.sim.stages import bind
        from uuvtai.surrogate.arrays import EGO_WIDTH, RAW_WIDTH, ObserverIO, Rules

        super().__init__(sim.num_envs, config.policy.hold_steps, sim.device)
        self.actor, self._limits = actor, config.surrogate
        self._io, self._safe = bind(ObserverIO, sim.s, sim.config), bind(Rules, sim.config, partial=True)
        zeros = self._zeros
        self.ego, self._raw, self._ray = zeros(EGO_WIDTH), zeros(N_OBSTACLE, RAW_WIDTH), zeros(N_RAY)
        self.obstacles, self.own = zeros(N_OBSTACLE, OBSTACLE_WIDTH), zeros(EGO_COLUMNS)
        self.wish, self._last, self._command = zeros(NUM_WISHES), zeros(NUM_WISHES), zeros(4)
        """what is wished now, and what was carried out of the last decision"""
        std = torch.cat([actor.log_std.detach().exp(), torch.zeros(1, device=sim.device)])
        self.decision = self.decision._replace(std=std)

    def reset(self, rows: Tensor) -> None:
        super().reset(rows)
        self._last *= (self._age > 0)[:, None]

    @torch.no_grad()
    def decide(self, obs: Tensor) -> AgentDecision:
        """``obs`` is not looked at."""
        from uuvtai.surrogate.arrays import At
        from uuvtai.surrogate.observation import command_hull, observe_obstacles, write_set_columns
        from uuvtai.surrogate.safety import filter_wishes

        due = self._due()
        if len(due):
            is_due, horizon_s = (self._age % self._hold == 0).int(), self._limits.safety_horizon_s
            self.ego[:, At.LAST : At.LAST + NUM_WISHES] = self._last
            observe_obstacles(self._io, is_due, self.ego, self._raw, self._ray)
            write_set_columns(self.ego, self._raw, self._ray, self.obstacles, self.own)
            (wish,) = by_chunk(lambda *row: (self.actor(*row),), self.obstacles[due], self.own[due])
            self.wish[due] = wish.clamp(-MOST_WISH, MOST_WISH)
            if horizon_s:
                filter_wishes(self._safe, horizon_s, is_due, self.obstacles, self.own, self.wish)
        command_hull(self._io, self._limits.vertical_gap_m, self.wish, self._command)
        self.decision = self.decision._replace(action=self._command.clone())
        return self.decision

    def advance(self) -> None:
        due, wish = self._due(), self.wish
        long = wish[:, :2].norm(dim=1, keepdim=True).clamp(min=1.0)
        self._last[due] = torch.cat([wish[:, :2] / long, wish[:, 2:].clamp(-1.0, 1.0)], dim=1)[due]
        super().advance()


def load_set_agent(checkpoint: Checkpoint, sim: Sim) -> SetAgent:
    """Agent of a policy over a set of obstacles. Raises CheckpointError for networks that do not fit."""
    from uuvtai.surrogate.observation import SET_TABLE

    checkpoint.check_table(SET_TABLE, sim.config)
    return SetAgent(actor_of(checkpoint).to(sim.device), sim, checkpoint.config)


def find_policy(name: str, note: Note = lambda _text: None) -> Checkpoint:
    """The built-in policy, or the checkpoint of a checkpoint folder or of a run folder (its best, else its
    newest). Raises ConfigError for what is none of them, CheckpointError for what cannot be used."""
    path = Path(name)
    if name == POLICY:
        return checkpoints.built_in()
    if (path / MANIFEST).exists():
        return checkpoints.open_checkpoint(path)
    if (path / "checkpoints").is_dir():
        return checkpoints.best(path, note)
    told = (
        f"give {POLICY}, which is built in, the run folder of 'uuv train', or one of its checkpoints/step_N"
    )
    raise ConfigError(f"{name!r} is no trained policy: {told}")


def load_trained(checkpoint: Checkpoint, sim: Sim) -> HeldAgent:
    """The agent of a checkpoint, whatever learned it. Raises CheckpointError for one that does not fit."""
    from uuvtai.envs.vector_env import VectorEnv

    config = checkpoint.config
    if config.learner == "search":
        return load_tuned(checkpoint, sim)
    if config.learner == "ppo" and config.encoder == "set":
        return load_set_agent(checkpoint, sim)
    if config.learner == "ppo":
        checkpoint.check_table(VectorEnv(sim).observation_table, sim.config)
    return load_agent(checkpoint, sim.num_envs, sim.device)
