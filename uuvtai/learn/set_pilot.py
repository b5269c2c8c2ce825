"""A policy over a set of bodies at the wheel of the simulator: a wish for a velocity ten times a second,
laid on the hull by the fixed rule in every control step."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from uuvtai.learn.checkpoint import Checkpoint
from uuvtai.learn.pilot import PilotDecision, by_chunk
from uuvtai.learn.set_networks import actor_of
from uuvtai.learn.set_policy import MOST_WISH, SetActor
from uuvtai.learn.set_wheel import SetWheel

if TYPE_CHECKING:
    from uuvtai.sim import Sim


class SetPilot(SetWheel):
    """Drives the rows of a simulator; used as ``Pilot`` is, but it looks at tracks, map and pose itself."""

    world_model = None

    def __init__(self, actor: SetActor, sim: Sim, hold_steps: int, gap_m: float) -> None:
        """``hold_steps`` control steps a decision; the centre stays ``gap_m`` from floor and surface."""
        super().__init__(sim, gap_m)
        self.actor, self._hold = actor, hold_steps
        self._age = torch.zeros(sim.num_envs, dtype=torch.int64, device=sim.device)
        std = torch.cat([actor.log_std.detach().exp(), torch.zeros(1, device=sim.device)])
        nothing = torch.zeros(sim.num_envs, device=sim.device)
        self.decision = PilotDecision(self._command, nothing, std, nothing, nothing)
        """value, residual and uncertainty are 0: what drives has no critic and no world model"""

    def reset(self, rows: torch.Tensor) -> None:
        """New episodes have begun in the rows (num_envs,) where this is not 0."""
        kept = rows.to(self._age.device) == 0
        self._age *= kept
        self.last *= kept[:, None]

    @torch.no_grad()
    def decide(self, _obs: torch.Tensor) -> PilotDecision:
        """Command for all rows; changes nothing that the next one depends on."""
        due = self._due()
        if bool(due.any()):
            self.look(due)
            rows = due.nonzero().flatten()
            wish = by_chunk(self.actor, self.bodies[rows], self.own[rows]).clamp(-MOST_WISH, MOST_WISH)
            self.wish[rows] = wish
        self.decision = self.decision._replace(action=self.command().clone())
        return self.decision

    def advance(self) -> None:
        """The last decision has been carried out."""
        self.note_last(self._due())
        self._age += 1

    def _due(self) -> torch.Tensor:
        """(num_envs,) rows whose decision is not held any more."""
        return self._age % self._hold == 0


def load_set_pilot(checkpoint: Checkpoint, sim: Sim) -> SetPilot:
    """Pilot of a policy that learnt in the twin. Raises CheckpointError where its networks are not those of
    its config."""
    from uuvtai.twin.observer import SET_TABLE

    checkpoint.check_table(SET_TABLE, sim.config)
    config, actor = checkpoint.config, actor_of(checkpoint)
    return SetPilot(actor.to(sim.device), sim, config.policy.hold_steps, config.twin.vertical_gap_m)
