"""Curriculum over start states: episodes of the twin that begin a few seconds before where others failed
(restarts from states of the learner's own: Salimans & Chen 2018, arXiv 1812.03381; Ecoffet et al. 2021)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import torch

from uuvtai.outcomes import SUCCESS, TIMEOUT

if TYPE_CHECKING:
    from uuvtai.twin.twin_world import Twin

STRIDE = 5
"""decisions between two snapshots of an env"""
SLOTS = 8
"""newest snapshots that an env keeps"""
LEAST_AGE, MOST_AGE = 10, 40
"""decisions before the failure: 1 s to 4 s"""
KEPT = 4096
"""snapshots to begin from, the newest ones"""
ARRAYS = ("ego", "track", "scenario")
"""of the twin, a row for each env"""


class FailureStarts:
    """Snapshots of states before failures, and episodes that begin there."""

    def __init__(self, twin: Twin, share: float) -> None:
        """``share`` of the episodes begin from a snapshot, once there is one."""
        self._twin, self._share = twin, share
        rows = {name: getattr(twin, name) for name in ARRAYS}
        self._recent = {name: torch.zeros(SLOTS, *row.shape, dtype=row.dtype) for name, row in rows.items()}
        self._ring = {name: torch.zeros(KEPT, *row.shape[1:], dtype=row.dtype) for name, row in rows.items()}
        self._age = torch.zeros(twin.num_envs, dtype=torch.int64)
        """decisions since each row's episode began"""
        self._tick = self.count = self._at = 0
        """decisions in all; snapshots kept, place of the next one"""

    def advance(self) -> None:
        """After the begin of episodes and before the twin looks: another decision is about to be made."""
        if self._tick % STRIDE == 0:
            slot = self._tick // STRIDE % SLOTS
            for name, kept in self._recent.items():
                kept[slot] = getattr(self._twin, name)
        self._tick += 1
        self._age += 1

    def begin(
        self, ended: torch.Tensor, outcome: torch.Tensor, fresh: torch.Tensor, generator: torch.Generator
    ) -> None:
        """Begin episodes in the rows (N,) that ended: fresh scenarios (N,), a share from snapshots."""
        self._keep((ended & (outcome != SUCCESS) & (outcome != TIMEOUT)).nonzero().flatten(), generator)
        self._twin.begin(ended, fresh)
        self._age.masked_fill_(ended, 0)
        draw = torch.rand(len(ended), generator=generator)
        again = (ended & (draw < self._share)).nonzero().flatten()
        if self.count and len(again):
            chosen = torch.randint(self.count, (len(again),), generator=generator)
            for name, kept in self._ring.items():
                getattr(self._twin, name)[again] = kept[chosen]

    def _keep(self, failed: torch.Tensor, generator: torch.Generator) -> None:
        """Draw a snapshot of each of these rows, where its episode is old enough, into the ring."""
        newest = (self._tick - 1) // STRIDE
        since = self._tick - STRIDE * newest  # decisions since the newest snapshot
        first = -(-(LEAST_AGE - since) // STRIDE)
        last = (torch.clamp(self._age[failed], max=MOST_AGE) - since).div(STRIDE, rounding_mode="floor")
        last = last.clamp(max=SLOTS - 1)
        width = last - first + 1
        draw = torch.rand(len(failed), generator=generator)
        back = first + (draw * width).long().clamp(max=width - 1)
        old = width > 0
        rows, slots = failed[old][:KEPT], (newest - back[old][:KEPT]) % SLOTS
        places = (self._at + torch.arange(len(rows))) % KEPT
        for name, kept in self._ring.items():
            kept[places] = self._recent[name][slots, rows]
        self._at = (self._at + len(rows)) % KEPT
        self.count = min(KEPT, self.count + len(rows))

    def capture(self) -> dict[str, np.ndarray]:
        """All that the next episodes depend on."""
        found = {f"recent.{name}": part.numpy().copy() for name, part in self._recent.items()}
        found |= {f"ring.{name}": part.numpy().copy() for name, part in self._ring.items()}
        counts = np.array([self._tick, self.count, self._at])
        return found | {"failures.age": self._age.numpy().copy(), "failures.counts": counts}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Go on from what ``capture`` gave."""
        for prefix, parts in (("recent", self._recent), ("ring", self._ring)):
            for name, part in parts.items():
                part.copy_(torch.from_numpy(arrays[f"{prefix}.{name}"]))
        self._age.copy_(torch.from_numpy(arrays["failures.age"]))
        self._tick, self.count, self._at = (int(n) for n in arrays["failures.counts"])
