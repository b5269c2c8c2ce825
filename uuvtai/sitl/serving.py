"""``uuv sitl``: sockets between ArduSubs and their water, and the operator of a simulated vehicle."""

from __future__ import annotations

import math
import selectors
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from uuvtai import signals
from uuvtai.config import Config
from uuvtai.config.section import folded_seed
from uuvtai.link.dialect import MavCodec
from uuvtai.link.endpoint import Address, Endpoint, LinkPlace, place_of
from uuvtai.link.link_errors import LinkError
from uuvtai.link.orders import Order
from uuvtai.sim import Sim
from uuvtai.sitl.instance import Instance
from uuvtai.sitl.rows_of_water import WaterRows
from uuvtai.sitl.serving_notes import ServingNotes
from uuvtai.tree import FlatTree

NEXT_PORT = 10
"""from one instance's port to the next one's, as ArduPilot counts"""
SENSORS = 197
"""MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY"""
_LONGEST = 128
"""[bytes] a longer packet is none of ArduSub's"""
_SILENT_S = 2.0
"""who has been silent for so long may be followed by somebody else"""
LINGER_S = 10.0
"""of the water's time, that it stays with ``once`` after the episode's end: for the pilot to notice"""
_MOST_PEERS = 4
_MOST_INSTANCES = 64
PLACES = ("udp:127.0.0.1:14660", "udpout:127.0.0.1:14550")
"""ArduSub's serial port of the sensors, which speaks first, and uuv pilot"""


@dataclass(frozen=True)
class SitlPlan:
    """What ``uuv sitl`` was told."""

    host: str = "127.0.0.1"
    port: int = 9002
    instances: int = 1
    places: tuple[LinkPlace, ...] = ()
    """of the sensors' MAVLink; ports count on with the instances"""
    rate: float = 0.0
    """seconds of the water in one of the clock's, at most; 0 = as ArduSub asks"""
    seconds: float = math.inf
    once: bool = False
    """end when every instance's episode has ended"""
    seed: int = 0
    episode: int = 0
    operator: bool = False
    """be the ground station too"""

    @classmethod
    def typed(
        cls,
        host: str,
        port: int,
        instances: int,
        mavlink: Sequence[str] | None,
        rate: float,
        seconds: float | None,
        once: bool,
        seed: int,
        episode: int,
    ) -> SitlPlan:
        """Of what was typed. Raises LinkError."""
        places = tuple(place_of(text) for text in mavlink or PLACES)
        last = NEXT_PORT * (instances - 1)
        if not 1 <= instances <= _MOST_INSTANCES:
            raise LinkError(f"--instances {instances}: give 1 to {_MOST_INSTANCES}")
        if (highest := max(port, *(place.port for place in places)) + last) > 65535:
            raise LinkError(
                f"--port {port}: with --instances {instances} the ports go up to {highest}, beyond 65535"
            )
        if seconds is not None and not 0 < seconds < math.inf:
            raise LinkError(f"--seconds {seconds:g}: give a number above 0, or leave it out")
        until_s = math.inf if seconds is None else seconds
        return cls(host, port, instances, places, rate, until_s, once, seed, episode)


@dataclass
class SensorLink:
    """Where one instance's sensors speak to."""

    endpoint: Endpoint
    peers: list[Address] = field(default_factory=list)

    def look(self) -> None:
        """Whoever spoke to us is told from now on; the oldest is forgotten where there are many."""
        for sender, _ in self.endpoint.receive():
            if sender not in self.peers:
                self.peers = [*self.peers, sender][-_MOST_PEERS:]

    def tell(self, data: bytes) -> None:
        """Say it to all."""
        for peer in self.peers if self.endpoint.calls is None else [self.endpoint.calls]:
            self.endpoint.send(data, peer)


class SitlPort:
    """One instance at its sockets. Use ``close``."""

    def __init__(self, plan: SitlPlan, instance: Instance, number: int) -> None:
        """Raises LinkError."""
        self.instance, self._system = instance, number + 1
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.links: list[SensorLink] = []
        self._codec = MavCodec(self._system, SENSORS)
        self._operator = SimulatedOperator(self._system) if plan.operator else None
        self._peer: Address | None = None
        self._heard_s = float("-inf")
        self.paced_from_s = 0.0
        """by the clock, when the water's time was 0"""
        port = plan.port + NEXT_PORT * number
        self.notes = ServingNotes(number, port, time.monotonic())
        try:
            self.socket.bind((plan.host, port))
            self.socket.setblocking(False)
            for place in plan.places:
                moved = LinkPlace(place.host, place.port + NEXT_PORT * number, place.calls)
                self.links.append(SensorLink(Endpoint(moved)))
        except OSError as error:
            self.close()
            raise LinkError(
                f"{plan.host}:{port}: cannot listen there ({error.strerror or error}); another "
                f"uuv sitl may run: --port {plan.port + 1000 if plan.port < 60000 else 9002}"
            ) from None
        except LinkError:
            self.close()
            raise

    def serve(self, now_s: float) -> None:
        """Answer the packet that waits, if any."""
        try:
            packet, sender = self.socket.recvfrom(_LONGEST)
        except OSError:
            return
        if self._peer not in (None, sender) and now_s - self._heard_s < _SILENT_S:
            self.instance.counts["bad"] += 1
            return
        reply, said = self.instance.answer(packet, now_s)
        if reply:
            self._peer, self._heard_s = sender, now_s
            try:
                self.socket.sendto(reply, sender)
            except OSError:
                self.instance.counts["unsent"] += 1
        if reply and self._operator is not None and not self.instance.joined_late:
            said = [*said, *self._operator.report(self.instance.time_s)]
        self._report(said)

    def _report(self, said: list[Order]) -> None:
        for link in self.links if said else []:
            link.look()
        for order in said:
            data = self._codec.encode(order)
            self._codec.sent(order)
            for link in self.links:
                link.tell(data)

    def close(self) -> None:
        """Let go of all ports."""
        self.socket.close()
        for link in self.links:
            link.endpoint.close()


