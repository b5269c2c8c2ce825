"""Who drives, the behaviour tree or a policy: whoever is likelier to arrive.

A network over the bodies, the vehicle's own columns and what the tree makes of the moment says for both how
likely the vehicle is to arrive if that one drives on: options and their values (Sutton, Precup & Singh 1999,
Artificial Intelligence 112). The other one takes the wheel where it is better by a margin. Where the columns
lie outside of what the network learnt from, the tree drives.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from uuvtai.config.learning import ChooserConfig
from uuvtai.learn.arrival_net import POLICY, TREE, ArrivalNet
from uuvtai.learn.checkpoint import Checkpoint
from uuvtai.learn.pilot import PilotDecision, by_chunk
from uuvtai.learn.set_networks import arrival_net_of
from uuvtai.learn.set_pilot import SetPilot, set_pilot_of

if TYPE_CHECKING:
    from uuvtai.sim import Sim


class ChooserPilot:
    """Drives the rows of a simulator whose tree thinks along; used as ``Pilot`` is."""

    world_model = None

    def __init__(self, net: ArrivalNet, pilot: SetPilot, sim: Sim, config: ChooserConfig) -> None:
        from uuvtai.binding import bind
        from uuvtai.twin.set_codes import TREE_WIDTH
        from uuvtai.twin.tree_columns import TreeColumnsIO

        self.net, self.pilot, self.simulator, self._config = net, pilot, sim, config
        self._io = bind(TreeColumnsIO, sim.s, sim.config)
        rows = sim.num_envs
        self._columns = torch.zeros(rows, TREE_WIDTH, device=sim.device)
        self._age = torch.zeros(rows, dtype=torch.int64, device=sim.device)
        self._drove, self.drives = (torch.zeros(rows, dtype=torch.bool, device=sim.device) for _ in range(2))
        """whether the policy drives: in the last step that was carried out, and in the one decided last"""
        self.hand_overs, self.driven = (
            torch.zeros(rows, dtype=torch.int64, device=sim.device) for _ in range(2)
        )
        """of every row since its episode began: how often the wheel changed hands, steps of the policy"""
        self._chance = torch.zeros(rows, device=sim.device)
        self.decision = pilot.decision

    def reset(self, rows: torch.Tensor) -> None:
        """New episodes have begun in the rows (num_envs,) where this is not 0."""
        self.pilot.reset(rows)
        kept = rows.to(self._age.device) == 0
        self._age *= kept
        self._drove &= kept
        self.hand_overs *= kept
        self.driven *= kept

    @torch.no_grad()
    def decide(self, obs: torch.Tensor) -> PilotDecision:
        """Command for all rows; changes nothing that the next one depends on."""
        from uuvtai.twin.tree_columns_kernel import write_tree_columns

        said = self.pilot.decide(obs)
        due = self._age % self._config.hold_steps == 0
        if bool(due.any()):
            write_tree_columns(self._io, due.int(), self.pilot.wish, self._columns)
            rows = due.nonzero().flatten()
            own = torch.cat([self.pilot.own[rows], self._columns[rows]], dim=1)
            self.drives[rows], self._chance[rows] = self.choose(rows, self.pilot.bodies[rows], own)
        action = torch.where(self.drives[:, None], said.action, self.simulator.action)
        self.decision = said._replace(action=action, value=self._chance.clone())
        return self.decision

    def choose(
        self, rows: torch.Tensor, bodies: torch.Tensor, own: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """(whether the policy drives on, how likely it is to arrive so), both (n,), of these rows."""
        chance = by_chunk(self.net, bodies, own)
        gain = chance[:, POLICY] - chance[:, TREE]
        begins = self._age[rows] == 0
        margin = torch.where(begins, 0.0, self._config.margin)
        drives = gain > torch.where(self._drove[rows], -margin, margin)
        drives &= self.net.knows(bodies, own)
        return drives, torch.where(drives, chance[:, POLICY], chance[:, TREE])

    def advance(self) -> None:
        """The last decision has been carried out."""
        self.pilot.advance()
        self.hand_overs += (self.drives != self._drove) & (self._age > 0)
        self.driven += self.drives
        self._drove.copy_(self.drives)
        self._age += 1


def load_chooser(checkpoint: Checkpoint, sim: Sim) -> ChooserPilot:
    """Pilot of a chooser's checkpoint. Raises CheckpointError where its networks are not those of its
    config."""
    from uuvtai.twin.tree_columns import CHOOSER_TABLE

    checkpoint.check_table(CHOOSER_TABLE, sim.config)
    pilot, net = set_pilot_of(checkpoint, sim), arrival_net_of(checkpoint)
    return ChooserPilot(net.to(sim.device), pilot, sim, checkpoint.config.chooser)
