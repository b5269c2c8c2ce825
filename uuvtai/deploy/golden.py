"""Golden pairs: a made-up mission that the pilot answers, step by step with its memory and decision by
decision without."""

from __future__ import annotations

import io
import math
from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

from uuvtai.deploy.graph import INPUTS
from uuvtai.learn.pilot import Pilot
from uuvtai.learn.policy import NUM_ACTIONS
from uuvtai.learn.world_model import N_FEATURES, N_TARGET, deviation

TOLERANCE = 1e-5
"""largest difference between torch, NumPy and ONNX Runtime, in parts of the output's largest value where that
is beyond 1"""
_DECISIONS, _SEED = 64, 6

Arrays = dict[str, np.ndarray]
Row = dict[str, Tensor]


def golden_of(pilot: Pilot) -> Arrays:
    """A mission of T steps and what the pilot (of one row) does in it, and its decisions as pairs for the
    graph.

    ``obs`` (T, n_obs), ``begins`` (T,): another mission begins here; outputs ``action`` (T, 4), ``value``,
    ``residual`` and ``uncertainty`` (T,). ``pair_<input>`` and ``pair_<output>`` have
    a row per decision. Some values are not finite, as a sensor that fails may give them.
    """
    obs = _mission(pilot)
    begins = torch.zeros(len(obs), dtype=torch.bool)
    begins[[0, len(obs) // 2 + 1]] = True
    decisions, pairs = _flown(pilot, obs, begins)
    found = (
        {"obs": obs, "begins": begins}
        | _stacked(decisions)
        | {f"pair_{name}": tensor for name, tensor in _stacked(pairs).items()}
    )
    return {name: tensor.numpy() for name, tensor in found.items()}


def _stacked(rows: list[Row]) -> Row:
    return {name: torch.stack([row[name] for row in rows]) for name in rows[0]}


def npz_bytes(arrays: Arrays) -> bytes:
    """golden.npz: stored, not compressed, as ``run_policy.read_golden`` wants it."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # pyright: ignore[reportArgumentType]
    return buffer.getvalue()


def inputs_of(golden: Arrays, names: Iterable[str] = INPUTS) -> Arrays:
    """Inputs of the graph."""
    return {name: golden[f"pair_{name}"] for name in names}


def _mission(pilot: Pilot) -> Tensor:
    """(T, n_obs) observations as training had them: spread like the normaliser's columns, the world model's
    targets step by step."""
    norm, n_obs, hold = (
        pilot.policy.observation_norm,
        pilot.policy.n_in - N_FEATURES,
        pilot.policy.config.hold_steps,
    )
    rng, steps = torch.Generator().manual_seed(_SEED), _DECISIONS + hold * (_DECISIONS // 4)
    mean, std = norm.mean[:n_obs].float(), norm.std()[:n_obs].float()
    obs = mean + std * torch.randn(steps, n_obs, generator=rng)
    if pilot.world_model is not None:
        change = deviation(pilot.world_model.change_norm.moments) / math.sqrt(hold)
        obs[1:, :N_TARGET] = change * torch.randn(steps - 1, N_TARGET, generator=rng)
        obs[:, :N_TARGET] = obs[:, :N_TARGET].cumsum(dim=0)
    obs[3, 0], obs[5, n_obs - 1], obs[7, n_obs // 2] = math.nan, math.inf, -math.inf
    return obs


def _flown(pilot: Pilot, obs: Tensor, begins: Tensor) -> tuple[list[Row], list[Row]]:
    """What the pilot says at every step, and inputs and outputs of every decision."""
    decisions, pairs, age = [], [], 0
    nothing = torch.zeros(obs.shape[1]), torch.zeros(NUM_ACTIONS)
    last = nothing
    for row, is_first in zip(obs, begins.tolist(), strict=True):
        if is_first:
            pilot.reset(torch.ones(1))
            age, last = 0, nothing
        decisions.append(_outputs_of(pilot, row))
        if age % pilot.policy.config.hold_steps == 0:
            inputs = dict(zip(INPUTS, (row, *last, torch.tensor(age > 0)), strict=True))
            pairs.append(inputs | _pair_outputs(pilot, decisions[-1]))
            last = row, pilot.mean_action[0].clone()
        age += 1
    return decisions, pairs


def _outputs_of(pilot: Pilot, obs: Tensor) -> Row:
    """One control step: outputs under their golden names."""
    said = pilot.decide(obs[None])
    pilot.advance()
    return {name: getattr(said, name)[0].clone() for name in ("action", "value", "residual", "uncertainty")}


def _pair_outputs(pilot: Pilot, row: Row) -> Row:
    """The same decision under the names of the graph's outputs."""
    found = {"mean_action": pilot.mean_action[0].clone(), "value": row["value"]}
    return found | {"features": torch.stack([row["residual"], row["uncertainty"]])}
