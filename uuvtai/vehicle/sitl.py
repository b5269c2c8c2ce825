"""``uuv sitl``: sockets between ArduSubs and their water, and the operator of a simulated vehicle."""

from __future__ import annotations

import math
import selectors
import socket
import struct
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch

from uuvtai.common import signals
from uuvtai.common.enums import OUTCOMES, RUNNING
from uuvtai.config import Config
from uuvtai.config.base import folded_seed
from uuvtai.kernels.task import episode
from uuvtai.kernels.vehicle import control, dynamics
from uuvtai.kernels.world import scenario
from uuvtai.sim.behavior_tree import FlatTree
from uuvtai.sim.sim import Sim
from uuvtai.sim.stack import forget_readings
from uuvtai.vehicle.instruments.emulate import NEXT_PORT, FakeRig, emulated, ports_of
from uuvtai.vehicle.mavlink import Address, Endpoint, LinkError, LinkPlace, MavCodec, Order, place_of
from uuvtai.vehicle.messages import three
from uuvtai.vehicle.sitl_protocol import Motion, ReportedSensors, reply_of
from uuvtai.vehicle.stand_in import StandIn
from uuvtai.vehicle.telemetry import Motors

# ---- One ArduSub's water: a packet in, an answer out, and what the sensors say meanwhile. No sockets here. A
# packet (ArduPilot, libraries/SITL/SIM_JSON.h), little endian: magic, frame rate [Hz], frame count, then the
# pulse widths [us] of 16 channels, or of 32.

_HEAD = struct.Struct("<HHI")
_CHANNELS = {18458: 16, 29569: 32}  # magic -> channels
RATES_HZ = (50, 4000)  # physics steps in a second that are believed; ArduSub has told 16959 after a stall
DOUBLED_S = 0.5  # ArduSub repeats a packet after a second without answer; sooner it was doubled

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
    if channels == 0 or len(packet) != _HEAD.size + 2 * channels:
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


class Instance:
    """Until a thruster turns for the first time the vehicle is held at its start and the obstacles stand
    still: an autopilot needs half a minute to get ready, and an episode begins when it is driven."""

    def __init__(self, config: Config, water: WaterRows, row: int, rig: FakeRig | None = None) -> None:
        """``rig``: its DVL and sonar, where they speak their own protocols."""
        self._config, self._water, self._row, self._rig = config, water, row, rig
        self._dt, self.thrusters = config.episode.control_dt_s, len(config.vehicle.thrusters)
        self._count: int | None = None
        self._answered_s, self._answer, self._rate_hz = 0.0, b"", 0
        self._forget()
        self.counts: Counter[str] = Counter()  # by turn, and 'bad' packets
        self.time_s = 0.0  # since the episode's or ArduSub's beginning
        self.outcome, self._ended_s = "", 0.0
        self.joined_late = False
        """whether a thruster turned in the first packet: ArduSub drove in another water"""

    def _forget(self) -> None:
        self.time_s = self.driven_s = 0.0
        self.is_held, self._ticks, self.outcome = True, 0, ""
        self._sensors = ReportedSensors(self._config, self._rig.speaks if self._rig else ())

    def answer(self, packet: bytes, now_s: float) -> tuple[bytes, list[Order]]:
        """(what to send back, empty = nothing; what the sensors say) to a packet that came at ``now_s``."""
        frame = frame_of(packet)
        if frame is not None and RATES_HZ[0] <= frame.rate_hz <= RATES_HZ[1]:
            self._rate_hz = frame.rate_hz
        if frame is None or not self._rate_hz:
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
            said = self._step(frame.pwm, 1.0 / self._rate_hz)
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
            said += self._sensors.report(self.time_s, altitude, self._value)
            if self._rig is not None:
                self._rig.step(self.time_s, altitude, self._value)
        return said

    def _value(self, name: str) -> np.ndarray:
        return self._water.value(name, self._row)

    @property
    def lingered_s(self) -> float:
        """of the water's time, since the episode ended; 0 = it has not"""
        return self.time_s - self._ended_s if self.outcome else 0.0

    def document(self) -> dict[str, Any]:
        return {
            "row": self._row,
            "seconds": round(self.time_s, 3),
            "driven_s": round(self.driven_s, 3),
            "outcome": self.outcome or ("waiting" if self.is_held else "running"),
            "packets": {name: self.counts[name] for name in ("step", "reset", "again", "ignore", "bad")},
        }


# ---- Rows of a simulator that move one at a time, each at the pace of the ArduSub that drives it.


