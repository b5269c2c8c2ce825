"""One ArduSub's water: a packet in, an answer out, and what the sensors say meanwhile. No sockets here.

A packet (ArduPilot, libraries/SITL/SIM_JSON.h), little endian: magic, frame rate [Hz], frame count, then the
pulse widths [us] of 16 channels, or of 32.
"""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np

from uuvtai.config import Config
from uuvtai.link.orders import Order
from uuvtai.sitl.fdm_reply import Motion, reply_of
from uuvtai.sitl.reported_sensors import ReportedSensors

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


class Water(Protocol):
    """What an instance needs of ``WaterRows``."""

    def begin(self, row: int) -> None:
        """The row's episode from its beginning."""
        ...

    def push(self, row: int, pwm: tuple[int, ...], dt_s: float) -> None:
        """Move the vehicle by one step."""
        ...

    def control_step(self, row: int) -> str:
        """The world by a control step; how the episode ended, '' = not yet."""
        ...

    def sense(self, row: int) -> None:
        """Instruments and sonar."""
        ...

    def motion(self, row: int, time_s: float) -> Motion:
        """What the vehicle really does."""
        ...

    def value(self, name: str, row: int) -> np.ndarray:
        """Copy of 'struct.field'."""
        ...

    def turns(self, pwm: tuple[int, ...]) -> bool:
        """Whether any thruster is asked to turn."""
        ...


class Instance:
    """Until a thruster turns for the first time the vehicle is held at its start and the bodies stand still:
    an autopilot needs half a minute to get ready, and an episode begins when it is driven."""

    def __init__(self, config: Config, water: Water, row: int) -> None:
        self._config, self._water, self._row = config, water, row
        self._dt = config.episode.control_dt_s
        self._count: int | None = None
        self._answered_s, self._answer = 0.0, b""
        self._forget()
        self.counts: Counter[str] = Counter()
        """by turn, and 'bad' packets"""
        self.time_s = 0.0
        """since the episode's or ArduSub's beginning"""
        self.outcome, self._ended_s = "", 0.0
        self.joined_late = False
        """whether a thruster turned in the first packet: ArduSub drove in another water"""

    def _forget(self) -> None:
        self.time_s = self.driven_s = 0.0
        self.is_held, self._ticks, self.outcome = True, 0, ""
        self._sensors = ReportedSensors(self._config)

    def answer(self, packet: bytes, now_s: float) -> tuple[bytes, list[Order]]:
        """(what to send back, empty = nothing; what the sensors say) to a packet that came at ``now_s``."""
        frame = frame_of(packet)
        if frame is None:
            self.counts["bad"] += 1
            return b"", []
        turn = turn_of(frame.count, self._count, now_s - self._answered_s)
        self.counts[turn] += 1
        if turn == "ignore":
            return b"", []
        said: list[Order] = []
        if turn == "reset":
            self._water.begin(self._row)
            self._forget()
            self.joined_late = self._water.turns(frame.pwm)
        if turn != "again":
            said = self._step(frame.pwm, 1.0 / frame.rate_hz)
            self._answer = reply_of(self._water.motion(self._row, self.time_s))
        self._count, self._answered_s = frame.count, now_s
        return self._answer, said

    def _step(self, pwm: tuple[int, ...], dt_s: float) -> list[Order]:
        self.is_held = self.is_held and not self._water.turns(pwm)
        if not self.is_held:
            self._water.push(self._row, pwm, dt_s)
            self.driven_s += dt_s
        self.time_s += dt_s
        said: list[Order] = []
        while self._ticks * self._dt <= self.time_s + 1e-6:  # sums of steps miss a little
            self._ticks += 1
            if not self.is_held:
                ended = self._water.control_step(self._row)
                if ended and not self.outcome:
                    self.outcome, self._ended_s = ended, self.time_s
            self._water.sense(self._row)
            altitude = self._water.motion(self._row, self.time_s).altitude_m
            said += self._sensors.report(
                self.time_s, altitude, lambda name: self._water.value(name, self._row)
            )
        return said

    @property
    def lingered_s(self) -> float:
        """of the water's time, since the episode ended; 0 = it has not"""
        return self.time_s - self._ended_s if self.outcome else 0.0

    def document(self) -> dict[str, Any]:
        """Its line in ``uuv sitl --json``."""
        return {
            "row": self._row,
            "seconds": round(self.time_s, 3),
            "driven_s": round(self.driven_s, 3),
            "outcome": self.outcome or ("waiting" if self.is_held else "running"),
            "packets": {name: self.counts[name] for name in ("step", "reset", "again", "ignore", "bad")},
        }
