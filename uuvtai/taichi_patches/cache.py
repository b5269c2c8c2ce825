"""Taichi's cache of compiled kernels: how large it may grow, and locks that nobody holds any more."""

from __future__ import annotations

import os
import time
from pathlib import Path

from taichi.lang.impl import default_cfg

_LOCKED_S = 60.0
"""Taichi locks its cache by a file, for as long as it reads or writes there: one older than this belongs to a
process that was killed"""

CACHE_BYTES = 1 << 30
"""Taichi's own limit, 100 MB, is about twelve sizes of simulator (6 to 9 MB each): a sweep and a training
push each other's kernels out"""


def stale_locks() -> list[Path]:
    """Locks of the kernel cache that nobody holds any more: with one of them every process compiles
    everything again."""
    cache = Path(os.environ.get("TI_OFFLINE_CACHE_FILE_PATH") or default_cfg().offline_cache_file_path)
    return [lock for lock in cache.rglob("*.lock") if time.time() - lock.stat().st_mtime > _LOCKED_S]
