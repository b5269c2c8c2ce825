"""Water Linked's DVL A50 and A125: lines of JSON over TCP.

Source: docs.waterlinked.com, DVL protocol, JSON (json_v1 to v3.1). Axes: x ahead, y to starboard, z down.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from uuvtai.common.clocks import SourceClock
from uuvtai.common.files import json_object
from uuvtai.vehicle.instruments.channel import Channel, Instrument
from uuvtai.vehicle.messages import DvlReading, SensorMessage

PORT = 16171
LONGEST = 16 << 10  # [bytes] a longer line is none of a DVL's
_LONGEST_S = 1.0  # from the validity of a velocity to its transmission


class A50(Instrument):
    """Velocities; a reading that the device calls invalid is none: the bottom is lost."""

    def __init__(self, channel: Channel, yaw_rad: float, fom_most_m_s: float, latency_s: float) -> None:
        """``yaw_rad``: of the device's x axis from the vehicle's, counter-clockwise seen from above;
        ``fom_most_m_s``: figures of merit beyond are not used; ``latency_s``: of a firmware that does not
        tell when a velocity was measured."""
        super().__init__(channel)
        self._turn, self._fom_most, self._latency_s = yaw_rad, fom_most_m_s, latency_s
        self._rest, self._opened = b"", 0

    def poll(self, now_s: float) -> list[SensorMessage]:
        pieces = self.channel.read(now_s)
        if self.channel.opened != self._opened:
            self._opened, self._rest, self.clock = self.channel.opened, b"", SourceClock()
        *lines, self._rest = b"".join([self._rest, *pieces]).split(b"\n")
        if len(self._rest) > LONGEST:
            self._rest = b""
            self.refuse("a line without an end")
        found = (self._reading(line, now_s) for line in lines if line.strip())
        return [reading for reading in found if reading is not None]

    def _reading(self, line: bytes, now_s: float) -> DvlReading | None:
        said = json_object(line) if len(line) <= LONGEST else None
        is_again, self._last = line == self._last, line
        if said is None or is_again:
            return self.refuse("the same line again" if is_again else "no line of JSON")
        if said.get("type", "velocity") != "velocity":
            return self.refuse(f"{str(said['type'])[:32]}: not used")
        numbers = [_number(said, name) for name in ("vx", "vy", "vz", "fom")]
        if not all(map(math.isfinite, numbers)) or not isinstance(said.get("velocity_valid"), bool):
            return self.refuse("a velocity without its numbers")
        self.heard += 1
        if not said["velocity_valid"]:
            return self.refuse("velocity not valid: the bottom is lost")
        ahead, right, down, fom = numbers
        self.fom_m_s = fom
        if not 0.0 <= fom <= self._fom_most:
            return self.refuse(f"figure of merit beyond {self._fom_most:g} m/s")
        cos, sin = math.cos(self._turn), math.sin(self._turn)
        left = -right
        vel_b = np.array([cos * ahead - sin * left, sin * ahead + cos * left, -down])
        return DvlReading(self._measured_s(said, now_s), vel_b)

    def _measured_s(self, said: dict[str, Any], now_s: float) -> float:
        """The device's delay is the difference of its two stamps, whatever its clock says."""
        valid_s, sent_s = (1e-6 * _number(said, f"time_of_{name}") for name in ("validity", "transmission"))
        come_s = self.clock.measured_s(sent_s if math.isfinite(sent_s) else None, now_s)
        delay_s = sent_s - valid_s
        return come_s - (delay_s if 0.0 <= delay_s <= _LONGEST_S else self._latency_s)


def _number(said: dict[str, Any], name: str) -> float:
    value = said.get(name)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
