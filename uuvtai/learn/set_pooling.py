"""Maximum and sum over the bodies of a set, with a gradient of their own: torch's, by the pieces, takes as
long as all products of a policy over a set of bodies together."""

from __future__ import annotations

from typing import Any

import torch


class MaxAndSum(torch.autograd.Function):
    """(highest, sum), both (..., wide), of relu(said) where ``mask`` is 1; 0 where no body is there.

    ``said`` (..., n, wide) is what an encoder says of each body, ``mask`` (..., n, 1) is 1 or 0 and has no
    gradient. Bodies that are equally high share the gradient of the highest, as in ``torch.amax``.
    """

    @staticmethod
    def forward(ctx: Any, said: torch.Tensor, mask: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """As the class says."""
        each = torch.relu(said).mul_(mask.to(said.dtype))
        highest = each.amax(dim=-2)
        ctx.save_for_backward(each, highest)
        return highest, each.sum(dim=-2)

    @staticmethod
    def backward(ctx: Any, *to_outputs: torch.Tensor) -> tuple[torch.Tensor, None]:
        """(gradient of ``said``, None)."""
        to_highest, to_sum = to_outputs
        each, highest = ctx.saved_tensors
        is_highest = each.clone().eq_(highest.unsqueeze(-2))
        share = to_highest / is_highest.sum(dim=-2)
        to_each = is_highest.mul_(share.unsqueeze(-2)).add_(to_sum.unsqueeze(-2))
        torch.ops.aten.threshold_backward.grad_input(to_each, each, 0, grad_input=to_each)
        return to_each, None
