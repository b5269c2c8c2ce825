"""Pieces of a training's work on all cores. Networks over a few thousand rows are too small for torch's own
threads, which wait for each other at every product; here each thread takes whole pieces."""

from __future__ import annotations

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

_T = TypeVar("_T")


def side_by_side(*pieces: Callable[[], _T]) -> list[_T]:
    """What each piece gives, in their order. Threads have no part in any result: a piece runs on one."""
    pool = _pool(torch.get_num_threads())
    if pool is None:
        return [piece() for piece in pieces]
    return [begun.result() for begun in [pool.submit(piece) for piece in pieces]]


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor | None:
    return None if threads == 1 else ThreadPoolExecutor(threads, "uuvtai-learn", _begin)


def _begin() -> None:
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
