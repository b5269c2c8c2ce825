"""Devices that are not there, from their specifications: what the simulator's vehicle senses, told as an A50,
a Ping360 or a 3D-15 tells it, or as the JSON of any other sonar."""

from __future__ import annotations

import contextlib
import json
import math
import re
import socket
import struct
from collections.abc import Callable, Iterable

import numpy as np

from uuvtai.config import Config, DepthConfig, SonarConfig
from uuvtai.vehicle.instruments import a50, ping, rip2
from uuvtai.vehicle.instruments.rig import JSON_PORT
from uuvtai.vehicle.mavlink import LinkError

Echo = Callable[[float], float]
"""[m] to what a beam meets at a bearing [rad] from ahead, counter-clockwise; infinite = nothing"""


class FakeA50:
    """A TCP server of lines. Readings are lost in bursts, as in recordings."""

    PERIOD_S = 0.116  # a report at 1.6 m, as recorded

    def __init__(
        self, host: str, port: int, seed: int = 0, lost: float = 0.086, burst_s: float = 0.15
    ) -> None:
        """``lost``: share of readings in bursts of a median ``burst_s``. OSError where the port is taken."""
        self._server = socket.create_server((host, port))
        self._server.setblocking(False)
        self.port: int = self._server.getsockname()[1]
        self._clients: list[socket.socket] = []
        self._rng, self._lost, self._burst_s = np.random.default_rng(seed), lost, burst_s
        self._due_s = self._lost_until_s = -math.inf

    def tell(self, now_s: float, vel_b: np.ndarray, altitude_m: float) -> None:
        """In every step: the velocity (3,) [m/s] in our body axes, told when it is due."""
        with contextlib.suppress(OSError):  # nobody calls
            client, _ = self._server.accept()
            client.setblocking(False)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # its time may run quicker than ours
            self._clients.append(client)
        if now_s < self._due_s:
            return
        self._due_s = now_s + self.PERIOD_S
        mean_s = self._burst_s / math.log(2.0)  # of an exponential time with this median
        if now_s >= self._lost_until_s and self._rng.random() < self._lost * self.PERIOD_S / mean_s:
            self._lost_until_s = now_s + self._rng.exponential(mean_s)
        is_valid = now_s >= self._lost_until_s
        self._send(self._line(now_s, vel_b if is_valid else np.zeros(3), altitude_m, is_valid))

    def _line(self, now_s: float, vel_b: np.ndarray, altitude_m: float, is_valid: bool) -> bytes:
        vx, vy, vz = (float(value) for value in vel_b * np.array([1.0, -1.0, -1.0]))
        beam = {"velocity": 0.0, "distance": altitude_m, "rssi": -35.0, "nsd": -95.0, "beam_valid": is_valid}
        sent_us = round(1e6 * now_s)
        said = {
            "time": 1e3 * self.PERIOD_S, "vx": vx, "vy": vy, "vz": vz, "fom": 0.001 if is_valid else 0.4,
            "covariance": (1e-6 * np.eye(3)).tolist(), "altitude": altitude_m if is_valid else -1.0,
            "transducers": [{"id": number, **beam} for number in range(4)], "velocity_valid": is_valid,
            "status": 0, "format": "json_v3.1", "type": "velocity",
            "time_of_validity": sent_us - 60_000, "time_of_transmission": sent_us,
        }  # fmt: skip
        return json.dumps(said).encode() + b"\r\n"

    def _send(self, line: bytes) -> None:
        for client in list(self._clients):
            try:
                client.send(line)
            except OSError:  # gone, or it never reads
                client.close()
                self._clients.remove(client)

    def close(self) -> None:
        for one in (self._server, *self._clients):
            one.close()


