"""An endpoint that keeps the vehicle's clock: for a simulated one, be it slower or faster than ours."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from threading import Event

from uuvtai.link.endpoint import Address, Endpoint, LinkPlace
from uuvtai.link.link_errors import LinkError

SILENT_S = 5.0
"""by our clock: a vehicle that has told no time for so long is followed no further, lest a dead man's time
stand still"""
MOST_WAITING = 512
"""datagrams between two steps; older ones are lost"""
_FARTHEST_S = 5.0
"""a time that jumps by more has begun anew"""
_MAGIC, _HEAD, _ENDS = 0xFD, 10, 2
"""MAVLink 2: first byte, bytes before and behind the payload"""
_SIGNED, _SIGNATURE = 1, 13
_AUTOPILOT, _HEARTBEAT, _ATTITUDE = 1, 0, 30
_LOOPBACK = ("127.", "localhost")


class FollowedEndpoint(Endpoint):
    """``now`` and ``sleep`` are of the autopilot's clock, as its ATTITUDE tells it (50 times a second once it
    was asked). Before it has told any, ours counts, and heartbeats alone are heard: what came earlier would
    be dated by another clock."""

    def __init__(
        self,
        place: LinkPlace,
        system: int,
        wall: Callable[[], float] = time.monotonic,
        pause: Callable[[], None] | None = None,
    ) -> None:
        """``system``: the vehicle's id. ``wall``: our clock; ``pause``: waits for a datagram, a little.
        Raises LinkError, also for a place that is not on this computer."""
        if not place.host.startswith(_LOOPBACK):
            raise LinkError(
                f"--rate 0: follows the clock of a simulated vehicle on this computer, not of {place.host}; "
                "give --rate 1"
            )
        super().__init__(place)
        self._system, self._wall = system, wall
        self._pause = pause or (lambda: self.wait(0.005))
        self._waiting: list[tuple[Address, bytes]] = []
        self._told_s: float | None = None
        self._before_s = math.inf
        """what was told before a time that fell"""
        self._time_s, self._heard_s = 0.0, wall()

    def receive(self) -> list[tuple[Address, bytes]]:
        """What has come since the last call."""
        self._take()
        found, self._waiting = self._waiting, []
        return found

    def now(self) -> float:
        """[s] since the beginning."""
        return self._time_s + max(0.0, self._wall() - self._heard_s - self._patience_s)

    def sleep(self, seconds: float, stop: Event | None = None) -> None:
        """Until the vehicle's clock has come so far, or ``stop`` is set."""
        until_s = self.now() + seconds - 1e-6
        while self.now() < until_s and not (stop is not None and stop.is_set()):
            self._pause()
            self._take()

    @property
    def _patience_s(self) -> float:
        return 0.0 if self._told_s is None else SILENT_S

    def _take(self) -> None:
        for sender, datagram in super().receive():
            kinds = set()
            for kind, payload in _messages(datagram, self._system):
                kinds.add(kind)
                if kind == _ATTITUDE:
                    self._hear(int.from_bytes(payload[:4].ljust(4, b"\0"), "little") / 1e3)
            if self._told_s is not None or kinds == {_HEARTBEAT}:
                self._waiting = [*self._waiting, (sender, datagram)][-MOST_WAITING:]

    def _hear(self, told_s: float) -> None:
        last_s, now_s = self._told_s, self.now()
        if self._before_s < told_s:  # what came last was late
            last_s = self._before_s
        self._before_s = last_s if last_s is not None and told_s < last_s else math.inf
        spent_s = 0.0 if last_s is None else told_s - last_s
        told_now_s = self._time_s + spent_s if 0.0 <= spent_s <= _FARTHEST_S else -math.inf
        self.clock_jumps += told_now_s < now_s
        self._time_s = max(told_now_s, now_s)
        self._told_s, self._heard_s = told_s, self._wall()


def _messages(datagram: bytes, system: int) -> list[tuple[int, bytes]]:
    """(number, payload) of the messages of a vehicle's autopilot; anybody's heartbeats too. Checksums are
    looked at by who reads them."""
    found, at = [], 0
    while at + _HEAD < len(datagram) and datagram[at] == _MAGIC:
        size, flags, sender = datagram[at + 1], datagram[at + 2], tuple(datagram[at + 5 : at + 7])
        number = int.from_bytes(datagram[at + 7 : at + 10], "little")
        if number == _HEARTBEAT or sender == (system, _AUTOPILOT):
            found.append((number, datagram[at + _HEAD : at + _HEAD + size]))
        at += _HEAD + size + _ENDS + (_SIGNATURE if flags & _SIGNED else 0)
    return found
