"""Chosen rows of Taichi's arrays as NumPy copies, by a kernel: for devices whose memory NumPy cannot see."""

from __future__ import annotations

import numpy as np
import taichi as ti
import torch

from uuvtai.kernels.core.rows import copy_rows

_TORCH_DTYPE = {
    ti.f32: torch.float32,
    ti.i32: torch.int32,
    ti.i16: torch.int16,
    ti.u8: torch.uint8,
    ti.i8: torch.int8,
    ti.u32: torch.uint32,
}


def copied_rows(field: ti.Field, chosen: torch.Tensor) -> np.ndarray:
    """Host copy of the rows ``chosen`` (int32, on the field's device), shape (len(chosen), ...)."""
    inner = (field.n,) if hasattr(field, "n") else ()
    out = torch.empty(
        (len(chosen), *field.shape[1:], *inner), dtype=_TORCH_DTYPE[field.dtype], device=chosen.device
    )
    copy_rows(field, chosen, out)
    return out.cpu().numpy()
