"""A policy over a set of bodies, a chooser and a learned forecast as torch modules that become ONNX graphs.
None of them remembers anything."""

from __future__ import annotations

import torch
from torch import Tensor

from uuvtai.deploy.graph import ExportedModule
from uuvtai.forecast_codes import COLUMNS
from uuvtai.learn.arrival_net import ArrivalNet
from uuvtai.learn.mixture_net import MixtureNet
from uuvtai.learn.set_policy import MOST_WISH, SetActor
from uuvtai.twin.set_codes import AT_WISH, BODY_WIDTH, EGO_COLUMNS, N_BODY

SET_INPUTS = {
    "bodies": f"(N, n, {BODY_WIDTH}) float32: the nearest moving bodies in any order, any n from 1 on; a row "
    "of zeros is no body",
    "own": f"(N, {EGO_COLUMNS}) float32: the vehicle, its goal and the free distances around it",
    "tree": f"(N, {AT_WISH}) float32: what the behaviour tree makes of the moment",
}
FORECAST_INPUTS = {
    "columns": f"(N, {COLUMNS}) float32: how a track moves, moved and turned",
    "speed": "(N,) float32: its speed [m/s]",
}
SET_OUTPUTS = {
    "mean_wish": "(N, 3) float32: ahead, left, up, in parts of the fastest velocity, mirrored world; cut it "
    "off to [-2, 2]",
    "chance": "(N, 2) float32: probabilities to arrive, if the tree drives on and if the policy does",
    "known": "(N,) float32: 1 = every column lies within what the chooser learnt from",
    "log_weight": "(N, modes) float32: logarithm of the probability of each future",
    "place": "(N, modes, times, 2) float32: [m] along and across the track's course",
    "sigma": "(N, modes, times, 2) float32: [m] standard deviations",
}
Example = tuple[tuple[Tensor, ...], dict[str, dict[int, torch.export.Dim]]]


class OneWish(ExportedModule):
    """One decision of a policy over a set of bodies, and of the chooser beside it."""

    def __init__(self, actor: SetActor, net: ArrivalNet | None) -> None:
        super().__init__()
        self.actor, self.net = actor, net
        told = list(SET_INPUTS)[: 2 if net is None else 3]
        self.inputs = {name: SET_INPUTS[name] for name in told}

    @property
    def outputs(self) -> list[str]:
        """Names of what ``forward`` returns."""
        return list(SET_OUTPUTS)[: 1 if self.net is None else 3]

    def example(self) -> Example:
        """As in ``ExportedModule``."""
        rows, bodies = torch.export.Dim("rows", min=1), torch.export.Dim("bodies", min=1)
        some = torch.zeros(2, N_BODY, BODY_WIDTH), torch.zeros(2, EGO_COLUMNS), torch.zeros(2, AT_WISH)
        sizes = {name: {0: rows} for name in self.inputs}
        sizes["bodies"][1] = bodies
        return some[: len(self.inputs)], sizes

    def forward(self, bodies: Tensor, own: Tensor, tree: Tensor | None = None) -> tuple[Tensor, ...]:
        """Shapes as SET_INPUTS says."""
        mean = self.actor(bodies, own)
        if self.net is None or tree is None:
            return (mean,)
        every = torch.cat([own, tree, mean.clamp(-MOST_WISH, MOST_WISH)], dim=1)
        return mean, self.net(bodies, every), self.net.knows(bodies, every).float()


class OneForecast(ExportedModule):
    """Futures of tracks. The network's columns beyond COLUMNS are padding, which is 0."""

    inputs = FORECAST_INPUTS

    def __init__(self, net: MixtureNet) -> None:
        super().__init__()
        self.net = net

    @property
    def outputs(self) -> list[str]:
        """Names of what ``forward`` returns."""
        return list(SET_OUTPUTS)[3:]

    def example(self) -> Example:
        """As in ``ExportedModule``."""
        rows = torch.export.Dim("rows", min=1)
        return (torch.zeros(2, COLUMNS), torch.ones(2)), {name: {0: rows} for name in self.inputs}

    def forward(self, columns: Tensor, speed: Tensor) -> tuple[Tensor, ...]:
        """Shapes as FORECAST_INPUTS says."""
        padding = columns.new_zeros(columns.shape[0], self.net.into.in_features - COLUMNS)
        return tuple(self.net(torch.cat([columns, padding], dim=1), speed))
