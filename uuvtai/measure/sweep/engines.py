"""Who does the work of a sweep: processes on this machine, or a Ray cluster. A worker that is lost costs its
task once more."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import connection
from typing import Any, Protocol, TypeVar

from uuvtai import signals
from uuvtai.errors import SettingError, UserError

Item = TypeVar("Item")
Work = Callable[[Item], Any]
"""a module's function of one picklable argument"""

ATTEMPTS = 3
"""how often a task is tried that loses its worker"""


class EngineError(UserError, RuntimeError):
    """The engine cannot start, or a task cannot be finished: what, where, why, what to type next."""


class Engine(Protocol):
    """Runs tasks somewhere."""

    def run(self, work: Work, items: Sequence[Item]) -> Iterator[tuple[int, Any]]:
        """(number of the item, result) as they come. Errors of the work itself are raised; EngineError where
        workers keep dying."""
        ...


class LocalEngine:
    """Processes on this machine. They end with the one that started them, however it ends."""

    def __init__(self, workers: int = 1) -> None:
        """Each worker is a process that may use its share of the cores."""
        if workers < 1:
            raise SettingError(f"--workers {workers}: at least 1 is needed")
        self._workers = workers

    def run(self, work: Work, items: Sequence[Item]) -> Iterator[tuple[int, Any]]:
        """As ``Engine.run``."""
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
                        "go on with --resume"
                    )

    def _round(
        self, work: Work, items: Sequence[Item], todo: list[int]
    ) -> Generator[tuple[int, Any], None, list[int]]:
        """Run what is ``todo``, taken from its front, until all is done or a worker dies; returns the numbers
        that ran then."""
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
            with _ctrl_c_held():
                future = pool.submit(work, items[todo[0]])
            running[future] = todo.pop(0)


@contextlib.contextmanager
def _ctrl_c_held() -> Iterator[None]:
    """Processes that are started inside do not hear Ctrl-C, which a terminal sends to all of them, before
    they can leave it to us."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


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


class RayEngine:
    """Tasks on a Ray cluster that runs already, or on one inside this process; Ray itself runs lost tasks
    again."""

    def __init__(self, address: str = "auto", cpus_per_task: float = 2.0) -> None:
        """``address``: of the cluster, ``auto`` = the one that this machine belongs to, ``local`` = one
        inside this process."""
        try:
            import ray  # type: ignore[import-not-found]  # an extra
        except ImportError:
            raise EngineError(
                "--engine ray: the package ray is missing; install it: pip install 'uuvtai[cluster]'"
            ) from None
        self._ray = ray
        try:
            ray.init(
                address=None if address == "local" else address,
                ignore_reinit_error=True,
                log_to_driver=False,
                logging_level=logging.ERROR,
            )
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise EngineError(
                f"--engine ray: no cluster at {address!r} ({error}); start one: ray start --head"
            ) from None
        signals.reinstall()  # Ray has put its own handler of SIGTERM in their place
        self._cpus = min(cpus_per_task, ray.cluster_resources().get("CPU", 1.0))

    def run(self, work: Work, items: Sequence[Item]) -> Iterator[tuple[int, Any]]:
        """As ``Engine.run``."""
        remote = self._ray.remote(num_cpus=self._cpus, max_retries=ATTEMPTS - 1)(work)
        running = {remote.remote(item): number for number, item in enumerate(items)}
        try:
            yield from self._results(running, len(items))
        finally:
            for left in running:  # of a cluster that outlives us
                self._ray.cancel(left, force=True)

    def _results(self, running: dict[Any, int], total: int) -> Iterator[tuple[int, Any]]:
        while running:
            (done, *_), _rest = self._ray.wait(list(running))
            number = running.pop(done)
            try:
                yield number, self._ray.get(done)
            except (self._ray.exceptions.WorkerCrashedError, self._ray.exceptions.NodeDiedError) as error:
                raise EngineError(
                    f"task {number + 1} of {total} lost its worker {ATTEMPTS} times: {error}"
                ) from None
            except self._ray.exceptions.RayTaskError as error:
                raise error.as_instanceof_cause() from None


def engine_of(name: str, workers: int, address: str) -> Engine:
    """The engine of ``uuv sweep --engine``: 'local' with so many ``workers``, or 'ray' at ``address``."""
    return LocalEngine(workers) if name == "local" else RayEngine(address)
