"""A policy over a set of bodies and a learned forecast as torch modules that become ONNX graphs, their
arrays, and what they say to made-up inputs. Neither remembers anything; no critic is among them."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from uuvtai.deploy.golden import Arrays
from uuvtai.deploy.graph import ExportedModule
from uuvtai.forecast_codes import COLUMNS
from uuvtai.learn.checkpoint import Checkpoint
from uuvtai.learn.mixture_net import MixtureNet
from uuvtai.learn.set_networks import actor_of, mixture_net_of
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


_ROWS, _SEED = 64, 7
_THERE = 0


def golden_rows(decision: ExportedModule) -> Arrays:
    """``pair_<input>`` and ``pair_<output>`` of 64 rows; the first has no body at all."""
    rng = torch.Generator().manual_seed(_SEED)
    inputs = _forecast_rows(decision, rng) if isinstance(decision, OneForecast) else _set_rows(rng)
    with torch.no_grad():
        said = decision.eval()(*inputs)
    named = zip((*decision.inputs, *decision.outputs), (*inputs, *said), strict=True)
    return {f"pair_{name}": tensor.numpy() for name, tensor in named}


def _forecast_rows(decision: ExportedModule, rng: torch.Generator) -> tuple[Tensor, ...]:
    (columns, _), _ = decision.example()
    speed = 0.1 + 1.9 * torch.rand(_ROWS, generator=rng)
    told = 0.5 * torch.randn(_ROWS, columns.shape[1], generator=rng)
    told[:, 0] = speed
    return told, speed


def _set_rows(rng: torch.Generator) -> tuple[Tensor, ...]:
    """Of any number of bodies."""
    bodies = torch.randn(_ROWS, N_BODY, BODY_WIDTH, generator=rng)
    own = torch.randn(_ROWS, EGO_COLUMNS, generator=rng)
    count = torch.randint(1, N_BODY + 1, (_ROWS,), generator=rng)
    count[0] = 0
    bodies *= (torch.arange(N_BODY) < count[:, None])[..., None]
    bodies[..., _THERE] = (torch.arange(N_BODY) < count[:, None]).float()
    return bodies, own


def kind_of(checkpoint: Checkpoint) -> str | None:
    """One of ``run_policy.KINDS``; None = a policy of one observation vector."""
    config = checkpoint.config
    if config.forecaster.enabled:
        return "forecast"
    return "set" if config.twin.enabled else None


def module_of(checkpoint: Checkpoint, kind: str) -> ExportedModule:
    """The networks of a checkpoint of this kind. Raises CheckpointError where they cannot drive."""
    if kind == "forecast":
        return OneForecast(mixture_net_of(checkpoint))
    return OneWish(actor_of(checkpoint))


def set_weights(decision: ExportedModule) -> dict[str, Tensor]:
    """Arrays by name, on the host, contiguous."""
    found = dict(_named(decision))
    return {name: tensor.detach().float().cpu().contiguous().clone() for name, tensor in found.items()}


def _named(decision: ExportedModule) -> Iterator[tuple[str, Tensor]]:
    if isinstance(decision, OneForecast):
        for name, tensor in decision.net.state_dict().items():
            yield name, tensor[:, : decision.example()[0][0].shape[1]] if name == "into.weight" else tensor
        return
    assert isinstance(decision, OneWish)
    for name, tensor in decision.actor.net.state_dict().items():
        yield f"actor.{name}", tensor