class FakePing360:
    """A head behind a UDP bridge: it answers 2601, and scans by itself after 2602."""

    def __init__(
        self, host: str, port: int, seed: int = 0, zero_gradian: int = 200, own: bool = True
    ) -> None:
        """``own``: the firmware knows 2602. OSError where the port is taken."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((host, port))
        self._socket.setblocking(False)
        self.port: int = self._socket.getsockname()[1]
        self._rng, self._zero, self._own = np.random.default_rng(seed), zero_gradian, own
        self._frames, self._client = ping.Frames(), ("", 0)
        self._scan: tuple[bytes, int, int, int] | None = None
        self._single: tuple[bytes, int] | None = None  # how to listen, and the angle that was asked for
        self._at, self._way, self._due_s = 0, 1, -math.inf

    def step(self, now_s: float, echo: Echo, sound_m_s: float = 1500.0) -> None:
        """In every step: take requests, answer what is due."""
        with contextlib.suppress(OSError):
            while True:
                data, self._client = self._socket.recvfrom(2048)
                for number, payload in self._frames.take(data):
                    self._take(number, payload, now_s)
        if self._single is not None and now_s >= self._due_s:
            self._answer(*self._single, echo, sound_m_s, False)
            self._single = None
        while self._scan is not None and now_s >= self._due_s:
            listening, first, count, step = self._scan
            self._answer(listening, (first + self._at) % 400, echo, sound_m_s, True)
            self._due_s = max(self._due_s + self._step_s(listening), now_s - 1.0)
            if count == 399:
                self._at = (self._at + step) % 400
            else:
                self._way = -1 if self._at + step > count else 1 if self._at <= 0 else self._way
                self._at += self._way * step

    @staticmethod
    def _step_s(listening: bytes) -> float:
        """[s] of a step as recorded: 33 ms at 2 m."""
        _, period, _, samples = struct.unpack("<HHHH", listening)
        return 0.030 + ping.TICK_S * period * samples

    def _take(self, number: int, payload: bytes, now_s: float) -> None:
        samples = {ping.TRANSDUCER: 10, ping.AUTO_TRANSMIT: 8}.get(number, 0)
        if samples and int.from_bytes(payload[samples : samples + 2], "little") > ping.MOST_SAMPLES:
            return
        if number == ping.TRANSDUCER and len(payload) == 14:
            (angle,) = struct.unpack_from("<H", payload, 2)
            self._scan, self._single = None, (payload[4:12], angle)
            self._due_s = now_s + self._step_s(payload[4:12])
        elif number == ping.AUTO_TRANSMIT and len(payload) == 16 and self._own:
            first, last = struct.unpack_from("<HH", payload, 10)
            self._scan = payload[2:10], first, (last - first) % 400, payload[14]
            self._single, self._at, self._way, self._due_s = None, 0, 1, now_s
        elif number == ping.MOTOR_OFF:
            self._scan = None

    def _answer(self, listening: bytes, angle: int, echo: Echo, sound_m_s: float, is_own: bool) -> None:
        pulse, period, frequency, samples = struct.unpack("<HHHH", listening)
        bearing = -math.radians(0.9 * ((angle - self._zero + 200) % 400 - 200))
        profile = self.profile(echo(bearing), 0.5 * ping.TICK_S * period * sound_m_s, samples)
        head = struct.pack("<BBHHHH", 1, 1, angle, pulse, period, frequency)
        about = struct.pack("<HHBB", 0, 399, 1, 0) if is_own else b""
        counts = struct.pack("<HH", samples, samples)
        number = ping.AUTO_DEVICE_DATA if is_own else ping.DEVICE_DATA
        with contextlib.suppress(OSError):
            self._socket.sendto(ping.frame(number, head + about + counts + profile, source=2), self._client)

    def profile(self, range_m: float, bin_m: float, samples: int) -> bytes:
        """Ring-down to 0.19 m, noise, and an echo."""
        at = (np.arange(samples) + 0.5) * bin_m
        level = 255.0 * np.exp(-np.maximum(at - 0.03, 0.0) / self._rng.uniform(0.05, 0.08))
        level += self._rng.rayleigh(6.0, samples)
        if math.isfinite(range_m):
            level += 140.0 * np.exp(-0.5 * ((at - range_m) / 0.015) ** 2)
        return np.clip(level, 0, 255).astype(np.uint8).tobytes()

    def close(self) -> None:
        self._socket.close()


class FakeSonar3D:
    """Sends what the simulated camera sees to a port of this computer; a real one sends to a multicast
    group."""

    SHAPE, VIEW_DEG, RANGE_M, PERIOD_S = (64, 256), (90.0, 40.0), 15.0, 0.2

    def __init__(self, host: str, port: int, depth_cfg: DepthConfig) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._to, self._due_s = (host, port), -math.inf
        rows, columns = self.SHAPE
        wide, high = (math.radians(view) for view in self.VIEW_DEG)
        left = np.linspace(0.5 * wide, -0.5 * wide, columns)
        up = np.linspace(-0.5 * high, 0.5 * high, rows)[:, None]
        reach = math.tan(0.5 * math.radians(depth_cfg.fov_deg))
        y, z = np.tan(left), np.tan(up) / np.cos(left)
        self._column = np.rint((0.5 - 0.5 * y / reach) * depth_cfg.cols - 0.5).astype(int)
        self._row = np.rint(0.5 * depth_cfg.rows - 0.5 * depth_cfg.cols * z / reach - 0.5).astype(int)
        self._per_depth = np.sqrt(1.0 + y * y + z * z)

    def tell(self, now_s: float, depth_m: np.ndarray) -> None:
        """A depth image (rows, columns) that was taken just now, told when it is due."""
        if now_s < self._due_s:
            return
        self._due_s = now_s + self.PERIOD_S - 1e-6
        range_m = depth_m[self._row, self._column] * self._per_depth
        view = math.radians(self.VIEW_DEG[0]), math.radians(self.VIEW_DEG[1])
        met = np.where(range_m < self.RANGE_M - 1e-3, range_m, 0.0)
        with contextlib.suppress(OSError):  # nobody listens
            self._socket.sendto(rip2.packet_of(rip2.RangeImage(now_s, met, view, self.RANGE_M)), self._to)

    def close(self) -> None:
        self._socket.close()


class FakeJson:
    """A sonar that is told as JSON (``rig.JsonUdp``), without errors of its own."""

    def __init__(self, host: str, port: int) -> None:
        self._socket, self._to = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), (host, port)

    def tell(self, range_m: np.ndarray, hit: np.ndarray) -> None:
        """A scan (n_ray,) that was taken just now."""
        ranges = np.round(range_m.astype(float), 3).tolist()
        said = {"kind": "sonar", "range_m": ranges, "hit": (hit > 0).astype(int).tolist(), "doppler_m_s": []}
        with contextlib.suppress(OSError):  # nobody listens
            self._socket.sendto(json.dumps(said).encode(), self._to)

    def close(self) -> None:
        self._socket.close()


KINDS = {"a50": a50.PORT, "ping360": ping.PORT, "3d15": rip2.PORT, "json": JSON_PORT, "autopilot": 14550}
"""what ``uuv sitl --as`` can be, and its usual port; 3d15, json and autopilot speak to it"""
RING = {
    "mechanical": False,
    "horizontal_aperture_deg": 360.0,
    "n_ray": 400,
    "doppler": False,
    "range_sigma_m": 0.0,
    "range_quantum_m": 0.0,
}
"""of a simulated sonar behind a Ping360: every step of the head at any moment, errors are the emulator's"""
CAMERA = {
    "rows": 136,
    "cols": 256,
    "fov_deg": 92.0,
    "max_range_m": 2 * FakeSonar3D.RANGE_M,
    "period_steps": 10,
    "sigma_m": 0.0,
    "sigma_slope": 0.0,
}
"""of a simulated camera behind a 3D-15: wider and higher than it sees"""
NEXT_PORT = 10  # from one instance's port to the next one's, as ArduPilot counts
_IS_PORT = re.compile("[0-9]{1,5}")


