"""MAVLink 2 by pymavlink: bytes in, bounded and checked; orders out."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from typing import Any

from uuvtai.link.link_errors import LinkError
from uuvtai.link.orders import Order

EXTRA = "uuvtai[mavlink]"
_NEEDED = "pymavlink.dialects.v20"
_MOST_MESSAGES = 64
"""of one datagram; a full one of the shortest messages holds no more than that in an Ethernet frame"""
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
        self.broken = 0
        """pieces of datagrams that were no message"""

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
            if sender not in self.senders:
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
