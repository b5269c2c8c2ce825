"""Golden pairs of policies over a set of bodies, of choosers and of learned forecasts: made-up inputs, and
what the networks that drive say to them."""

from __future__ import annotations

import torch
from torch import Tensor

from uuvtai.deploy.golden import Arrays
from uuvtai.deploy.graph import ExportedModule
from uuvtai.deploy.set_graph import OneForecast, OneWish
from uuvtai.learn.arrival_net import ArrivalNet
from uuvtai.twin.set_codes import AT_WISH, BODY_WIDTH, EGO_COLUMNS, N_BODY

_ROWS, _SEED = 64, 7
_BEYOND = 16
"""rows at the end whose columns lie outside of what a chooser learnt from"""
_THERE = 0


def golden_rows(decision: ExportedModule) -> Arrays:
    """``pair_<input>`` and ``pair_<output>`` of 64 rows; the first has no body at all."""
    rng = torch.Generator().manual_seed(_SEED)
    inputs = _forecast_rows(decision, rng) if isinstance(decision, OneForecast) else _set_rows(decision, rng)
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


def _set_rows(decision: ExportedModule, rng: torch.Generator) -> tuple[Tensor, ...]:
    """Of any number of bodies. Columns are spread like those a chooser learnt from, where there is one."""
    net = decision.net if isinstance(decision, OneWish) else None
    bodies = torch.randn(_ROWS, N_BODY, BODY_WIDTH, generator=rng)
    own = torch.randn(_ROWS, EGO_COLUMNS + AT_WISH, generator=rng)
    if net is not None:
        bodies, own = _learnt_rows(net, rng)
    count = torch.randint(1, N_BODY + 1, (_ROWS,), generator=rng)
    count[0] = 0
    bodies *= (torch.arange(N_BODY) < count[:, None])[..., None]
    bodies[..., _THERE] = (torch.arange(N_BODY) < count[:, None]).float()
    parts = (bodies, own[:, :EGO_COLUMNS].contiguous(), own[:, EGO_COLUMNS:].contiguous())
    return parts[: len(decision.inputs)]


def _learnt_rows(net: ArrivalNet, rng: torch.Generator) -> tuple[Tensor, Tensor]:
    """(bodies, own columns with the tree's) within what a chooser learnt from, and then beyond it."""
    n_own = EGO_COLUMNS + AT_WISH
    reach = torch.ones(_ROWS, 1)
    reach[-_BEYOND:] = 2.0

    def between(low: Tensor, high: Tensor, *shape: int) -> Tensor:
        part = torch.rand(*shape, len(low), generator=rng) - 0.5
        wide = reach if len(shape) == 1 else reach[:, None]
        return 0.5 * (low + high) + wide * part * (high - low)

    own = between(net.least[:n_own], net.most[:n_own], _ROWS)
    bodies = between(net.least[-BODY_WIDTH:], net.most[-BODY_WIDTH:], _ROWS, N_BODY)
    return bodies, own
