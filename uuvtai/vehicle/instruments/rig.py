"""The instruments that a pilot hears beside MAVLink, and what each may tell."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from math import radians

import numpy as np

from uuvtai.config import Config
from uuvtai.vehicle.instruments import a50, json_udp, ping, rip2
from uuvtai.vehicle.instruments.channel import (
    Instrument,
    InstrumentPlace,
    SerialChannel,
    TcpChannel,
    UdpChannel,
    place_of,
)
from uuvtai.vehicle.messages import NAMES, DvlReading, SensorMessage, is_believed

PORTS = {
    "dvl": {"a50": a50.PORT, "json": json_udp.PORT},
    "sonar": {"ping360": ping.PORT, "3d15": rip2.PORT, "json": json_udp.PORT},
}
"""what is given by which option: kind -> usual port"""
_TELLS = {"dvl": ("dvl",), "sonar": ("sonar", "depth")}


class Rig(AbstractContextManager["Rig"]):
    """Use as a context: what was opened is closed."""

    def __init__(self, config: Config, typed: Mapping[str, str]) -> None:
        """``typed``: place by option name. Raises LinkError, SettingError."""
        self.replaced = frozenset(typed)
        """kinds of messages that MAVLink's senders no longer tell"""
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
                elif message.vel_b.shape != (3,):
                    instrument.refuse("dvl: a velocity has three numbers")
                else:
                    moved = np.cross(rate_b, self._lever)
                    yield instrument, replace(message, vel_b=message.vel_b - moved)

    def document(self) -> dict[str, dict[str, object]]:
        """By place: messages understood, why others were not used, and datagrams of others."""
        return {
            str(place): {"heard": one.heard, "refused": dict(one.refused), "strange": one.channel.strange}
            for place, (one, _) in self._sources.items()
        }

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
    return json_udp.JsonUdp(UdpChannel(place, False, json_udp.LONGEST))
