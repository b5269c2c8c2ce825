"""Time of simulating alone: compiling, recording and drawing are no part of it; and how many steps are still
to come."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Iterator

from uuvtai.taichi_patches.front_end import kernels_made


class StepClock:
    """Sums up the time of passes through the simulator. A pass in which a kernel was made does not count, nor
    the first of its kind."""

    def __init__(
        self, now: Callable[[], float] = time.perf_counter, made: Callable[[], int] = kernels_made
    ) -> None:
        """``made``: how many kernels there are by now."""
        self._now, self._made = now, made
        self._known: set[str] = set()
        self.seconds, self.env_steps = 0.0, 0

    @contextlib.contextmanager
    def counting(self, kind: str, env_steps: int = 0) -> Iterator[None]:
        """Time a pass of this kind ('reset', 'step'), which does ``env_steps`` env steps."""
        made, begun = self._made(), self._now()
        yield
        if kind in self._known and self._made() == made:
            self.seconds += self._now() - begun
            self.env_steps += env_steps
        self._known.add(kind)

    @property
    def env_steps_per_s(self) -> float | None:
        """None where no step counted."""
        return self.env_steps / self.seconds if self.env_steps and self.seconds > 0 else None


_WORTH_SHARE = 0.1
"""of the episodes must be over before their length says something of the others'"""
_LEAST_SHARE = 0.25
"""of the mean length lies before an episode that is longer than that already: it may end at any time, but the
last ones take long"""


def env_steps_left(lengths: Iterable[int], ages: Iterable[int], waiting: int) -> int | None:
    """Env steps still to come, a guess: from the ``lengths`` of the episodes that are over, the ``ages`` of
    those that run, and the number that wait for their turn. None where too few are over.
    """
    over, running = list(lengths), list(ages)
    if not over or len(over) < _WORTH_SHARE * (len(over) + len(running) + waiting):
        return None
    mean = sum(over) / len(over)
    return round(mean * waiting + sum(max(mean - age, _LEAST_SHARE * mean) for age in running))
