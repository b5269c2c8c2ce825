"""Forward and backward pass of an mlp by hand, block of rows by block of rows, in memory that is allocated
once.

Autograd would allocate every activation anew: a tenth of an update's time went into page faults, and whole
minibatches do not fit the caches. The mathematics is the chain rule of ``mlp`` and nothing else; tests
compare it with autograd.
"""

from __future__ import annotations

import torch
from torch import nn


class Passes:
    """Passes of at most ``rows`` rows through one ``mlp``; gradients add up in tensors that ``begin`` makes
    the parameters' ``grad``."""

    def __init__(self, net: nn.Sequential, rows: int, dtype: torch.dtype = torch.float32) -> None:
        """``net`` as ``mlp`` builds it, with its parameters where they will stay.

        ``dtype`` is that of the products of all layers but the last, whose output is what the losses see;
        weights and their gradients stay float32.
        """
        self.rows = rows
        self.layers = [layer for layer in net if isinstance(layer, nn.Linear)]
        self.activations = [type(layer) for layer in net if not isinstance(layer, nn.Linear)]
        self._dtypes = [dtype] * (len(self.layers) - 1) + [torch.float32]
        device = self.layers[0].weight.device
        sized = list(zip(self.layers, self._dtypes, strict=True))
        self._out = [torch.empty(rows, layer.out_features, dtype=t, device=device) for layer, t in sized]
        self._back = [torch.empty(rows, layer.in_features, dtype=t, device=device) for layer, t in sized]
        self._parameters = list(net.parameters())
        self._gradients = [torch.zeros_like(p) for p in self._parameters]
        self._weights, self._biases = self._rounded()

    @torch.no_grad()
    def begin(self) -> None:
        """Gradients of zero, for the weights as they are now."""
        self._weights, self._biases = self._rounded()
        for parameter, gradient in zip(self._parameters, self._gradients, strict=True):
            parameter.grad = gradient.zero_()

    @torch.no_grad()
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Output (B, n_out) of x (B, n_in), B <= rows, float32; it is overwritten by the next call."""
        for number, (weight, bias) in enumerate(zip(self._weights, self._biases, strict=True)):
            out = self._out[number][: len(x)]
            torch.addmm(bias, x.to(out.dtype), weight.t(), out=out)
            if number < len(self.activations):
                _ACTIVATE[self.activations[number]](out)
            x = out
        return x

    @torch.no_grad()
    def backward(self, x: torch.Tensor, gradient: torch.Tensor) -> None:
        """Add the gradients of a loss whose gradient by the output of the last ``forward`` (of the same x) is
        (B, n_out)."""
        for number in range(len(self.layers) - 1, -1, -1):
            below = self._out[number - 1][: len(x)] if number else x
            gradient = gradient.to(self._dtypes[number])
            self._gradients[2 * number].add_(gradient.t() @ below.to(gradient.dtype))
            self._gradients[2 * number + 1].add_(gradient.sum(dim=0, dtype=torch.float32))
            if number:
                back = torch.mm(gradient, self._weights[number], out=self._back[number][: len(x)])
                gradient = _SLOPE[self.activations[number - 1]](back.to(below.dtype), below)

    def _rounded(self) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
        """Weights and biases in the layers' dtypes: themselves where that is float32."""
        pairs = list(zip(self.layers, self._dtypes, strict=True))
        return [layer.weight.detach().to(t) for layer, t in pairs], [
            layer.bias.detach().to(t) for layer, t in pairs
        ]


def _elu_slope(gradient: torch.Tensor, out: torch.Tensor) -> torch.Tensor:
    """The slope of elu is one plus its output where that is negative."""
    return gradient.addcmul_(gradient, out.clamp_max_(0.0))


def _tanh_slope(gradient: torch.Tensor, out: torch.Tensor) -> torch.Tensor:
    return gradient.addcmul_(gradient, out.square_(), value=-1.0)


def _relu_slope(gradient: torch.Tensor, out: torch.Tensor) -> torch.Tensor:
    return gradient.mul_(out.sign_())


_ACTIVATE = {nn.ELU: nn.functional.elu_, nn.Tanh: torch.tanh_, nn.ReLU: torch.relu_}
_SLOPE = {nn.ELU: _elu_slope, nn.Tanh: _tanh_slope, nn.ReLU: _relu_slope}
"""gradient by the activation's input from that by its output and the output; both are overwritten"""
