"""Time that the user's code takes, and a voice while a call does not come back."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from uuvtai.own.piece_errors import line_of_frame

STALL_S = 10.0
"""a call that takes longer is told while it runs"""


class CallMeter:
    """Sums up calls. The first one, which may load libraries, counts as a call but its time does not."""

    def __init__(
        self,
        what: str,
        path: Path,
        budget_s: float,
        note: Callable[[str], None],
        now: Callable[[], float] = time.perf_counter,
        stall_s: float = STALL_S,
    ) -> None:
        """``budget_s``: what one env's decision may take; beyond it a vehicle would have to wait for it."""
        self._what, self._path, self._note, self._now = what, path, note, now
        self.budget_s, self._stall_s = budget_s, stall_s
        self.calls = self.timed = self.late = self.decisions = 0
        self.seconds = self.worst_s = 0.0
        self._begun: float | None = None
        self._thread = 0
        self._stop = threading.Event()
        self._guard: threading.Thread | None = None

    @contextlib.contextmanager
    def call(self, decisions: int = 1) -> Iterator[None]:
        """Time a call that decides for so many envs."""
        if self._guard is None:
            self._guard = threading.Thread(target=self._watch, daemon=True)
            self._guard.start()
        self._thread = threading.get_ident()
        begun = self._begun = self._now()
        try:
            yield
        finally:
            took, self._begun = self._now() - begun, None
            self.calls += 1
            if self.calls > 1:
                self._add(took, decisions)

    def _add(self, took: float, decisions: int) -> None:
        each = took / max(1, decisions)
        self.timed, self.decisions, self.seconds = (
            self.timed + 1,
            self.decisions + decisions,
            self.seconds + took,
        )
        self.worst_s = max(self.worst_s, each)
        self.late += each > self.budget_s

    def close(self) -> None:
        """Nobody waits for a call any more."""
        self._stop.set()
        self._guard, self._stop = None, threading.Event()

    def document(self) -> dict[str, Any]:
        """As JSON; times are per decision of one env, None where none was timed."""
        ms = 1e3 * self.seconds / self.decisions if self.decisions else None
        return {
            "calls": self.calls,
            "decisions": self.decisions,
            "decision_ms": None if ms is None else round(ms, 4),
            "slowest_ms": round(1e3 * self.worst_s, 4) if self.timed else None,
            "late_calls": self.late,
            "budget_ms": round(1e3 * self.budget_s, 4),
        }

    def told(self) -> str:
        """What has to be said of slow calls; empty = nothing."""
        if not self.late:
            return ""
        return (
            f"{self._what}: {self.late} of {self.timed} calls took longer than a control step "
            f"({1e3 * self.budget_s:g} ms) for one env, the slowest {1e3 * self.worst_s:.0f} ms; the "
            "simulator waited, a vehicle would not"
        )

    def _watch(self) -> None:
        stop, told = self._stop, None
        while not stop.wait(min(1.0, self._stall_s / 4)):
            begun = self._begun
            if begun is not None and begun != told and self._now() - begun > self._stall_s:
                told = begun
                line = line_of_frame(sys._current_frames().get(self._thread), self._path)
                place = f"{self._path}:{line}" if line else str(self._path)
                self._note(
                    f"{place}: a call of {self._what} has not come back for {self._stall_s:g} s; Ctrl-C stops"
                )
