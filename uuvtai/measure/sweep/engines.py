"""Who does the work of a sweep: processes on this machine, or a Ray cluster. A worker that is lost costs its
task once more."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from typing import Any, Protocol

from uuvtai import signals
from uuvtai.workers import ATTEMPTS, EngineError, Item, LocalEngine, Work


class Engine(Protocol):
    """Runs tasks somewhere."""

    def run(self, work: Work, items: Sequence[Item]) -> Iterator[tuple[int, Any]]:
        """(number of the item, result) as they come. Errors of the work itself are raised; EngineError where
        workers keep dying."""
        ...


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
