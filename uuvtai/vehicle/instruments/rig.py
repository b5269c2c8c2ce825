"""The instruments that a pilot hears beside MAVLink, and what each may tell."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from math import radians
from typing import Any

import numpy as np

from uuvtai.common.clocks import SourceClock
from uuvtai.common.files import FileError, parsed_json
from uuvtai.config import Config
from uuvtai.vehicle.instruments import a50, ping, rip2
from uuvtai.vehicle.instruments.channel import (
    Instrument,
    InstrumentPlace,
    SerialChannel,
    TcpChannel,
    UdpChannel,
    place_of,
)
from uuvtai.vehicle.messages import KINDS, NAMES, DvlReading, SensorMessage, is_believed

JSON_PORT, _LONGEST, _OLDEST_S = 14700, 65507, 5.0
PORTS = {
    "dvl": {"a50": a50.PORT, "json": JSON_PORT},
    "sonar": {"ping360": ping.PORT, "3d15": rip2.PORT, "json": JSON_PORT},
}
"""what is given by which option: kind -> usual port"""
HAVE_IMAGES = ("3d15", "json")  # sonars that may tell depth images
_TELLS = {"dvl": ("dvl",), "sonar": ("sonar", "depth")}


class Rig(AbstractContextManager["Rig"]):
    """Use as a context: what was opened is closed."""

    def __init__(self, config: Config, typed: Mapping[str, str]) -> None:
        """``typed``: place by option name. Raises LinkError, SettingError."""
        self.replaced = frozenset(typed)  # kinds of messages that MAVLink's senders no longer tell
        self._lever = np.array(config.sensors.dvl.position_b_m)
        self._sources: dict[InstrumentPlace, tuple[Instrument, set[str]]] = {}
        try:
            for option, text in typed.items():
                place = place_of(text, f"--{option}", PORTS[option])
                if place not in self._sources:
                    self._sources[place] = _opened(place, config), set()
                self._sources[place][1].update(_TELLS[option])
        except BaseException:
            self.close()
            raise

    def poll(self, now_s: float, rate_b: np.ndarray) -> Iterator[tuple[Instrument, SensorMessage]]:
        """What has come since the last step, about the vehicle's centre; ``rate_b`` (3,) [rad/s] now."""
        for instrument, kinds in self._sources.values():
            for message in instrument.poll(now_s):
                name = NAMES[type(message)]
                if name not in kinds:
                    instrument.refuse(f"{name}: not asked for")
                elif not is_believed(message):
                    instrument.refuse(f"{name}: numbers that cannot be")
                elif not isinstance(message, DvlReading):
                    yield instrument, message
                elif np.shape(message.vel_b) != (3,):
                    instrument.refuse("dvl: a velocity has three numbers")
                else:
                    moved = np.cross(rate_b, self._lever)
                    yield instrument, dataclasses.replace(message, vel_b=message.vel_b - moved)

    def look_around(self, whole: bool) -> bool:
        """As ``Instrument.look_around``, of any of them."""
        answers = [one.look_around(whole) for one, _ in self._sources.values()]
        return any(answers)

    def forget(self, now_s: float) -> None:
        """Take what waits to be read, and use nothing of it."""
        for instrument, _ in self._sources.values():
            instrument.channel.read(now_s)

    def forget_clocks(self) -> None:
        """Date what comes anew: our clock has run on without those of the instruments."""
        for instrument, _ in self._sources.values():
            instrument.clock = SourceClock()

    def document(self) -> dict[str, dict[str, object]]:
        """By place: messages understood, why others were not used, datagrams of others, and (null: not told)
        the figure of merit [m/s] of the last valid velocity."""
        return {
            str(place): {
                "heard": one.heard, "refused": dict(one.refused), "strange": one.channel.strange,
                "fom_m_s": one.fom_m_s,
            }
            for place, (one, _) in self._sources.items()
        }  # fmt: skip

    def close(self) -> None:
        """Give every place back."""
        for instrument, _ in self._sources.values():
            instrument.close()

    def __exit__(self, *_: object) -> None:
        self.close()


def _opened(place: InstrumentPlace, config: Config) -> Instrument:
    dvl, sonar = config.sensors.dvl, config.sensors.sonar
    if place.kind == "a50":
        channel = TcpChannel(place.host, place.port)
        return a50.A50(channel, radians(dvl.yaw_deg), dvl.fom_most_m_s, dvl.latency_s)
    if place.kind == "ping360":
        is_serial = place.host.startswith("/")
        channel = SerialChannel(place.host, ping.BAUD) if is_serial else UdpChannel(place, True, 2048)
        return ping.Ping360(channel, sonar, sonar.zero_gradian, sonar.min_range_m, sonar.sound_m_s)
    if place.kind == "3d15":
        return rip2.Sonar3D(UdpChannel(place, False, rip2.LONGEST), config)
    return JsonUdp(UdpChannel(place, False, _LONGEST))


class JsonUdp(Instrument):
    """Anything else, by somebody else's driver: one JSON object a datagram.

    ``{"kind": "dvl", "age_s": 0.05, "vel_b": [0.3, 0.0, 0.0]}``: ``kind`` and the fields are those of
    ``vehicle/messages.py``, SI units, body axes x ahead, y left, z up; ``age_s`` [s] is how long ago it was
    measured (0 where it is left out).
    """

    def poll(self, now_s: float) -> list[SensorMessage]:
        found = []
        for data in self.channel.read(now_s):
            message = self._message(data, now_s)
            if message is not None:
                self.heard += 1
                found.append(message)
        return found

    def _message(self, data: bytes, now_s: float) -> SensorMessage | None:
        try:
            said: Any = parsed_json(data, "a datagram")
            kind = KINDS.get(said.pop("kind"))
            age_s = float(said.pop("age_s", 0.0))
            if kind is None or not 0.0 <= age_s <= _OLDEST_S:
                return self.refuse("no 'kind' of ours, or an 'age_s' that cannot be")
            wanted = {field.name for field in dataclasses.fields(kind)} - {"time_s"}
            required = wanted - {"first_beam"}
            if not required <= said.keys() <= wanted:
                return self.refuse(f"{kind.__name__}: wants {', '.join(sorted(required))}")
            given = as_fields(said)
        except (FileError, ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError):
            return self.refuse("no JSON object of numbers")
        return kind(now_s - age_s, **given)


def as_fields(said: Mapping[str, Any]) -> dict[str, Any]:
    """A message's fields as JSON has them. ValueError, TypeError, OverflowError."""
    arrays = {name: np.array(value, np.float64) for name, value in said.items()}
    return {name: a if a.ndim else float(a) for name, a in arrays.items()}
