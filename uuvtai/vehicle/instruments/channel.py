"""Where an instrument speaks: a TCP server, datagrams, a serial port. Nothing here waits; a place that is
lost is opened again."""

from __future__ import annotations

import ipaddress
import math
import socket
import struct
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from uuvtai.common.clocks import SourceClock
from uuvtai.config.base import WRITTEN_PLACE
from uuvtai.vehicle.mavlink import LinkError
from uuvtai.vehicle.messages import SensorMessage

AGAIN_S = 1.0  # between two tries to open a place
SILENT_S = 3.0  # a server that has said nothing for so long is called again; another sender is heard then
MOST_BYTES = 256 << 10  # taken in one step; what is more waits, or is lost where the system's queue is full
MOST_KINDS = 32  # reasons why something was not used that are told apart


@dataclass(frozen=True)
class InstrumentPlace:
    """Where an instrument is, as typed."""

    kind: str
    host: str  # or a serial port; '' = any address of this computer
    port: int  # 0 = none

    def __str__(self) -> str:
        return f"{self.kind}:{self.host}:{self.port}"


def place_of(text: str, option: str, ports: dict[str, int]) -> InstrumentPlace:
    """``KIND:HOST``, ``KIND:HOST:PORT`` or ``KIND:/dev/PORT``; ``ports``: usual port by kind. Raises
    LinkError."""
    found = WRITTEN_PLACE.fullmatch(text)
    kind, host, port = found.groups() if found else ("", "", None)
    number = int(port) if port else ports.get(kind, 0)
    if kind not in ports or not 0 < number < 65536:
        raise LinkError(
            f"{option} {text!r}: write KIND:HOST or KIND:HOST:PORT, for example {option} "
            f"{next(iter(ports))}:192.168.2.95; KIND is one of {', '.join(ports)}"
        )
    return InstrumentPlace(kind, host, number)


class Channel(ABC):
    """Bytes of one instrument."""

    opened = 0
    """how often the place was opened; what was read before is no beginning of what comes after"""
    strange = 0
    """datagrams of others, and longer ones than the instrument sends"""

    @abstractmethod
    def read(self, now_s: float) -> list[bytes]:
        """What has come since the last call: datagrams, or pieces of a stream."""

    def write(self, data: bytes) -> bool:
        """Whether the system took it; what only listens takes nothing."""
        return False

    @abstractmethod
    def close(self) -> None:
        """Give the place back."""


class TcpChannel(Channel):
    """A client of a TCP server that speaks all the time: one that lost its power says no farewell. The
    address is looked up once."""

    def __init__(self, host: str, port: int) -> None:
        """Raises LinkError for a host that is none."""
        self._address = _address(host), port
        self._socket: socket.socket | None = None
        self._is_open, self._called_s, self._heard_s = False, -math.inf, -math.inf

    def read(self, now_s: float) -> list[bytes]:
        if self._socket is not None and now_s - max(self._called_s, self._heard_s) > SILENT_S:
            self.close()
        if self._socket is None:
            if now_s - self._called_s < AGAIN_S:
                return []
            self._called_s = now_s
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
            self._socket.setblocking(False)
            self._socket.connect_ex(self._address)
        found, size = [], 0
        while size < MOST_BYTES:
            try:
                data = self._socket.recv(1 << 16)
            except OSError:  # nothing has come, or nobody answers
                break
            if not data:
                self.close()
                break
            self.opened += not self._is_open
            self._is_open, self._heard_s = True, now_s
            size += len(data)
            found.append(data)
        return found

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket, self._is_open = None, False


