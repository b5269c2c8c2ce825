"""Products in bfloat16 (``ppo.bfloat16``), where that is faster: a CPU without the instructions takes ten
times as long for them."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from uuvtai.config.learning import PpoConfig

INSTRUCTIONS = ("avx512_bf16", "amx_bf16", "bf16")
"""of CPUs, as torch names them"""


def in_bfloat16(config: PpoConfig, device: str) -> bool:
    """Whether products are made in bfloat16 on this device ("cpu" or "cuda")."""
    return config.bfloat16 and multiplies_bfloat16(device)


@functools.cache
def multiplies_bfloat16(device: str) -> bool:
    """Whether this device has the instructions. A torch that cannot tell of a CPU, before 2.13, is taken for
    no."""
    if device != "cpu":
        return True
    known = getattr(torch.cpu, "get_capabilities", dict)()
    return any(known.get(name, False) for name in INSTRUCTIONS)
