"""Maximum and sum over the bodies of a set, with a gradient of their own: torch's, by the pieces, takes as
long as all products of a policy over a set of bodies together."""

from __future__ import annotations

from typing import Any

import torch


class MaxAndSum(torch.autograd.Function):
    """(highest, sum), both (rows, wide), over the bodies of relu(said) where ``mask`` is 1; 0 where no body
    is there.

    ``said`` (bodies, rows, wide) is what an encoder says of each body, ``mask`` (bodies, rows) is 1 or 0 and
    has no gradient. Bodies come first: what is next to each other in memory is then reduced together. Bodies
    that are equally high share the gradient of the highest, as in ``torch.amax``.
    """

    @staticmethod
    def forward(ctx: Any, said: torch.Tensor, mask: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """As the class says."""
        each = torch.relu(said).mul_(mask.to(said.dtype).unsqueeze(-1))
        highest = each.amax(dim=0)
        ctx.save_for_backward(each, highest)
        return highest, _sum(each)

    @staticmethod
    def backward(ctx: Any, *to_outputs: torch.Tensor) -> tuple[torch.Tensor, None]:
        """(gradient of ``said``, None)."""
        to_highest, to_sum = to_outputs
        each, highest = ctx.saved_tensors
        is_highest = each.clone().eq_(highest)
        to_each = is_highest.mul_(to_highest / _sum(is_highest)).add_(to_sum)
        torch.ops.aten.threshold_backward.grad_input(to_each, each, 0, grad_input=to_each)
        return to_each, None


def _sum(each: torch.Tensor) -> torch.Tensor:
    """Over the bodies. Torch adds up in float32 in any case, and twice as fast where it is told."""
    return each.sum(dim=0, dtype=torch.float32).to(each.dtype)
