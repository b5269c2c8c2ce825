"""MAVLink 2 by pymavlink: bytes in, bounded and checked; orders out."""

from __future__ import annotations

import errno
import importlib.util
import math
import re
import select
import socket
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from threading import Event
from typing import Any

from uuvtai.common.errors import UserError
from uuvtai.vehicle.safety import SafetyLimits, Velocity, bounded

# ---- What is refused about a link to a vehicle.


class LinkError(UserError, RuntimeError):
    """A link that cannot be had, or used: what, where, why, what to type next."""


# ---- A UDP socket: datagrams in, as many as one step can digest, and out to whom the vehicle spoke from.

Address = tuple[str, int]

MOST_DATAGRAMS, MOST_BYTES = 64, 24 * 1024
"""taken in one step; what is more waits, and is lost where the system's own queue is full"""
LONGEST = 2048  # [bytes] a longer datagram is none of MAVLink's
_MOST_ROUNDS = 100
_WRITTEN = re.compile(r"(udp|udpin|udpout):([A-Za-z0-9.\-]{1,253}):(\d{1,5})")


@dataclass(frozen=True)
class LinkPlace:
    host: str
    port: int
    calls: bool  # udpout: we speak first, to this place; else we listen there


def place_of(text: str, option: str = "--mavlink") -> LinkPlace:
    """``udp:HOST:PORT`` (or ``udpin:``): listen; ``udpout:HOST:PORT``: speak to it. Raises LinkError."""
    found = _WRITTEN.fullmatch(text)
    if found is None or not 0 < int(found[3]) < 65536:
        raise LinkError(
            f"{option} {text!r}: write udp:HOST:PORT to listen, or udpout:HOST:PORT to speak first; for "
            f"example {option} udp:127.0.0.1:14550"
        )
    return LinkPlace(found[2], int(found[3]), found[1] == "udpout")


