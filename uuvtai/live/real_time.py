"""Episodes no faster than the clock."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

_FORGIVEN_S = 0.25
"""who is later than this does not catch up: a viewer would see a jump"""


class RealTime:
    """Makes every control step take its time; an ``EpisodeObserver``."""

    def __init__(
        self,
        dt_s: float,
        rate: float = 1.0,
        now: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """``rate``: seconds of the episode in one of the clock's; 0 = as fast as it goes."""
        self._dt_s, self._period_s, self._now, self._sleep = dt_s, dt_s / rate if rate else 0.0, now, sleep
        self._due_s = self._begun_s = now()
        self._steps = 0

    def begin(self, sim: Any, row: int, job: Any) -> None:
        """An episode begins."""
        self._due_s = self._begun_s = self._now()
        self._steps = 0

    def step(self, sim: Any) -> None:
        """A control step has been done: wait until it is over."""
        self._steps += 1
        self._due_s += self._period_s
        late = self._now() - self._due_s
        if late < 0:
            self._sleep(-late)
        elif late > _FORGIVEN_S:
            self._due_s += late

    def end(self, sim: Any, row: int, result: Any) -> None:
        """The episode is over."""

    @property
    def real_time_factor(self) -> float:
        """Seconds of the episode in one of the clock's, since the episode began."""
        spent = self._now() - self._begun_s
        return self._steps * self._dt_s / spent if spent > 0 else 0.0
