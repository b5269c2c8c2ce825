"""A policy over a set of bodies and a learned forecast as torch modules that become ONNX graphs. Neither
remembers anything."""

from __future__ import annotations

import torch
from torch import Tensor

from uuvtai.deploy.graph import ExportedModule
from uuvtai.forecast_codes import COLUMNS
from uuvtai.learn.mixture_net import MixtureNet
from uuvtai.learn.set_policy import SetActor
from uuvtai.twin.set_codes import BODY_WIDTH, EGO_COLUMNS, N_BODY

SET_INPUTS = {
    "bodies": f"(N, n, {BODY_WIDTH}) float32: the nearest moving bodies in any order, any n from 1 on; a row "
    "of zeros is no body",
    "own": f"(N, {EGO_COLUMNS}) float32: the vehicle, its goal and the free distances around it",
}
FORECAST_INPUTS = {
    "columns": f"(N, {COLUMNS}) float32: how a track moves, moved and turned",
    "speed": "(N,) float32: its speed [m/s]",
}
SET_OUTPUTS = {
    "mean_wish": "(N, 3) float32: ahead, left, up, in parts of the fastest velocity, mirrored world; cut it "
    "off to [-2, 2]",
    "log_weight": "(N, modes) float32: logarithm of the probability of each future",
    "place": "(N, modes, times, 2) float32: [m] along and across the track's course",
    "sigma": "(N, modes, times, 2) float32: [m] standard deviations",
}
Example = tuple[tuple[Tensor, ...], dict[str, dict[int, torch.export.Dim]]]


class OneWish(ExportedModule):
    """One decision of a policy over a set of bodies."""

    inputs = SET_INPUTS

    def __init__(self, actor: SetActor) -> None:
        super().__init__()
        self.actor = actor

    @property
    def outputs(self) -> list[str]:
        """Names of what ``forward`` returns."""
        return list(SET_OUTPUTS)[:1]

    def example(self) -> Example:
        """As in ``ExportedModule``."""
        rows, bodies = torch.export.Dim("rows", min=1), torch.export.Dim("bodies", min=1)
        some = torch.zeros(2, N_BODY, BODY_WIDTH), torch.zeros(2, EGO_COLUMNS)
        return some, {"bodies": {0: rows, 1: bodies}, "own": {0: rows}}

    def forward(self, bodies: Tensor, own: Tensor) -> tuple[Tensor, ...]:
        """Shapes as SET_INPUTS says."""
        return (self.actor(bodies, own),)


class OneForecast(ExportedModule):
    """Futures of tracks. The network's columns beyond COLUMNS are padding, which is 0."""

    inputs = FORECAST_INPUTS

    def __init__(self, net: MixtureNet) -> None:
        super().__init__()
        self.net = net

    @property
    def outputs(self) -> list[str]:
        """Names of what ``forward`` returns."""
        return list(SET_OUTPUTS)[1:]

    def example(self) -> Example:
        """As in ``ExportedModule``."""
        rows = torch.export.Dim("rows", min=1)
        return (torch.zeros(2, COLUMNS), torch.ones(2)), {name: {0: rows} for name in self.inputs}

    def forward(self, columns: Tensor, speed: Tensor) -> tuple[Tensor, ...]:
        """Shapes as FORECAST_INPUTS says."""
        padding = columns.new_zeros(columns.shape[0], self.net.into.in_features - COLUMNS)
        return tuple(self.net(torch.cat([columns, padding], dim=1), speed))