class WaterRows:
    """The vehicles of several instances. Row i runs episode ``first + i`` of ``seed``."""

    def __init__(self, sim: Sim, seed: int, first: int, has_camera: bool = False) -> None:
        """``has_camera``: depth images are sensed too. SettingError for a vehicle that is none of ArduSub's
        frames."""
        self.config, self.motors = sim.config, Motors(sim.config.vehicle)
        self._sim, self._seed, self._first, self._has_camera = sim, seed, first, has_camera
        self._dt_s = 0.0
        """one object for as long as it stays: kernels are launched again by the identity of what they take"""
        memory = self._sim.memory()
        views = memory.views(memory.read(), scratch=True)
        self._active, self._running = views["clock.active"], views["clock.running"]
        self._rpm = views["actuation.rpm_command"]
        names = ("pos_w", "vel_b", "quat_wb", "rate_b", "acc_b")
        self._vehicle = {name: views[f"vehicle.{name}"] for name in names}
        self._read = views
        self._sim.sleep()

    def warm(self) -> None:
        """Have all kernels compiled before anybody waits for an answer."""
        self.begin(0)
        self.push(0, (1500,) * 16, 1e-3)
        self.control_step(0)

    def begin(self, row: int) -> None:
        """The row's episode from its beginning: vehicle at rest at the start."""
        one, seeds, numbers = (torch.zeros(self._sim.num_envs, dtype=torch.int32) for _ in range(3))
        one[row], seeds[row], numbers[row] = 1, self._seed, self._first + row
        io = self._sim.io
        self._sim.draw(one, seeds, numbers)
        dynamics.reset_vehicle(io.dynamics)
        control.reset_actuation(io.actuation)
        forget_readings(io)
        episode.reset_termination(io.episode)
        self.sense(row)

    def push(self, row: int, pwm: tuple[int, ...], dt_s: float) -> None:
        """Move the vehicle by one step of ``dt_s`` with these pulses."""
        self._wake(row)
        rpm = self.motors.rpm(pwm)
        self._rpm[row, : len(rpm)] = rpm
        if dt_s != self._dt_s:
            self._dt_s = dt_s
        dynamics.move_vehicle(self._sim.io.dynamics, self._dt_s, 1)

    def control_step(self, row: int) -> str:
        """The world moves on by a control step and the termination check looks; how the episode stands."""
        self._wake(row)
        io = self._sim.io
        episode.advance_clock(io.episode)
        scenario.move_obstacles(io.world)
        episode.check_termination(io.episode)
        outcome = int(self._read["termination.outcome"][row])
        return "" if outcome == RUNNING else OUTCOMES[outcome]

    def sense(self, row: int) -> None:
        """Instruments and sonar by the simulator's own kernels, with errors as configured."""
        self._wake(row)
        self._sim.sensors.sense_motion(self._sim.io)
        self._sim.sensors.sense_sonar(self._sim.io)
        if self._has_camera:
            self._sim.sensors.sense_depth(self._sim.io)

    def motion(self, row: int, time_s: float) -> Motion:
        """By an x axis that looks north, whatever the tank's heading."""
        w, x, y, z = self._vehicle["quat_wb"][row].astype(float)
        half = math.radians(self.config.world.tank.heading_deg or 0.0) / 2
        c, s = math.cos(half), math.sin(half)
        quat = (c * w + s * z, c * x + s * y, c * y - s * x, c * z - s * w)
        rotation, turned = _rotation(quat), _rotation((c, 0.0, 0.0, -s))
        gravity = self.config.vehicle.gravity_m_s2
        place = self._vehicle["pos_w"][row].astype(float)
        return Motion(
            time_s,
            three(turned @ place),
            three(rotation @ self._vehicle["vel_b"][row]),
            quat,
            three(self._vehicle["rate_b"][row]),
            three(self._vehicle["acc_b"][row] + gravity * rotation[2]),
            float(place[2]) - self.config.world.tank.z_m[0],
        )

    def turns(self, pwm: tuple[int, ...]) -> bool:
        """Whether any thruster is asked to turn."""
        return bool(np.any(self.motors.rpm(pwm)))

    def value(self, name: str, row: int) -> np.ndarray:
        return self._read[name][row].copy()

    def _wake(self, row: int) -> None:
        """This row alone takes part in what comes."""
        self._active[:], self._running[:] = 0, 0
        self._active[row] = self._running[row] = 1


def _rotation(quat: tuple[float, float, float, float]) -> np.ndarray:
    w, x, y, z = quat
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


# ---- What ``uuv sitl`` says while it serves: who speaks, who does not, what begins and ends. Pure.

SILENT_S = 10.0  # by the clock, without a packet


