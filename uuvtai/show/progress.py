"""How far a job is: a bar on a terminal, a plain line every few seconds elsewhere, and no guess of the time
left too early."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.text import Text

from uuvtai.endings import plain, say

_PERIOD_S = 5.0
"""between two lines where there is no terminal"""
_WORTH_S = 20.0
"""after so long at work the speed so far says something"""
_WORTH_SHARE = 0.1
"""or after this part of the work"""


class Pace:
    """Time left, from the work done since the clock began. Compiling comes before that and is no part of
    it."""

    def __init__(self, total: float, done: float = 0.0, now: Callable[[], float] = time.perf_counter) -> None:
        """``done`` of ``total`` is over as the clock begins."""
        self._total, self._first, self._now = total, done, now
        self._begun = now()

    @property
    def elapsed_s(self) -> float:
        """Since the clock began [s]."""
        return self._now() - self._begun

    def left_s(self, done: float) -> float | None:
        """Time left [s] where ``done`` is over; None = too early to tell."""
        spent, since, todo = self.elapsed_s, done - self._first, self._total - done
        is_worth_it = spent >= _WORTH_S or since >= _WORTH_SHARE * (self._total - self._first)
        return spent / since * todo if since > 0 and is_worth_it else None


def time_left(left_s: float | None) -> str:
    """'ETA 34 s', 'ETA 5 min', or nothing."""
    if left_s is None:
        return ""
    return f"ETA {left_s:.0f} s" if left_s < 120 else f"ETA {left_s / 60:.0f} min"


class Progress:
    """Rich progress with ETA on a terminal, one plain line every few seconds otherwise.

    A job that tells that nothing is done yet, in no steps, is compiling: that is shown, and the clock begins
    with what it tells next.
    """

    def __init__(self, what: str = "episodes") -> None:
        """``what``: of which things a job has so many."""
        self._bar = None
        self._what = what

    def start(self, name: str, total: int, done: int = 0) -> None:
        """A job of ``total`` things begins, of which ``done`` are over."""
        self._name, self._total, self._done = name, total, done
        self._pace: Pace | None = Pace(total, done)
        self._env_steps = 0
        self._last = time.perf_counter()
        if sys.stderr.isatty():
            self._bar = _bar()
            self._bar.start()
            self._task = self._bar.add_task(name, total=total, completed=done, remark="")

    def note(self, text: str) -> None:
        """A message for the person who waits."""
        if self._bar is not None:
            self._bar.console.print(Text(plain(text)), highlight=False)
        else:
            say(text)

    def update(self, done: int, total: int, env_steps: int = 0, left: int | None = None) -> None:
        """``done`` of ``total`` things are over after ``env_steps`` env steps; ``left``: env steps still to
        come, where that is known."""
        if done == self._done and env_steps == 0:
            self._pace = None
            self._show(done, "compiling")
            return
        if self._pace is None:  # the first pass is over, and with it the compiling
            self._pace, self._done, self._env_steps = Pace(total, done), done, env_steps
        spent, steps = self._pace.elapsed_s, env_steps - self._env_steps
        speed = f"{steps / spent:,.0f} env-steps/s" if steps and spent > 0 else ""
        self._show(
            done, ", ".join(part for part in (speed, time_left(self._left_s(done, env_steps, left))) if part)
        )

    def _left_s(self, done: int, env_steps: int, left: int | None) -> float | None:
        """Time left [s]. Of episodes, from their steps: played together they end together, and their count
        tells nothing until then."""
        assert self._pace is not None
        if not env_steps:
            return self._pace.left_s(done)
        steps = env_steps - self._env_steps
        return self._pace.elapsed_s / steps * left if left is not None and steps > 0 else None

    def _show(self, done: int, remark: str) -> None:
        now = time.perf_counter()
        if self._bar is not None:
            self._bar.update(self._task, completed=done, remark=remark)
        elif now - self._last >= _PERIOD_S:
            self._last = now
            say(f"{self._name}: {done}/{self._total} {self._what}" + (f", {remark}" if remark else ""))

    def stop(self) -> None:
        """The job is done."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None


@contextmanager
def counted(name: str, what: str) -> Iterator[Callable[[int, int], None]]:
    """A call (done, total) that shows a job whose total is known with its first piece."""
    progress = Progress(what)

    def update(done: int, total: int) -> None:
        if done == 1:
            progress.start(name, total)
        progress.update(done, total)

    try:
        yield update
    finally:
        progress.stop()


def _bar():
    """Bar of a job; what it says beside the count is ours: Rich would guess the time left from the first
    moment on."""
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    return Bar(
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=20),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[remark]}", markup=False),
        console=Console(stderr=True),
        transient=True,
    )
