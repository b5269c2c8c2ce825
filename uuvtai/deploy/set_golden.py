"""Golden pairs of policies over a set of bodies and of learned forecasts: made-up inputs, and what the
networks say to them."""

from __future__ import annotations

import torch
from torch import Tensor

from uuvtai.deploy.golden import Arrays
from uuvtai.deploy.graph import ExportedModule
from uuvtai.deploy.set_graph import OneForecast
from uuvtai.twin.set_codes import BODY_WIDTH, EGO_COLUMNS, N_BODY

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
