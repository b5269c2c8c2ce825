"""Who drives, the behaviour tree or a policy: whoever is likelier to arrive.

A network over the bodies, the vehicle's own columns and what the tree makes of the moment says for both how
likely the vehicle is to arrive if that one drives on: options and their values (Sutton, Precup & Singh 1999,
Artificial Intelligence 112). The other one takes the wheel where it is better by a margin. Where the columns
lie outside of what the network learnt from, the tree drives.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from uuvtai.config.learning import ChooserConfig, LearningConfig
from uuvtai.learn.checkpoint import Checkpoint
from uuvtai.learn.chooser_columns import APPROACH_WIDTH, wished, with_approach
from uuvtai.learn.manifest import MODEL, CheckpointError
from uuvtai.learn.pilot import PilotDecision, by_chunk
from uuvtai.learn.set_pilot import SetPilot, set_pilot_of
from uuvtai.learn.set_policy import SetEncoder

if TYPE_CHECKING:
    from uuvtai.sim import Sim

TREE, POLICY = 0, 1
"""columns of what the network says"""
AT_TREE_VELOCITY, AT_WISH = slice(6, 8), 28
"""of the tree's columns (``tree_columns``): velocity that it asks for, the policy's action"""
_SLACK = 0.1
"""columns may leave what was seen in training by this part of its width"""


class ArrivalNet(nn.Module):
    """How likely the vehicle is to arrive, (n, 2): if the tree drives on, if the policy does.

    ``chooser.networks`` of one shape, whose probabilities are averaged: one alone may be wrong by luck.
    """

    least: torch.Tensor
    """(n_own + n_body,) smallest columns that it learnt from"""
    most: torch.Tensor
    """(n_own + n_body,) largest ones"""

    def __init__(
        self, n_body: int, n_own: int, n_tree: int, config: LearningConfig, generator: torch.Generator
    ) -> None:
        """Columns of a body, of the vehicle's own and of ``tree_columns``."""
        super().__init__()
        self._n_own, vehicle = n_own, config.vehicle
        n_own += n_tree
        self._fastest = math.hypot(vehicle.max_surge_m_s, vehicle.max_sway_m_s)
        self.nets = nn.ModuleList(
            SetEncoder(n_body + APPROACH_WIDTH, n_own, 2, config, 0.01, generator)
            for _ in range(config.chooser.networks)
        )
        self.register_buffer("least", torch.full((n_own + n_body,), math.inf))
        self.register_buffer("most", torch.full((n_own + n_body,), -math.inf))

    def forward(self, bodies: torch.Tensor, own: torch.Tensor) -> torch.Tensor:
        """(n, 2) probabilities for bodies (n, lanes, n_body) and own columns (n, n_own + n_tree)."""
        return self.logits(bodies, own).sigmoid().mean(0)

    def logits(self, bodies: torch.Tensor, own: torch.Tensor) -> torch.Tensor:
        """(networks, n, 2)."""
        tree = own[:, self._n_own :]
        policy = wished(tree[:, AT_WISH : AT_WISH + 2], self._fastest)
        seen = with_approach(bodies, tree[:, AT_TREE_VELOCITY], policy)
        return torch.stack([net(seen, own, seen[..., :1]) for net in self.nets])

    def knows(self, bodies: torch.Tensor, own: torch.Tensor) -> torch.Tensor:
        """(n,) whether every column lies within what it learnt from, and a little beyond."""
        slack = _SLACK * (self.most - self.least)
        low, high = extremes(bodies, own)
        return torch.all((low >= self.least - slack) & (high <= self.most + slack), dim=-1)

    def widen(self, bodies: torch.Tensor, own: torch.Tensor) -> None:
        """Note columns that it learns from."""
        low, high = extremes(bodies, own)
        self.least.copy_(torch.minimum(self.least, low.amin(0)))
        self.most.copy_(torch.maximum(self.most, high.amax(0)))


def extremes(bodies: torch.Tensor, own: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """(n, n_own + n_body) each: own columns, and the bodies' smallest and largest ones."""
    return torch.cat([own, bodies.amin(-2)], -1), torch.cat([own, bodies.amax(-2)], -1)


class ChooserPilot:
    """Drives the rows of a simulator whose tree thinks along; used as ``Pilot`` is."""

    world_model = None
    risk = None

    def __init__(self, net: ArrivalNet, pilot: SetPilot, sim: Sim, config: ChooserConfig) -> None:
        from uuvtai.binding import bind
        from uuvtai.twin.tree_columns import TREE_WIDTH, TreeColumnsIO

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
    from uuvtai.twin.set_columns import BODY_WIDTH, EGO_COLUMNS
    from uuvtai.twin.tree_columns import CHOOSER_TABLE, TREE_WIDTH

    checkpoint.check_table(CHOOSER_TABLE, sim.config)
    config = checkpoint.config
    pilot = set_pilot_of(checkpoint, sim)
    try:
        part: dict[str, Any] = checkpoint.model()["chooser"]
        net = ArrivalNet(BODY_WIDTH, EGO_COLUMNS, TREE_WIDTH, config, torch.Generator())
        net.load_state_dict(part)
    except (KeyError, ValueError, RuntimeError, TypeError, AttributeError) as error:
        raise CheckpointError(
            f"{checkpoint.path / MODEL}: its networks are not those of its config ({error}); take another one"
        ) from None
    for name, tensor in net.state_dict().items():
        if not bool(torch.isfinite(tensor).all()):
            raise CheckpointError(
                f"{checkpoint.path / MODEL}: {name} is not finite: the training failed; take an older "
                "checkpoint"
            )
    net.to(sim.device).eval()
    return ChooserPilot(net, pilot, sim, config.chooser)