def serve_water(
    config: Config, tree: FlatTree, plan: SitlPlan, note: Callable[[str], None]
) -> dict[str, Any]:
    """Serve until Ctrl-C, ``seconds`` or ``once``; the document of ``uuv sitl --json``. Raises LinkError,
    SettingError."""
    water = WaterRows(Sim(config, plan.instances, tree), folded_seed(plan.seed), plan.episode)
    ports: list[SitlPort] = []
    begun = time.monotonic()
    try:
        for number in range(plan.instances):
            ports.append(SitlPort(plan, Instance(config, water, number), number))
        water.warm()
        begun = time.monotonic()
        signals.engage()  # there is a document to print
        shown = ", ".join(f"{plan.host}:{plan.port + NEXT_PORT * number}" for number in range(plan.instances))
        note(
            f"water for ArduSub at UDP {shown}; start it with: ardusub --model JSON:{plan.host}; Ctrl-C ends"
        )
        for number in range(plan.instances):
            water.begin(number)
            start, goal = (_written(water.value(f"mission.{name}_w", number)) for name in ("start", "goal"))
            note(f"instance {number}: uuv pilot needs --start {start} --goal {goal} --heading 0")
        _serve(ports, plan, begun, note)
    except KeyboardInterrupt:
        note("interrupted")
    finally:
        for port in ports:
            port.close()
    spent = time.monotonic() - begun
    instances = [port.instance.document() for port in ports]
    return {"schema": 1, "seconds": round(spent, 3), "instances": instances}


def _written(place: np.ndarray) -> str:
    return ",".join(f"{value:.4f}" for value in place.tolist())


def _serve(ports: list[SitlPort], plan: SitlPlan, begun: float, note: Callable[[str], None]) -> None:
    with selectors.DefaultSelector() as waiting:
        for port in ports:
            waiting.register(port.socket, selectors.EVENT_READ, port)
        while time.monotonic() - begun < plan.seconds:
            for key, _ in waiting.select(timeout=0.2):
                port: SitlPort = key.data
                _pace(port, plan.rate)
                port.serve(time.monotonic())
            for port in ports:
                for text in port.notes.look(port.instance, time.monotonic()):
                    note(text)
            if plan.once and all(port.instance.lingered_s > LINGER_S for port in ports):
                return


def _pace(port: SitlPort, rate: float) -> None:
    """Wait until the water is no further than the clock times ``rate``."""
    if rate <= 0:
        return
    instance, now_s = port.instance, time.monotonic()
    ahead_s = instance.time_s / rate - (now_s - port.paced_from_s)
    if not -1.0 < ahead_s < 1.0:  # begun anew, or held up
        port.paced_from_s, ahead_s = now_s - instance.time_s / rate, 0.0
    if ahead_s > 0:
        time.sleep(ahead_s)


BEAT_S, PLACE_S, PLACED_S = 1.0, 0.25, 60.0
"""a heartbeat so often; the place so often, until so long after the beginning. ArduSub takes it once, as soon
as its filter is there: the heading that it aligns without a place lacks the magnetic declination"""
PLACE = (-353600000, 1491600000, 0)
"""latitude, longitude [1e-7 degrees], altitude [mm] of the surface"""


class SimulatedOperator:
    """One vehicle's: a heartbeat of a ground station, and where on earth the water is. ``report`` is called
    after every step of the water.

    Without a ground station the pilot's dead-man stops it, and ArduSub has no origin for what a DVL tells. It
    does not operate an ArduSub that drove in another water, for that is not where it takes itself to be.
    """

    def __init__(self, system: int) -> None:
        self._system = system
        self._beat_s = self._place_s = float("-inf")

    def report(self, time_s: float) -> list[Order]:
        """What it says at this time of the water's; a time that falls has begun anew."""
        if time_s < self._beat_s:
            self._beat_s = self._place_s = float("-inf")
        found = []
        if time_s - self._beat_s >= BEAT_S:
            self._beat_s = time_s
            fields = {"type": 6, "autopilot": 8, "base_mode": 0, "custom_mode": 0, "system_status": 4}
            found.append(Order("HEARTBEAT", "HEARTBEAT", {**fields, "mavlink_version": 3}, as_operator=True))
        if time_s - self._place_s >= PLACE_S and time_s <= PLACED_S:
            self._place_s = time_s
            names = ("latitude", "longitude", "altitude")
            where = {"target_system": self._system, **dict(zip(names, PLACE, strict=True))}
            found.append(Order("SET_GPS_GLOBAL_ORIGIN", "SET_GPS_GLOBAL_ORIGIN", where, as_operator=True))
        return found
