"""Adam without torch's compiler, which its class imports when one is built and when it steps: that takes
most of a second, and nothing here compiles by it. Same numbers, same states."""

from __future__ import annotations

import sys

import torch


class PlainAdam(torch.optim.Adam):
    """``torch.optim.Adam``."""

    step = torch.no_grad()(getattr(torch.optim.Adam.step, "__wrapped__", torch.optim.Adam.step))
    """torch's without what switches its compiler off around it"""

    def __init__(self, *arguments, **named) -> None:
        _spare_compiler()
        super().__init__(*arguments, **named)


def _spare_compiler() -> None:
    """Tell the methods of optimisers that they are switched off for the compiler already, unless somebody has
    imported it. A torch that asks in another way imports it as before."""
    if "torch._dynamo" in sys.modules:
        return
    for method in vars(torch.optim.Optimizer).values():
        inner = getattr(method, "__wrapped__", None)
        if inner is not None and not hasattr(inner, "__dynamo_disable"):
            inner.__dynamo_disable = inner
