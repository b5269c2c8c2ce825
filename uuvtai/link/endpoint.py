"""A UDP socket: datagrams in, as many as one step can digest, and out to whom the vehicle spoke from."""

from __future__ import annotations

import re
import select
import socket
from dataclasses import dataclass

from uuvtai.link.link_errors import LinkError

Address = tuple[str, int]

MOST_DATAGRAMS, MOST_BYTES = 64, 24 * 1024
"""taken in one step; what is more waits, and is lost where the system's own queue is full"""
LONGEST = 2048
"""[bytes] a longer datagram is none of MAVLink's"""
_MOST_ROUNDS = 100
_WRITTEN = re.compile(r"(udp|udpin|udpout):([A-Za-z0-9.\-]{1,253}):(\d{1,5})")


@dataclass(frozen=True)
class LinkPlace:
    """Where a link is."""

    host: str
    port: int
    calls: bool
    """udpout: we speak first, to this place; else we listen there"""


def place_of(text: str, option: str = "--mavlink") -> LinkPlace:
    """``udp:HOST:PORT`` (or ``udpin:``): listen; ``udpout:HOST:PORT``: speak to it. Raises LinkError."""
    found = _WRITTEN.fullmatch(text)
    if found is None or not 0 < int(found[3]) < 65536:
        raise LinkError(
            f"{option} {text!r}: write udp:HOST:PORT to listen, or udpout:HOST:PORT to speak first; for "
            f"example {option} udp:127.0.0.1:14550"
        )
    return LinkPlace(found[2], int(found[3]), found[1] == "udpout")


class Endpoint:
    """One side of a UDP link. Use as a context."""

    clock_jumps = 0
    """how often the clock that it keeps, if any, ran on without its senders' clocks"""

    def __init__(self, place: LinkPlace) -> None:
        """Raises LinkError where the address cannot be had."""
        self.place = place
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            address = socket.gethostbyname(place.host), place.port
            if not place.calls:
                self._socket.bind(address)
            elif address[0].startswith("127."):
                self._socket.bind(("127.0.0.1", 0))
        except OSError as error:
            self._socket.close()
            doing = "speak to" if place.calls else "listen at"
            raise LinkError(
                f"{place.host}:{place.port}: cannot {doing} this address ({error.strerror or error}); "
                "another program may hold the port, or the host may be none of this computer's: try "
                f"udp:127.0.0.1:{place.port}"
            ) from None
        self.calls: Address | None = address if place.calls else None
        self._socket.setblocking(False)
        self.port: int = self._socket.getsockname()[1]

    def receive(self) -> list[tuple[Address, bytes]]:
        """What has come since the last call, within the bounds of one step."""
        found: list[tuple[Address, bytes]] = []
        size = 0
        while len(found) < MOST_DATAGRAMS and size < MOST_BYTES:
            try:
                data, sender = self._socket.recvfrom(LONGEST + 1)
            except ConnectionError:  # an earlier datagram of ours found nobody
                continue
            except OSError:
                break
            size += len(data)
            found.append((sender, data if len(data) <= LONGEST else b""))
        return found

    def forget(self) -> None:
        """Drop what has come so far; of a flood a part."""
        for _ in range(_MOST_ROUNDS):
            if not self.receive():
                return

    def wait(self, seconds: float) -> None:
        """Until something has come, but no longer."""
        select.select([self._socket], [], [], seconds)

    def send(self, data: bytes, to: Address) -> bool:
        """Whether the system took it."""
        try:
            return self._socket.sendto(data, to) == len(data)
        except OSError:
            return False

    def close(self) -> None:
        """Let go of the port."""
        self._socket.close()

    def __enter__(self) -> Endpoint:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
