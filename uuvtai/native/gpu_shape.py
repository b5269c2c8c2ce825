"""Which of two shapes kernels are made in: for a CPU's few cores and wide vectors, or for a GPU's many narrow
threads. No result depends on it (``docs/cuda.md``)."""

from __future__ import annotations

import os

import taichi as ti

from uuvtai.errors import SettingError

VARIABLE = "UUV_KERNELS"
"""names the shape where there is no GPU, to compare the two: 'cpu' or 'gpu'"""


def asked_shape() -> str:
    """'cpu' or 'gpu': what kernels on a CPU are to be like. Raises SettingError."""
    shape = os.environ.get(VARIABLE) or "cpu"
    if shape not in ("cpu", "gpu"):
        raise SettingError(f"{VARIABLE}={shape!r}: must be cpu or gpu; unset it for the shape that fits")
    return shape


def is_gpu_shaped() -> bool:
    """Whether the kernels of this process are made for a GPU. Plain Python, for the time when a kernel is
    compiled or a size chosen; sizes are also asked for before Taichi has been started."""
    return (ti.cfg is not None and ti.cfg.arch == ti.cuda) or asked_shape() == "gpu"
