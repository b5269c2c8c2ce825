"""Pieces of a training's work on all cores. Networks over a few thousand rows are too small for torch's own
threads, which wait for each other at every product; here each thread takes whole pieces."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from typing import TypeVar

import torch

_T = TypeVar("_T")


_threads: ContextVar[int] = ContextVar("threads")
"""for pieces, while torch's own rest"""


@contextlib.contextmanager
def torch_threads_rest() -> Iterator[None]:
    """Between the pieces torch computes on one thread: its own take ten times as long for a step of Adam on
    networks of this size as one does alone."""
    threads = torch.get_num_threads()
    token = _threads.set(threads)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        _threads.reset(token)


def side_by_side(*pieces: Callable[[], _T]) -> list[_T]:
    """What each piece gives, in their order. Threads have no part in any result: a piece runs on one."""
    pool = _pool(_threads.get(None) or torch.get_num_threads())
    if pool is None:
        return [piece() for piece in pieces]
    return [begun.result() for begun in [pool.submit(piece) for piece in pieces]]


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor | None:
    return None if threads == 1 else ThreadPoolExecutor(threads, "uuvtai-learn", _begin)


def _begin() -> None:
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