class UdpChannel(Channel):
    """Datagrams: of the instrument that we speak to, or of whom comes to our port."""

    opened = 1

    def __init__(self, place: InstrumentPlace, calls: bool, longest: int) -> None:
        """``calls``: we speak first, to the place, and hear nobody else; else we listen at its port, to its
        host alone; where it names none, or a multicast group, to whom spoke first while that one speaks.
        Longer datagrams than ``longest`` are none of the instrument's. Raises LinkError."""
        self._longest = longest
        host = _address(place.host) if place.host else ""
        is_group = bool(host) and ipaddress.ip_address(host).is_multicast
        self._to = (host, place.port) if calls else None
        self._from = "" if is_group else host
        self._speaker, self._heard_s = "", -math.inf
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            if not calls:
                if is_group:
                    self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                self._socket.bind(("", place.port))
            if is_group:
                group = struct.pack("=4s4s", socket.inet_aton(host), socket.inet_aton("0.0.0.0"))
                self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
        except OSError as error:
            self._socket.close()
            raise LinkError(
                f"{place}: cannot listen at port {place.port} ({error.strerror or error}); another program "
                "may hold it: close that, or give another port"
            ) from None
        self.port: int = self._socket.getsockname()[1]

    def read(self, now_s: float) -> list[bytes]:
        found, size = [], 0
        while size < MOST_BYTES:
            try:
                data, sender = self._socket.recvfrom(self._longest + 1)
            except ConnectionError:  # an earlier datagram of ours found nobody
                continue
            except OSError:
                break
            size += max(len(data), 64)
            if now_s - self._heard_s > SILENT_S:
                self._speaker = self._from or sender[0]
            if sender[0] != self._speaker or len(data) > self._longest:
                self.strange += 1
            else:
                self._heard_s = now_s
                found.append(data)
        return found

    def write(self, data: bytes) -> bool:
        try:
            return self._to is not None and self._socket.sendto(data, self._to) == len(data)
        except OSError:
            return False

    def close(self) -> None:
        self._socket.close()


class SerialChannel(Channel):
    """A serial port, by pyserial."""

    def __init__(self, name: str, baud: int) -> None:
        """Raises LinkError where pyserial is missing."""
        try:
            import serial
        except ImportError:
            raise LinkError(
                f"{name}: a serial port is read by pyserial, which is not here: pip install "
                "'uuvtai[instruments]'"
            ) from None
        self._make: Callable[[], Any] = lambda: serial.Serial(name, baud, timeout=0, write_timeout=0)
        self._port: Any = None
        self._called_s = -math.inf

    def read(self, now_s: float) -> list[bytes]:
        try:
            if self._port is None:
                if now_s - self._called_s < AGAIN_S:
                    return []
                self._called_s = now_s
                self._port, self.opened = self._make(), self.opened + 1
            data = self._port.read(MOST_BYTES)
        except (OSError, ValueError):  # serial.SerialException is an OSError
            self.close()
            return []
        return [data] if data else []

    def write(self, data: bytes) -> bool:
        try:
            return self._port is not None and self._port.write(data) == len(data)
        except OSError:
            self.close()
            return False

    def close(self) -> None:
        if self._port is not None:
            self._port.close()
        self._port = None


class Instrument(ABC):
    """One device: ``poll`` in every step gives what it has told."""

    def __init__(self, channel: Channel) -> None:
        self.channel, self._last = channel, b""  # of what stamps: a relay without it may say one for ever
        self.heard = 0  # messages that were understood
        self.refused: Counter[str] = Counter()
        """why something was not used -> how often; at most ``MOST_KINDS`` reasons"""
        self.clock = SourceClock()  # of a device that stamps what it tells
        self.fom_m_s: float | None = None
        """of a DVL that tells it: figure of merit of its last valid velocity"""

    @abstractmethod
    def poll(self, now_s: float) -> list[SensorMessage]:
        """What has come, in body axes about the instrument's own place; ``now_s`` by the pilot's clock."""

    def look_around(self, whole: bool) -> bool:
        """See all around, finely, or again what is configured; False where nothing turns by itself."""
        return False

    def close(self) -> None:
        """Give the place back."""
        self.channel.close()

    def refuse(self, why: str) -> None:
        """Count what was not used."""
        if why in self.refused or len(self.refused) < MOST_KINDS:
            self.refused[why] += 1


def _address(host: str) -> str:
    try:
        return socket.gethostbyname(host)
    except (OSError, UnicodeError):
        raise LinkError(f"{host}: no host of this name or address; give the instrument's address") from None