def ports_of(text: str) -> dict[str, int]:
    """'a50,ping360:9100' -> port by kind. Raises LinkError."""
    found = {}
    for word in text.split(","):
        kind, other, port = word.partition(":")
        found[kind] = KINDS.get(kind, 0) if not other else int(port) if _IS_PORT.fullmatch(port) else 0
    if not found.keys() <= KINDS.keys() or not all(0 < port < 65536 for port in found.values()):
        raise LinkError(f"--as {text}: give {' or '.join(KINDS)}, or several: --as a50,ping360:9100")
    return found


def emulated(config: Config, kinds: Iterable[str]) -> Config:
    """The config of the water behind these instruments."""
    changed = {}
    if "ping360" in kinds:
        changed["sonar"] = config.sensors.sonar.model_copy(update=RING)
    if "3d15" in kinds:
        changed["depth"] = config.sensors.depth.model_copy(update=CAMERA)
    return config.model_copy(update={"sensors": config.sensors.model_copy(update=changed)})


class FakeRig:
    """The instruments of one vehicle: ``step`` in every control step."""

    def __init__(self, config: Config, ports: dict[str, int], host: str, number: int) -> None:
        """``ports``: by kind; they count on with the ``number`` of the vehicle. Raises LinkError."""
        self._sonar, dvl = config.sensors.sonar, config.sensors.dvl
        self.speaks = {"dvl" if kind == "a50" else "sonar" for kind in ports if kind != "autopilot"}
        """what MAVLink need not tell"""
        self._lever, self._yaw = np.array(dvl.position_b_m), math.radians(dvl.yaw_deg)
        self._dvl: FakeA50 | None = None
        self._head: FakePing360 | None = None
        self._image: FakeSonar3D | None = None
        self._scan: FakeJson | None = None
        port, next_port = 0, NEXT_PORT * number
        try:
            if "a50" in ports:
                self._dvl = FakeA50(host, port := ports["a50"] + next_port, number)
            if "ping360" in ports:
                zero = round(self._sonar.zero_gradian)
                self._head = FakePing360(host, port := ports["ping360"] + next_port, number, zero)
            if "3d15" in ports:
                self._image = FakeSonar3D(host, ports["3d15"] + next_port, config.sensors.depth)
            if "json" in ports:
                self._scan = FakeJson(host, ports["json"] + next_port)
        except OSError as error:
            self.close()
            raise LinkError(
                f"--as: cannot listen at port {port} ({error.strerror or error}); another uuv sitl may run: "
                "--as KIND:PORT takes another"
            ) from None

    def step(self, time_s: float, altitude_m: float, value: Callable[[str], np.ndarray]) -> None:
        """``value`` gives arrays of the vehicle by 'struct.field'."""
        if self._dvl is not None:
            moved = value("ego.dvl_b") + np.cross(value("ego.rate_b"), self._lever)
            cos, sin = math.cos(self._yaw), math.sin(self._yaw)
            there = np.array([cos * moved[0] + sin * moved[1], cos * moved[1] - sin * moved[0], moved[2]])
            self._dvl.tell(time_s, there, altitude_m)
        if self._head is not None:
            range_m, hit = value("scan.range_m"), value("scan.hit")
            self._head.step(time_s, lambda bearing: _met(self._sonar, range_m, hit, bearing))
        if self._image is not None and value("image.fresh"):
            self._image.tell(time_s, value("image.depth_m"))
        if self._scan is not None and value("scan.fresh"):
            self._scan.tell(*(value(f"scan.{name}")[: self._sonar.n_ray] for name in ("range_m", "hit")))

    def close(self) -> None:
        for one in (self._dvl, self._head, self._image, self._scan):
            if one is not None:
                one.close()


def _met(sonar_cfg: SonarConfig, range_m: np.ndarray, hit: np.ndarray, bearing: float) -> float:
    """The nearest that a beam as wide as the head's meets."""
    step, half = math.degrees(sonar_cfg.beam_step_rad), 0.5 * sonar_cfg.beam_width_deg
    middle, reach = round(math.degrees(bearing) / step), int(half / step + 1e-6)
    beams = np.arange(middle - reach, middle + reach + 1) % sonar_cfg.n_ray
    return float(np.where(hit[beams], range_m[beams], math.inf).min())
