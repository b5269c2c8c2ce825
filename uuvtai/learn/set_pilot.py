"""A policy over a set of bodies at the wheel of the simulator: a wish for a velocity ten times a second,
laid on the hull by the fixed rule in every control step."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from uuvtai.learn.checkpoint import Checkpoint
from uuvtai.learn.pilot import PilotDecision, by_chunk
from uuvtai.learn.set_networks import actor_of
from uuvtai.learn.set_policy import MOST_WISH, NUM_WISHES, SetActor

if TYPE_CHECKING:
    from uuvtai.sim import Sim


class SetPilot:
    """Drives the rows of a simulator; used as ``Pilot`` is, but it looks at tracks, map and pose itself, as
    the vehicle has them."""

    world_model = None

    def __init__(self, actor: SetActor, sim: Sim, hold_steps: int, gap_m: float) -> None:
        """``hold_steps`` control steps a decision; the centre stays ``gap_m`` from floor and surface."""
        from uuvtai.binding import bind
        from uuvtai.twin.set_codes import BODY_WIDTH, EGO_COLUMNS, N_BODY, N_RAY
        from uuvtai.twin.twin_arrays import EGO_WIDTH, RAW_WIDTH, ObserverIO

        self.actor, self._hold, self._gap_m = actor, hold_steps, gap_m
        self._io = bind(ObserverIO, sim.s, sim.config)

        def zeros(*shape: int) -> torch.Tensor:
            return torch.zeros(sim.num_envs, *shape, device=sim.device)

        self._ego, self._raw, self._ray = zeros(EGO_WIDTH), zeros(N_BODY, RAW_WIDTH), zeros(N_RAY)
        self.bodies, self.own = zeros(N_BODY, BODY_WIDTH), zeros(EGO_COLUMNS)
        """columns that the last decision was made from"""
        self.wish, self._last, self._command = zeros(NUM_WISHES), zeros(NUM_WISHES), zeros(4)
        """what is wished now, and what the vehicle is told of its last decision; (rows, NUM_WISHES)"""
        self._age = torch.zeros(sim.num_envs, dtype=torch.int64, device=sim.device)
        std = torch.cat([actor.log_std.detach().exp(), torch.zeros(1, device=sim.device)])
        nothing = zeros()
        self.decision = PilotDecision(self._command, nothing, std, nothing, nothing)
        """value, residual and uncertainty are 0: what drives has no critic and no world model"""

    def reset(self, rows: torch.Tensor) -> None:
        """New episodes have begun in the rows (num_envs,) where this is not 0."""
        kept = rows.to(self._age.device) == 0
        self._age *= kept
        self._last *= kept[:, None]

    @torch.no_grad()
    def decide(self, _obs: torch.Tensor) -> PilotDecision:
        """Command for all rows; changes nothing that the next one depends on."""
        from uuvtai.twin.observer import command_hull

        due = self._due()
        if bool(due.any()):
            self._look(due)
            rows = due.nonzero().flatten()
            wish = by_chunk(self.actor, self.bodies[rows], self.own[rows]).clamp(-MOST_WISH, MOST_WISH)
            self.wish[rows] = wish
        command_hull(self._io, self._gap_m, self.wish, self._command)
        self.decision = self.decision._replace(action=self._command.clone())
        return self.decision

    def advance(self) -> None:
        """The last decision has been carried out."""
        long = self.wish[:, :2].norm(dim=1, keepdim=True).clamp(min=1.0)
        done = torch.cat([self.wish[:, :2] / long, self.wish[:, 2:].clamp(-1.0, 1.0)], dim=1)
        self._last = torch.where(self._due()[:, None], done, self._last)
        self._age += 1

    def _look(self, due: torch.Tensor) -> None:
        """Columns of the rows (num_envs,) bool where ``due``, as they are now."""
        from uuvtai.twin.observer import observe_bodies
        from uuvtai.twin.set_columns import write_set_columns
        from uuvtai.twin.twin_arrays import AT_LAST

        self._ego[:, AT_LAST : AT_LAST + NUM_WISHES] = self._last
        observe_bodies(self._io, due.int(), self._ego, self._raw, self._ray)
        write_set_columns(self._ego, self._raw, self._ray, self.bodies, self.own)

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
