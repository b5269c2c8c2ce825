"""Time stamps of others: one rule for vehicles that speak, for their logs and for bags.

A stamp of 0, or one that does not rise, tells nothing; a counter that ran over goes on; one stamp from the
past is a late message, several in a row are a clock that has begun anew.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

JUMP_S = 1.0  # a clock that is off by more has jumped, or its message is late
SEVERAL = 5  # moments in a row at which a sender contradicts its clock; then it is believed
_DRIFT = 1e-4  # two clocks run apart by no more
_OVERRUN_S = 10.0  # so near to where its clock should be, a small stamp is of a counter that ran over
_COUNTERS = {"time_boot_ms": 1e3, "time_usec": 1e6}
"""field of MAVLink: units in a second, 32 bits of them unless a stamp has more"""


def stamp_of(fields: Mapping[str, Any]) -> tuple[float | None, float]:
    """(a MAVLink message's time, after how much its counter begins anew) [s]; None = it has no time."""
    for name, units in _COUNTERS.items():
        if name in fields:
            return float(fields[name]) / units, 2**32 / units
    return None, math.inf


class SourceClock:
    """Maps the time stamps of one sender, who counts from a moment of its own, to the clock of who receives
    them: the least delay seen counts as none."""

    def __init__(self) -> None:
        self.sent_s = math.nan
        """the last message's time by the sender's clock, without overruns"""
        self.restarts = 0
        """how often the clock has begun anew"""
        self.has_risen = False
        """whether its stamps tell anything"""
        self._offset_s = math.nan
        self._newest_s = self._come_s = -math.inf
        self._last_s, self._still = -math.inf, 0
        self._odd, self._odd_offset_s, self._odd_come_s = 0, math.nan, -math.inf

    def measured_s(self, sent_s: float | None, come_s: float, wrap_s: float = math.inf) -> float:
        """When the message that says ``sent_s`` and came at ``come_s`` was measured: never after it came.
        ``wrap_s``: after so much the sender's counter begins at 0."""
        if sent_s is None or not math.isfinite(sent_s) or sent_s <= 0:
            self.sent_s = come_s - (0.0 if math.isnan(self._offset_s) else self._offset_s)
            return come_s
        self.sent_s = sent_s = self._unwrapped(sent_s, come_s, wrap_s)
        offset = come_s - sent_s
        if math.isnan(self._offset_s):
            self._last_s = sent_s
            return self._begin(sent_s, offset, come_s)
        if self._stands_still(sent_s):
            return come_s
        is_late = sent_s < self._newest_s and offset > self._offset_s + JUMP_S
        if is_late or offset < self._offset_s - JUMP_S:
            if not self._is_sure(offset, come_s):
                return min(come_s, sent_s + self._offset_s)
            self.restarts += is_late
            return self._begin(sent_s, offset, come_s)
        self._odd = 0
        self._offset_s = min(self._offset_s + _DRIFT * max(come_s - self._come_s, 0.0), offset)
        self._newest_s, self._come_s = max(self._newest_s, sent_s), come_s
        return sent_s + self._offset_s

    def _begin(self, sent_s: float, offset: float, come_s: float) -> float:
        self._newest_s, self._offset_s, self._come_s, self._odd = sent_s, offset, come_s, 0
        return come_s

    def _unwrapped(self, sent_s: float, come_s: float, wrap_s: float) -> float:
        if math.isnan(self._offset_s) or not sent_s < wrap_s < math.inf:
            return sent_s
        expected = come_s - self._offset_s
        found = sent_s + wrap_s * max(0, round((expected - sent_s) / wrap_s))
        return found if abs(found - expected) < _OVERRUN_S else sent_s

    def _stands_still(self, sent_s: float) -> bool:
        """Whether the clock tells nothing; one that has told more is believed a little longer."""
        is_up, self._last_s = sent_s > self._last_s, sent_s
        self.has_risen = self.has_risen or is_up
        self._still = 0 if is_up else self._still + 1
        return not is_up and (not self.has_risen or self._still >= SEVERAL)

    def _is_sure(self, offset: float, come_s: float) -> bool:
        """Whether the sender has told several times in a row (moments apart) a clock that jumped so."""
        if not abs(offset - self._odd_offset_s) <= JUMP_S:
            self._odd = 0
        self._odd += self._odd == 0 or come_s > self._odd_come_s
        self._odd_offset_s, self._odd_come_s = offset, come_s
        return self._odd >= SEVERAL