class Endpoint(AbstractContextManager["Endpoint"]):
    """One side of a UDP link. Use as a context."""

    clock_jumps = 0  # how often the clock that it keeps, if any, ran on without its senders' clocks

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
            why = (
                f"another program, QGroundControl perhaps, holds the port: give --mavlink udp:{place.host}:"
                f"{place.port + 1 if place.port < 65535 else 14551}, and have the router send there too"
                if error.errno == errno.EADDRINUSE
                else f"the host may be none of this computer's: try --mavlink udp:0.0.0.0:{place.port}"
            )
            raise LinkError(
                f"{place.host}:{place.port}: cannot {doing} this address ({error.strerror or error}); {why}"
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
        self._socket.close()

    def __exit__(self, *_: object) -> None:
        self.close()


# ---- An endpoint that keeps the vehicle's clock: for a simulated one, be it slower or faster than ours.

SILENT_S = 5.0  # by our clock: who told no time for so long is followed no further, lest time stand still
MOST_WAITING = 512  # datagrams between two steps; older ones are lost
_FARTHEST_S = 5.0  # a time that jumps by more has begun anew
_MAGIC, _HEAD, _ENDS = 0xFD, 10, 2  # MAVLink 2: first byte, bytes before and behind the payload
_SIGNED, _SIGNATURE = 1, 13
_AUTOPILOT, _HEARTBEAT, _ATTITUDE = 1, 0, 30
_LOOPBACK = re.compile(r"localhost|127(\.\d{1,3}){3}")


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
        if not _LOOPBACK.fullmatch(place.host):
            raise LinkError(
                f"--rate 0: follows the clock of a simulated vehicle on this computer, not of {place.host}; "
                "give --rate 1"
            )
        super().__init__(place)
        self._system, self._wall = system, wall
        self._pause = pause or (lambda: self.wait(0.005))
        self._waiting: list[tuple[Address, bytes]] = []
        self._told_s: float | None = None
        self._before_s = math.inf  # what was told before a time that fell
        self._time_s, self._heard_s = 0.0, wall()

    def receive(self) -> list[tuple[Address, bytes]]:
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
    """(number, payload) of an autopilot's messages and anybody's heartbeats. Checksums are unchecked."""
    found, at = [], 0
    while at + _HEAD < len(datagram) and datagram[at] == _MAGIC:
        size, flags, sender = datagram[at + 1], datagram[at + 2], tuple(datagram[at + 5 : at + 7])
        number = int.from_bytes(datagram[at + 7 : at + 10], "little")
        if number == _HEARTBEAT or sender == (system, _AUTOPILOT):
            found.append((number, datagram[at + _HEAD : at + _HEAD + size]))
        at += _HEAD + size + _ENDS + (_SIGNATURE if flags & _SIGNED else 0)
    return found


# ---- What may be said to a vehicle, and nothing else: each a message of MAVLink by name and fields. Every
# number is held within the limits here once more, whatever the caller asks for.

BODY_NED = 8  # MAV_FRAME: axes turn with the yaw; z stays down
VELOCITY_AND_YAW_RATE = 0x5C7  # type_mask: positions, accelerations and yaw are not given
ALT_HOLD, GUIDED, SURFACE = 2, 4, 9  # modes of ArduSub
MODE_NAMES = {
    0: "STABILIZE", 1: "ACRO", 2: "ALT_HOLD", 3: "AUTO", 4: "GUIDED", 7: "CIRCLE", 9: "SURFACE",
    16: "POSHOLD", 19: "MANUAL", 20: "MOTOR_DETECT", 21: "SURFTRAK",
}  # fmt: skip
HARMLESS = ("HEARTBEAT", "MAV_CMD_SET_MESSAGE_INTERVAL", "PARAM_REQUEST_READ")
"""orders that move nothing: sent in a dry run too"""
STICK = 600  # of 1000: the farthest that a stick is ever pushed
FULL_STICK = (1.0, 1.0, 0.6, 2.0)
"""[m/s, m/s, m/s, rad/s] what a full stick is taken to give; the feedback corrects it"""
FEEDBACK = 1.5  # of the missing velocity, added to the one asked for

DO_SET_MODE, ARM_DISARM, _SET_MESSAGE_INTERVAL = 176, 400, 511


@dataclass(frozen=True)
class Order:
    """A message on its way to the vehicle."""

    kind: str  # its name; of a command the command's
    message: str
    fields: dict[str, Any]
    as_operator: bool = False  # in the name of the ground station, from which alone ArduSub takes sticks


def set_velocity(velocity: Velocity, now_s: float, system: int, limits: SafetyLimits) -> Order:
    """Velocity in body axes and yaw rate, for GUIDED: SET_POSITION_TARGET_LOCAL_NED."""
    surge, sway, heave, turn = bounded(velocity, limits)
    place = dict.fromkeys(("x", "y", "z", "afx", "afy", "afz", "yaw"), 0.0)
    fields = {
        "time_boot_ms": int(1e3 * max(now_s, 0.0)) & 0xFFFFFFFF,
        "target_system": system,
        "target_component": 1,
        "coordinate_frame": BODY_NED,
        "type_mask": VELOCITY_AND_YAW_RATE,
        **place,
        "vx": surge, "vy": 0.0 - sway, "vz": 0.0 - heave, "yaw_rate": 0.0 - turn,
    }  # fmt: skip
    return Order("SET_POSITION_TARGET_LOCAL_NED", "SET_POSITION_TARGET_LOCAL_NED", fields)


def push_sticks(velocity: Velocity, measured: Velocity | None, system: int, limits: SafetyLimits) -> Order:
    """The same for ALT_HOLD, where sticks are thrust ahead and sideways and rates up and round:
    MANUAL_CONTROL. ``measured``: velocity as it is, NaN or None = unknown, so that nothing is fed back. No
    stick goes beyond what a limit of speed is taken to need, whatever is measured."""
    asked = bounded(velocity, limits)
    most = (limits.speed_m_s, limits.speed_m_s, limits.heave_m_s, limits.yaw_rate_rad_s)
    shares = []
    for want, has, full, cap in zip(asked, measured or asked, FULL_STICK, most, strict=True):
        more = FEEDBACK * (want - has) if math.isfinite(has) else 0.0
        shares.append(max(-1.0, -cap / full, min(1.0, cap / full, (want + more) / full)))
    surge, sway, heave, turn = (round(STICK * share) for share in shares)
    fields = {"target": system, "x": surge, "y": -sway, "z": 500 + heave // 2, "r": -turn, "buttons": 0}
    return Order("MANUAL_CONTROL", "MANUAL_CONTROL", fields, as_operator=True)


def set_mode(mode: int, system: int) -> Order:
    return _command("MAV_CMD_DO_SET_MODE", DO_SET_MODE, system, 1.0, float(mode))


def arm(system: int) -> Order:
    """Arm, never by force."""
    return _command("MAV_CMD_COMPONENT_ARM_DISARM", ARM_DISARM, system, 1.0)


def ask_for(message_id: int, rate_hz: float, system: int) -> Order:
    return _command(
        "MAV_CMD_SET_MESSAGE_INTERVAL", _SET_MESSAGE_INTERVAL, system, float(message_id), 1e6 / rate_hz
    )


def ask_parameter(name: str, system: int) -> Order:
    """Have the autopilot tell one of its parameters; nothing is written."""
    whom = {"target_system": system, "target_component": 1}
    fields = {**whom, "param_id": name.encode(), "param_index": -1}
    return Order("PARAM_REQUEST_READ", "PARAM_REQUEST_READ", fields)


def heartbeat() -> Order:
    """An onboard controller is here."""
    fields = {"type": 18, "autopilot": 8, "base_mode": 0, "custom_mode": 0, "system_status": 4}
    return Order("HEARTBEAT", "HEARTBEAT", {**fields, "mavlink_version": 3})


def _command(kind: str, number: int, system: int, *given: float) -> Order:
    params = {f"param{i + 1}": given[i] if i < len(given) else 0.0 for i in range(7)}
    whom = {"target_system": system, "target_component": 1, "command": number, "confirmation": 0}
    return Order(kind, "COMMAND_LONG", {**whom, **params})


EXTRA = "uuvtai[mavlink]"
_NEEDED = "pymavlink.dialects.v20"
_MOST_MESSAGES = 64  # of one datagram; a full one of the shortest has no more in an Ethernet frame
_BROKEN = (ValueError, TypeError, IndexError, KeyError, AttributeError, OverflowError)


@dataclass(frozen=True)
class MavMessage:
    """One message that was understood."""

    name: str
    system: int
    component: int
    fields: dict[str, Any]


class MavCodec:
    """One side of a link: whom it speaks as, and what it understood."""

    def __init__(self, system: int, component: int, operator: int = 255) -> None:
        """Raises LinkError where pymavlink is missing."""
        self._dialect = _dialect()
        self._own = self._dialect.MAVLink(None, srcSystem=system, srcComponent=component)
        self._as_operator = self._dialect.MAVLink(None, srcSystem=operator, srcComponent=component)
        self.senders = {(system, component), (operator, component)}
        """ours: what comes back from there is an echo"""
        self.broken = self.echoes = 0  # pieces of datagrams that were no message; heartbeats by our own id

    def decode(self, datagram: bytes) -> list[MavMessage]:
        """Messages of one datagram; nothing is carried over to the next one."""
        parser = self._dialect.MAVLink(None)
        parser.robust_parsing = True
        try:
            parsed = parser.parse_buffer(datagram) or []
        except (self._dialect.MAVError, self._dialect.struct.error, *_BROKEN):
            self.broken += 1
            return []
        found = []
        for message in parsed[:_MOST_MESSAGES]:
            if message.get_type() == "BAD_DATA" or message.get_type().startswith("UNKNOWN"):
                self.broken += 1
                continue
            sender = message.get_srcSystem(), message.get_srcComponent()
            if sender in self.senders:
                self.echoes += message.get_type() == "HEARTBEAT"
            else:
                fields = {name: getattr(message, name) for name in message.get_fieldnames()}
                found.append(MavMessage(message.get_type(), *sender, fields))
        return found

    def encode(self, order: Order) -> bytes:
        """Bytes of an order. ValueError for what MAVLink does not have."""
        made = self._dialect.mavlink_map
        number = getattr(self._dialect, f"MAVLINK_MSG_ID_{order.message}", None)
        if number is None:
            raise ValueError(f"{order.message}: no message of MAVLink")
        message = made[number](**order.fields)
        return message.pack(self._as_operator if order.as_operator else self._own)

    def sent(self, order: Order) -> None:
        """Count an order as sent: the receiver counts messages by number."""
        link = self._as_operator if order.as_operator else self._own
        link.seq = (link.seq + 1) % 256


def _dialect() -> Any:
    try:
        found = importlib.util.find_spec(_NEEDED)
    except ImportError:
        found = None
    if found is None:
        raise LinkError(f"MAVLink is spoken by pymavlink, which is not here: pip install '{EXTRA}'")
    from pymavlink.dialects.v20 import ardupilotmega

    return ardupilotmega
