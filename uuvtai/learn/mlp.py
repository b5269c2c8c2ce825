"""Multilayer perceptron with orthogonal initial weights drawn from a generator of its own."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Literal

import torch
from torch import nn

Activation = Literal["elu", "tanh", "relu"]

_ACTIVATIONS = {"elu": lambda: nn.ELU(inplace=True), "tanh": nn.Tanh, "relu": lambda: nn.ReLU(inplace=True)}
_HIDDEN_GAIN = math.sqrt(2.0)


def mlp(
    sizes: Sequence[int], activation: Activation, generator: torch.Generator, out_gain: float = 1.0
) -> nn.Sequential:
    """Layers of these widths (input, hidden ..., output), an activation after every one but the last, biases
    zero.

    Weights are orthogonal with gain sqrt 2, the last layer's with ``out_gain`` (0 = its output is zero at
    birth). ``generator`` is a CPU generator. ValueError for fewer than two widths.
    """
    if len(sizes) < 2:
        raise ValueError(f"an mlp needs at least an input and an output width, got {list(sizes)}")
    layers: list[nn.Module] = []
    for number, (n_in, n_out) in enumerate(itertools.pairwise(sizes), start=2):
        last = number == len(sizes)
        layer = linear(n_in, n_out, out_gain if last else _HIDDEN_GAIN, generator)
        layers += [layer] if last else [layer, _ACTIVATIONS[activation]()]
    return nn.Sequential(*layers)


def linear(n_in: int, n_out: int, gain: float, generator: torch.Generator) -> nn.Linear:
    """One layer, weights orthogonal with this gain, bias zero."""
    with torch.random.fork_rng(devices=()):  # its own initial weights come from the global generator
        layer = nn.Linear(n_in, n_out)
    nn.init.orthogonal_(layer.weight, gain, generator=generator)
    nn.init.zeros_(layer.bias)
    return layer