class ServingNotes:
    """Of one instance. ``look`` is called often."""

    def __init__(self, number: int, port: int, now_s: float, stands_in: bool = False) -> None:
        """``stands_in``: no packets come, its autopilot is our own."""
        self._name, self._port, self._stands_in = f"instance {number}", port, stands_in
        self._seen: Counter[str] = Counter()  # packets by turn, as they were told last
        self._heard_s, self._silence_told = now_s, False
        self._held, self._outcome = True, ""

    def look(self, instance: Instance, now_s: float) -> list[str]:
        packets = [] if self._stands_in else self._packets(instance, now_s)
        found = [*packets, *self._episode(instance)]
        if instance.counts["bad"] > 0 and self._seen["bad"] == 0:
            found.append(
                f"{self._name}: what comes to port {self._port} is no packet of ArduSub's, or a second "
                "ArduSub's: does it run with --model JSON, and -I counting from 0?"
            )
        self._seen = instance.counts.copy()
        return found

    def _packets(self, instance: Instance, now_s: float) -> list[str]:
        counts = instance.counts
        packets, before = (
            sum(each[name] for name in ("step", "reset", "again", "ignore")) for each in (counts, self._seen)
        )
        if packets > before:
            found = [f"{self._name}: ArduSub speaks"] if self._silence_told or not before else []
            self._heard_s, self._silence_told = now_s, False
            if counts["reset"] > max(1, self._seen["reset"]):
                found.append(f"{self._name}: ArduSub has begun anew, so has the episode")
            if not before and instance.joined_late:
                found.append(
                    f"{self._name}: ArduSub is under way already, and takes itself for where it was: nobody "
                    "operates it; restart it, and the pilot"
                )
            return found
        if now_s - self._heard_s < SILENT_S or self._silence_told:
            return []
        self._silence_told = True
        if packets == 0:
            return [
                f"{self._name}: nothing of ArduSub's has come to UDP port {self._port} yet: start it with "
                "--model JSON:127.0.0.1, or give its port: --port"
            ]
        return [f"{self._name}: ArduSub has been silent for {SILENT_S:g} s; the physics waits"]

    def _episode(self, instance: Instance) -> list[str]:
        found = []
        if self._held and not instance.is_held:
            found.append(f"{self._name}: a thruster turns, the episode begins")
        if instance.outcome and not self._outcome:
            found.append(f"{self._name}: {instance.outcome} after {instance.driven_s:.1f} s")
        self._held, self._outcome = instance.is_held, instance.outcome
        return found


SENSORS = 197  # MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
_LONGEST = 128  # [bytes] a longer packet is none of ArduSub's
_SILENT_S = 2.0  # who has been silent for so long may be followed by somebody else
LINGER_S = 10.0  # of the water's time, that it stays with ``once`` after the end: for the pilot to notice
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
    places: tuple[LinkPlace, ...] = ()  # of the sensors' MAVLink; ports count on with the instances
    rate: float = 0.0  # seconds of the water in one of the clock's, at most; 0 = as ArduSub asks
    seconds: float = math.inf
    once: bool = False  # end when every instance's episode has ended
    seed: int = 0
    episode: int = 0
    operator: bool = False  # be the ground station too
    emulated: dict[str, int] = field(default_factory=dict)
    """ports of the instruments in place of MAVLink's DVL and sonar, by kind"""

    @classmethod
    def typed(
        cls, mavlink: Sequence[str] | None, seconds: float | None, emulated: str | None = None, **rest: Any
    ) -> SitlPlan:
        """Of what was typed; ``rest``: as it is. Raises LinkError."""
        own = {} if emulated is None else ports_of(emulated)
        until_s = math.inf if seconds is None else seconds
        if "autopilot" in own:  # it asks for no pace, and its own sensors speak to the pilot alone
            mavlink = mavlink or [f"udpout:{rest.get('host', cls.host)}:{own['autopilot']}"]
            rest["rate"] = rest.get("rate") or 1.0
        plan = cls(places=tuple(map(place_of, mavlink or PLACES)), seconds=until_s, emulated=own, **rest)
        port, instances = plan.port, plan.instances
        last = NEXT_PORT * (instances - 1)
        if not 1 <= instances <= _MOST_INSTANCES:
            raise LinkError(f"--instances {instances}: give 1 to {_MOST_INSTANCES}")
        if (highest := max(port, *own.values(), *(place.port for place in plan.places)) + last) > 65535:
            raise LinkError(
                f"--port {port}: with --instances {instances} the ports go up to {highest}, beyond 65535"
            )
        if (head := own.get("ping360")) and abs(port - head) in range(0, last + 1, NEXT_PORT):
            raise LinkError(
                f"--port {port}: with --instances {instances} an ArduSub has the port of a Ping360, from "
                f"{head} up; --port {port + 1}"
            )
        if seconds is not None and not 0 < seconds < math.inf:
            raise LinkError(f"--seconds {seconds:g}: give a number above 0, or leave it out")
        return plan


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
        self.paced_from_s = 0.0  # by the clock, when the water's time was 0
        port, pilot = plan.port + NEXT_PORT * number, plan.emulated.get("autopilot")
        self.notes = ServingNotes(number, port, time.monotonic(), pilot is not None)
        self.autopilot: StandIn | None = None  # in ArduSub's place
        try:
            if pilot is not None:
                at = plan.host, pilot + NEXT_PORT * number
                self.autopilot = StandIn(at, self._system, instance.thrusters)
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
        if reply := self._answer(packet, now_s):
            self._peer, self._heard_s = sender, now_s
            try:
                self.socket.sendto(reply, sender)
            except OSError:
                self.instance.counts["unsent"] += 1

    def drive(self, now_s: float) -> None:
        """A packet of the autopilot's that stands in, if there is one."""
        if self.autopilot is not None:
            self.autopilot.take(self._answer(self.autopilot.frame(), now_s))

    def _answer(self, packet: bytes, now_s: float) -> bytes:
        """What the physics says to a packet; the sensors tell what they sense."""
        reply, said = self.instance.answer(packet, now_s)
        if reply and self._operator is not None and not self.instance.joined_late:
            said = [*said, *self._operator.report(self.instance.time_s)]
        self._report(said)
        return reply

    def _report(self, said: list[Order]) -> None:
        for link in self.links if said else []:
            link.look()
        for order in said:
            data = self._codec.encode(order)
            self._codec.sent(order)
            for link in self.links:
                link.tell(data)

    def close(self) -> None:
        self.socket.close()
        for link in self.links:
            link.endpoint.close()
        if self.autopilot is not None:
            self.autopilot.close()


