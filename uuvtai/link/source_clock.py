"""When something was measured, by the pilot's clock: every sender counts from a moment of its own."""

from __future__ import annotations

import math

RESTART_S = 1.0
"""a clock that jumps by more has begun anew"""
_DRIFT = 1e-4
"""two clocks run apart by no more"""


class SourceClock:
    """Maps the time stamps of one sender: the least delay seen counts as none."""

    def __init__(self) -> None:
        self._offset_s = math.nan
        self._sent_s = self._come_s = -math.inf

    def measured_s(self, sent_s: float, come_s: float) -> float:
        """When the message that says ``sent_s`` and came at ``come_s`` was measured: never after it came."""
        offset = come_s - sent_s
        jumps = sent_s < self._sent_s - RESTART_S or offset < self._offset_s - RESTART_S
        if math.isnan(self._offset_s) or jumps:
            self._offset_s = offset
        else:
            drifted = self._offset_s + _DRIFT * max(come_s - self._come_s, 0.0)
            self._offset_s = min(drifted, offset)
        self._sent_s, self._come_s = sent_s, come_s
        return sent_s + self._offset_s
