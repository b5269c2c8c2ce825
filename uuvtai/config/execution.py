"""How kernels run; no result depends on it."""

from __future__ import annotations

from uuvtai.config.section import Section


class RuntimeConfig(Section):
    """How kernels are launched."""

    native: bool = True
    """by machine code of their own, kept on disk, instead of by Taichi (CPU, Linux): ``docs/native.md``"""
