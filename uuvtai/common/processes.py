"""Processes side by side: they end with who started them, and what a lost one did is done again."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import connection, popen_spawn_posix
from types import ModuleType
from typing import Any, TypeVar

from uuvtai.common import signals
from uuvtai.common.errors import SettingError, UserError

Item = TypeVar("Item")
Work = Callable[[Item], Any]  # a module's function of one picklable argument

ATTEMPTS = 3  # how often a task is tried that loses its worker

signals.never_within(popen_spawn_posix.__file__)
"""A process that has been started and is then not told what to do would print a traceback."""


class EngineError(UserError, RuntimeError):
    """The engine cannot start, or a task cannot be finished: what, where, why, what to type next."""


class LocalEngine:
    """Processes on this machine."""

    def __init__(self, workers: int = 1, go_on: str = "go on with --resume") -> None:
        """Each worker is a process that may use its share of the cores. ``go_on``: what to do, in words, once
        workers keep dying. Raises SettingError."""
        if workers < 1:
            raise SettingError(f"--workers {workers}: at least 1 is needed")
        self._workers, self._go_on = workers, go_on

    def run(self, work: Work, items: Sequence[Item]) -> Iterator[tuple[int, Any]]:
        """(item's number, result) as they come. Raises errors of the work; EngineError where workers die."""
        signals.engage()
        waiting, tries = list(range(len(items))), [0] * len(items)
        while waiting:
            lost = yield from self._round(work, items, waiting)
            waiting = [*lost, *waiting]
            for number in lost:
                tries[number] += 1
                if tries[number] >= ATTEMPTS:
                    raise EngineError(
                        f"task {number + 1} of {len(items)} lost its worker {ATTEMPTS} times (killed, or out "
                        "of memory): try fewer --workers or a smaller --num-envs; what is finished is kept, "
                        f"{self._go_on}"
                    )

    def _round(
        self, work: Work, items: Sequence[Item], todo: list[int]
    ) -> Generator[tuple[int, Any], None, list[int]]:
        """Run ``todo``, from its front, until all is done or a worker dies; the numbers that ran then."""
        threads = max(1, (os.cpu_count() or 1) // self._workers)
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(min(self._workers, len(todo)), context, _begin_worker, (threads,))
        running: dict[Future, int] = {}
        lost: list[int] = []
        try:
            while todo or running:
                try:
                    self._submit(pool, work, items, todo, running)
                except BrokenProcessPool:
                    return list(running.values())
                done, _rest = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    number = running.pop(future)
                    try:
                        result = future.result()
                    except BrokenProcessPool:
                        lost.append(number)
                        continue
                    yield number, result
                if lost:
                    return [*lost, *running.values()]
            return []
        finally:
            for process in list((pool._processes or {}).values()):
                process.terminate()
            pool.shutdown(wait=True, cancel_futures=True)

    def _submit(
        self,
        pool: ProcessPoolExecutor,
        work: Work,
        items: Sequence[Item],
        todo: list[int],
        running: dict[Future, int],
    ) -> None:
        """Give every free worker a task, and no more: what waits inside a broken pool is lost too."""
        while todo and len(running) < self._workers:
            with _apart():
                future = pool.submit(work, items[todo[0]])
            running[future] = todo.pop(0)


@contextlib.contextmanager
def _apart() -> Iterator[None]:
    """Processes started inside do not hear Ctrl-C, sent to all by a terminal, before they can ignore it, and
    do not import the user's script, which would run it again."""
    script, mask = sys.modules["__main__"], None
    if hasattr(signal, "pthread_sigmask"):
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script
        if mask is not None:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _begin_worker(threads: int) -> None:
    """Set up a worker: its share of the threads, Ctrl-C left to the parent, death with the parent."""
    os.environ.setdefault("UUV_NUM_THREADS", str(threads))
    os.environ.setdefault("OMP_NUM_THREADS", str(threads))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)
