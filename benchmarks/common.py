"""What every benchmark shares: what it is asked for, the rows it returns, and stopwatches that treat both
sides alike."""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Job:
    """What a benchmark is asked for."""

    device: str = "cpu"
    quick: bool = False
    """small sizes and short times: does everything run?"""
    num_envs: tuple[int, ...] = ()
    """batch sizes asked for by ``--num-envs``; empty: the benchmark's own"""
    seconds: float = 4.0
    """measured time per side of a comparison"""
    against: str = ""
    """commit to compare with; empty: the last one"""
    policy: str = ""
    """run folder of the policy that ``parity`` runs"""
    say: Callable[[str], None] = print
    """shows progress"""


@dataclass
class Row:
    """One figure: ours, optionally beside a peer's, optionally with a floor."""

    what: str
    ours: float | None
    unit: str
    peer: float | None = None
    peer_name: str = ""
    less_is_better: bool = False
    """the unit is a time or a size, not a rate"""
    floor: float | None = None
    floor_on: str = "ours"
    """'ours' or 'ratio': the figure that the floor bounds; a ratio must be at least the floor, ours at most
    it if less is better"""
    note: str = ""
    details: dict[str, Any] = field(default_factory=dict)
    """kept in the file, not printed, except ``table``: {column: {row: number}}"""

    @property
    def ratio(self) -> float | None:
        """How many times better ours is than the peer's."""
        if not self.ours or not self.peer:
            return None
        return self.peer / self.ours if self.less_is_better else self.ours / self.peer

    @property
    def met(self) -> bool | None:
        """Whether the floor is met; None without a floor."""
        if self.floor is None:
            return None
        value = self.ratio if self.floor_on == "ratio" else self.ours
        if value is None:
            return False
        return value <= self.floor if self.less_is_better and self.floor_on == "ours" else value >= self.floor

    def document(self) -> dict[str, Any]:
        """As it is kept in the results."""
        return {**dataclasses.asdict(self), "ratio": self.ratio, "met": self.met}


def seconds_per_call(
    sides: dict[str, Callable[[], Any]],
    seconds: float,
    clock: Callable[[], float] = time.process_time,
    rounds: int = 7,
) -> dict[str, float]:
    """Median time of one call of each side, in turns, so that whatever disturbs the machine meets every side.

    Calls must have finished their work when they return. ``clock``: ``time.process_time`` for comparisons per
    core (CPU time: other programs' work is not counted), ``time.perf_counter`` for what all cores do
    together. Each side is called once before the clock runs.
    """
    calls = {}
    for name, call in sides.items():
        call()
        calls[name] = max(1, round(seconds / rounds / max(_timed(call, 1, clock), 1e-7)))
    samples: dict[str, list[float]] = {name: [] for name in sides}
    for _ in range(rounds):
        for name, call in sides.items():
            samples[name].append(_timed(call, calls[name], clock) / calls[name])
    return {name: statistics.median(values) for name, values in samples.items()}


def _timed(call: Callable[[], Any], times: int, clock: Callable[[], float]) -> float:
    begun = clock()
    for _ in range(times):
        call()
    return clock() - begun
