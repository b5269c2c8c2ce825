"""What ArduSub sends its physics, and whether that asks for a step. Pure functions.

A packet (ArduPilot, libraries/SITL/SIM_JSON.h), little endian: magic, frame rate [Hz], frame count, then the
pulse widths [us] of 16 channels, or of 32.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Literal

_HEAD = struct.Struct("<HHI")
_CHANNELS = {18458: 16, 29569: 32}
"""magic -> channels"""
RATES_HZ = (50, 4000)
"""physics steps in a second that are believed"""
DOUBLED_S = 0.5
"""ArduSub sends a packet again after a second without an answer; what comes much sooner was doubled"""

Turn = Literal["reset", "step", "again", "ignore"]


@dataclass(frozen=True)
class ServoFrame:
    """One packet."""

    rate_hz: int
    count: int
    pwm: tuple[int, ...]


def frame_of(packet: bytes) -> ServoFrame | None:
    """The packet's content; None for what is no packet of ArduSub's."""
    if len(packet) < _HEAD.size:
        return None
    magic, rate, count = _HEAD.unpack_from(packet)
    channels = _CHANNELS.get(magic, 0)
    if channels == 0 or len(packet) != _HEAD.size + 2 * channels or not RATES_HZ[0] <= rate <= RATES_HZ[1]:
        return None
    return ServoFrame(rate, count, struct.unpack_from(f"<{channels}H", packet, _HEAD.size))


def turn_of(count: int, last: int | None, waited_s: float) -> Turn:
    """What a frame asks for: ``last`` is the count answered last (None = none yet), ``waited_s`` ago.

    reset: ArduSub has begun anew. step: one step, whatever was lost in between, for ArduSub waits for every
    answer. again: our answer was lost. ignore: the packet was doubled, and two answers would be one too many.
    """
    if last is None or count < last:
        return "reset"
    if count > last:
        return "step"
    return "again" if waited_s >= DOUBLED_S else "ignore"
