"""What a policy over a set of bodies is shown of the rows of a simulator, and how its wish is laid on the
hull: the same at the wheel (``set_pilot``) and in training (``simulated_world``)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from uuvtai.learn.set_policy import NUM_WISHES

if TYPE_CHECKING:
    from uuvtai.sim import Sim


class SetWheel:
    """Columns and commands of all rows of a simulator, from tracks, map and pose as the vehicle has them."""

    def __init__(self, sim: Sim, gap_m: float) -> None:
        """The centre stays ``gap_m`` from floor and surface."""
        from uuvtai.binding import bind
        from uuvtai.twin.set_codes import BODY_WIDTH, EGO_COLUMNS, N_BODY, N_RAY
        from uuvtai.twin.twin_arrays import EGO_WIDTH, RAW_WIDTH, ObserverIO

        self._gap_m, rows = gap_m, sim.num_envs
        self._io = bind(ObserverIO, sim.s, sim.config)

        def zeros(*shape: int) -> torch.Tensor:
            return torch.zeros(rows, *shape, device=sim.device)

        self._ego, self.raw, self._ray = zeros(EGO_WIDTH), zeros(N_BODY, RAW_WIDTH), zeros(N_RAY)
        self.bodies, self.own = zeros(N_BODY, BODY_WIDTH), zeros(EGO_COLUMNS)
        """columns that the last decision was made from; ``raw``: its tracks, lane for lane"""
        self.wish, self.last, self._command = zeros(NUM_WISHES), zeros(NUM_WISHES), zeros(4)
        """what is wished now, and what the vehicle is told of its last decision; (rows, NUM_WISHES)"""

    def look(self, due: torch.Tensor) -> None:
        """Columns of the rows (num_envs,) bool where ``due``, as they are now."""
        from uuvtai.twin.observer import observe_bodies
        from uuvtai.twin.set_columns import write_set_columns
        from uuvtai.twin.twin_arrays import AT_LAST

        self._ego[:, AT_LAST : AT_LAST + NUM_WISHES] = self.last
        observe_bodies(self._io, due.int(), self._ego, self.raw, self._ray)
        write_set_columns(self._ego, self.raw, self._ray, self.bodies, self.own)

    def command(self) -> torch.Tensor:
        """(num_envs, 4) of the wishes, where each vehicle is now; the next call writes it anew."""
        from uuvtai.twin.observer import command_hull

        command_hull(self._io, self._gap_m, self.wish, self._command)
        return self._command

    def note_last(self, rows: torch.Tensor) -> None:
        """The wishes of these rows (num_envs,) bool have been carried out."""
        long = self.wish[:, :2].norm(dim=1, keepdim=True).clamp(min=1.0)
        done = torch.cat([self.wish[:, :2] / long, self.wish[:, 2:].clamp(-1.0, 1.0)], dim=1)
        self.last = torch.where(rows[:, None], done, self.last)
