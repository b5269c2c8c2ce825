"""Rows of Taichi's arrays: by a kernel where NumPy cannot see the device's memory."""

from __future__ import annotations

import numpy as np
import taichi as ti
import torch

from uuvtai.kernels.core.rows import copy_rows
from uuvtai.outcomes import RUNNING
from uuvtai.taichi_patches.memory import Memory

_TORCH_DTYPE = {
    ti.f32: torch.float32,
    ti.i32: torch.int32,
    ti.i16: torch.int16,
    ti.u8: torch.uint8,
    ti.i8: torch.int8,
    ti.u32: torch.uint32,
}


class HostCounts:
    """A simulator's numbers for the host, with as few waits for a GPU as can be."""

    def __init__(self, memory: Memory, outcome: ti.Field, num_envs: int) -> None:
        """``outcome``: the referee's, a code of ``outcomes`` a row."""
        self._memory, self._outcome, self._num_envs = memory, outcome, num_envs
        self.any_ended: int | None = None
        """not 0 where an episode had ended, or rested, at the last ``number``; None: nobody has looked"""

    def number(self, field: ti.Field) -> int:
        """The one number of a field without axes. The wait for it tells ``any_ended``, too."""
        if self._memory.device.type == "cpu":
            return self._memory.number(field)
        ended = self._memory.tensor(self._outcome)[: self._num_envs].ne(RUNNING).any()
        number, self.any_ended = torch.stack((self._memory.tensor(field), ended.to(torch.int32))).tolist()
        return number

    def rows(self, field: ti.Field, envs: list[int] | None = None) -> np.ndarray:
        """Copy of these rows of a field, shape (len(envs), ...); None = all of them."""
        if self._memory.device.type == "cpu":
            return self._memory.rows(field, slice(self._num_envs) if envs is None else envs)
        chosen = range(self._num_envs) if envs is None else envs
        return copied_rows(field, torch.tensor(chosen, dtype=torch.int32, device=self._memory.device))

    def has_any(self, field: ti.Field, mask: torch.Tensor) -> bool:
        """Whether a number of these rows (int32 ``mask``) is not 0."""
        if self._memory.device.type == "cpu":
            return bool(self._memory.live(field)[: len(mask)][mask.numpy() != 0].any())
        return bool((self._memory.tensor(field)[: len(mask)] * mask).any())


def copied_rows(field: ti.Field, chosen: torch.Tensor) -> np.ndarray:
    """Host copy of the rows ``chosen`` (int32, on the field's device), shape (len(chosen), ...)."""
    inner = (field.n,) if hasattr(field, "n") else ()
    out = torch.empty(
        (len(chosen), *field.shape[1:], *inner), dtype=_TORCH_DTYPE[field.dtype], device=chosen.device
    )
    copy_rows(field, chosen, out)
    return out.cpu().numpy()