def serve_water(
    config: Config, tree: FlatTree, plan: SitlPlan, note: Callable[[str], None]
) -> dict[str, Any]:
    """Serve until Ctrl-C, ``seconds`` or ``once``; gives the ``--json``. Raises LinkError, SettingError."""
    config = emulated(config, plan.emulated)
    sim, has_camera = Sim(config, plan.instances, tree), "3d15" in plan.emulated
    water = WaterRows(sim, folded_seed(plan.seed), plan.episode, has_camera)
    ports: list[SitlPort] = []
    rigs: list[FakeRig] = []
    begun = time.monotonic()
    try:
        for number in range(plan.instances):
            if plan.emulated:
                rigs.append(FakeRig(config, plan.emulated, plan.host, number))
            instance = Instance(config, water, number, rigs[number] if rigs else None)
            ports.append(SitlPort(plan, instance, number))
        water.warm()
        begun = time.monotonic()
        signals.engage()  # there is a document to print
        shown = ", ".join(f"{plan.host}:{plan.port + NEXT_PORT * number}" for number in range(plan.instances))
        begin = f"physics for ArduSub at UDP {shown}; start it with: ardusub --model JSON:{plan.host}"
        if "autopilot" in plan.emulated:
            begin = "a small autopilot waits for uuv pilot"
        note(f"{begin}; Ctrl-C ends")
        for number in range(plan.instances):
            water.begin(number)
            start, goal = (_written(water.value(f"mission.{name}_w", number)) for name in ("start", "goal"))
            words = f"--start {start} --goal {goal} --heading {config.world.tank.heading_deg or 0.0:g}"
            note(f"instance {number}: uuv pilot needs {words}{_heard(plan, number)}")
        _serve(ports, plan, begun, note)
    except KeyboardInterrupt:
        note("interrupted")
    finally:
        for one in (*ports, *rigs):
            one.close()
    spent = time.monotonic() - begun
    instances = [port.instance.document() for port in ports]
    return {"schema": 1, "seconds": round(spent, 3), "instances": instances}


def _heard(plan: SitlPlan, number: int) -> str:
    """The pilot's options that hear the instruments of an instance, and its autopilot."""
    at = {kind: f"{plan.host}:{port + NEXT_PORT * number}" for kind, port in plan.emulated.items()}
    pilot = at.pop("autopilot", "")
    return (f" --mavlink udp:{pilot} --system {number + 1}" if pilot else "") + "".join(
        f" --{'dvl' if kind == 'a50' else 'sonar'} {kind}:{place}" for kind, place in at.items()
    )


def _written(place: np.ndarray) -> str:
    return ",".join(f"{value:.4f}" for value in place.tolist())


def _serve(ports: list[SitlPort], plan: SitlPlan, begun: float, note: Callable[[str], None]) -> None:
    driven = ports if "autopilot" in plan.emulated else []
    with selectors.DefaultSelector() as waiting:
        for port in ports if not driven else []:
            waiting.register(port.socket, selectors.EVENT_READ, port)
        while time.monotonic() - begun < plan.seconds:
            for port in driven or [key.data for key, _ in waiting.select(timeout=0.2)]:
                _pace(port, plan.rate)
                serve = port.drive if driven else port.serve
                serve(time.monotonic())
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
PLACE = (-353600000, 1491600000, 0)  # latitude, longitude [1e-7 degrees], altitude [mm] of the surface


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
