"""What comes by MAVLink, as messages of the pilot and as the state of vehicle and operator.

MAVLink: world north, east, down; body x ahead, y right, z down. Ours: world z up, x axis to the compass
heading given; body x ahead, y left, z up.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from uuvtai.common.clocks import SourceClock, stamp_of
from uuvtai.common.errors import SettingError
from uuvtai.config import Config, VehicleConfig
from uuvtai.config.sensors import SonarConfig
from uuvtai.sim.setup import allocation_matrices
from uuvtai.vehicle import onboard
from uuvtai.vehicle.mavlink import ARM_DISARM, DO_SET_MODE, LinkError

# ---- Distances by sectors, as MAVLink tells them, into the beams of the pilot's sonar_cfg.

UNKNOWN_CM = 65535  # of a sector that was not looked into (UINT16_MAX)
SECTORS = 72  # at most, in OBSTACLE_DISTANCE


def bearings_deg(sonar_cfg: SonarConfig) -> np.ndarray:
    """(n_ray,) of the beams, clockwise from ahead as MAVLink counts."""
    return -np.degrees(sonar_cfg.first_beam_rad + sonar_cfg.beam_step_rad * np.arange(sonar_cfg.n_ray))


def ping_of(
    sonar_cfg: SonarConfig,
    time_s: float,
    distances_cm: np.ndarray,
    increment_deg: float,
    offset_deg: float,
    min_cm: float,
    max_cm: float,
) -> onboard.SonarPing | str:
    """A scan in which each beam has the range of the sector that it lies in, or why there is none.

    The pilot takes a beam without a return for free water as far as the sonar sees, so a sector that nobody
    looked into, or a sensor that sees less far than the config says, would be a lie. By MAVLink 0 is a touch,
    ``max_cm`` + 1 free water; what else lies outside ``min_cm`` to ``max_cm`` tells nothing.
    """
    if not (np.isfinite(increment_deg) and 0.1 <= abs(increment_deg) <= 90.0 and np.isfinite(offset_deg)):
        return f"sectors of {increment_deg:g} degrees from {offset_deg:g} on make no sense"
    if max_cm < 100.0 * sonar_cfg.max_range_m - 1.0:
        return (
            f"the sensor sees {max_cm / 100:g} m far, the config says {sonar_cfg.max_range_m:g}: "
            f"--set sensors.sonar.max_range_m={max_cm / 100:g}"
        )
    turn = (bearings_deg(sonar_cfg) - offset_deg) / increment_deg
    index = np.rint(np.mod(turn + 0.5, 360.0 / abs(increment_deg)) - 0.5).astype(int)
    heard = (index >= 0) & (index < len(distances_cm))
    distance = np.where(heard, distances_cm[np.clip(index, 0, len(distances_cm) - 1)], UNKNOWN_CM)
    if (distance == UNKNOWN_CM).any():
        return "beams lie in sectors that nobody looked into"
    if (((distance != 0) & (distance < min_cm)) | (distance > max_cm + 1)).any():
        return "distances outside of what the sensor says that it measures"
    return onboard.SonarPing(time_s, distance / 100.0, (distance <= max_cm).astype(float), np.zeros(0))


def sectors_of(
    sonar_cfg: SonarConfig, range_m: np.ndarray, hit: np.ndarray
) -> tuple[list[int], float, float]:
    """(distances [cm], increment, offset [deg]) of a scan: the nearest return in each sector. The sectors
    share the sonar's aperture; one without a return reads a centimetre beyond the range."""
    increment = (360.0 if sonar_cfg.is_ring else sonar_cfg.horizontal_aperture_deg) / SECTORS
    offset = 0.0 if sonar_cfg.is_ring else -0.5 * sonar_cfg.horizontal_aperture_deg + 0.5 * increment
    turn = (bearings_deg(sonar_cfg) - offset) / increment
    index = np.rint(np.mod(turn + 0.5, 360.0 / increment) - 0.5).astype(int)
    free = round(100.0 * sonar_cfg.max_range_m) + 1
    read = np.where(hit > 0, np.clip(np.rint(100.0 * range_m), 1, free - 1), free).astype(int)
    found = np.full(SECTORS, free)
    np.minimum.at(found, np.clip(index, 0, SECTORS - 1), read)
    empty = np.setdiff1d(np.arange(SECTORS), index)
    found[empty] = found[(empty + 1) % SECTORS]
    return found.tolist(), increment, offset


class Rangers:
    """Eight rangefinders around the hull make a ring of eight sectors, told when the one ahead speaks."""

    _TOGETHER_S = 1.0
    _INVALID = 1  # signal_quality: no return that counts

    def __init__(self) -> None:
        self._rows: dict[int, tuple[float, int, int]] = {}

    def ring(self, fields: Mapping[str, Any], time_s: float) -> tuple[np.ndarray, int] | None:
        """(8,) [cm] clockwise from ahead, and how far they see, if known. ``fields``: DISTANCE_SENSOR."""
        turn = int(fields["orientation"])
        if not 0 <= turn < 8:
            return None
        read, reach = int(fields["current_distance"]), int(fields["max_distance"])
        is_blind = int(fields.get("signal_quality", 0)) == self._INVALID or read == UNKNOWN_CM
        if is_blind or read < int(fields.get("min_distance", 0)):
            read = UNKNOWN_CM
        elif read >= reach:
            read = reach + 1
        self._rows[turn] = time_s, read, reach
        if turn != 0:
            return None
        recent = {at: row for at, row in self._rows.items() if abs(time_s - row[0]) <= self._TOGETHER_S}
        distances = np.array([recent[at][1] if at in recent else UNKNOWN_CM for at in range(8)])
        least = min(row[2] for row in recent.values())
        return np.where((distances > least) & (distances < UNKNOWN_CM), least + 1, distances), least


# ---- From ArduSub's channels to our thrusters: which is which, by geometry, and how fast a pulse turns one.

NEUTRAL_US, SPAN_US = 1500.0, 400.0
_SPEED_OF_PULSE = np.array(
    [
        (-400, -3465), (-360, -3282), (-320, -3003), (-280, -2736), (-240, -2440), (-200, -2140),
        (-160, -1807), (-120, -1448), (-80, -1016), (-40, -450), (-32, -317), (-28, 0), (28, 0), (32, 308),
        (40, 441), (80, 1007), (120, 1444), (160, 1802), (200, 2129), (240, 2446), (280, 2735), (320, 3042),
        (360, 3308), (400, 3533),
    ],
    float,
)  # fmt: skip
"""[us beyond neutral, rpm] of a T200 at 16 V (the maker's table, docs/data/t200.csv)"""
_LEVEL = ((0, 0, 1, 0, -1, 1), (0, 0, -1, 0, -1, -1), (0, 0, -1, 0, 1, 1), (0, 0, 1, 0, 1, -1))
FRAMES = {
    6: (*_LEVEL, (1, 0, 0, -1, 0, 0), (-1, 0, 0, -1, 0, 0)),
    8: (*_LEVEL, (1, -1, 0, -1, 0, 0), (-1, -1, 0, -1, 0, 0), (1, 1, 0, -1, 0, 0), (-1, 1, 0, -1, 0, 0)),
}
"""thrusters -> what each motor gives to roll, pitch, yaw, throttle, forward, lateral in ArduSub's frames
VECTORED and VECTORED_6DOF (ArduPilot, AP_Motors6DOF.cpp): body x ahead, y right, z down, throttle up"""


class Motors:
    """The thrusters of one vehicle as ArduSub knows them."""

    def __init__(self, vehicle_cfg: VehicleConfig) -> None:
        """SettingError for a frame that ArduSub's two are not."""
        force_moment, _ = allocation_matrices(vehicle_cfg)
        signs = np.array([1.0, -1.0, -1.0, 1.0, 1.0, -1.0])
        ours = force_moment[[3, 4, 5, 2, 0, 1]].T * signs  # in ArduSub's axes and order
        frame = FRAMES.get(len(ours))
        if frame is None:
            raise SettingError(
                f"the vehicle has {len(ours)} thrusters; ArduSub's frames here have 6 (VECTORED) or 8 "
                "(VECTORED_6DOF): --vehicle bluerov2_16v"
            )
        self.channel, self.sign = np.full(len(ours), -1), np.zeros(len(ours))
        for motor, factors in enumerate(np.array(frame, float)):
            thruster, sign = _same(ours, factors)
            self.channel[thruster], self.sign[thruster] = motor, sign
        if (self.channel < 0).any():
            raise SettingError(
                "the thrusters do not sit as in ArduSub's frames VECTORED or VECTORED_6DOF: "
                "--vehicle bluerov2_16v"
            )
        self._scale = vehicle_cfg.top_rpm / -_SPEED_OF_PULSE[0, 1]
        self.most_rpm = vehicle_cfg.top_rpm

    def rpm(self, pwm: Sequence[float]) -> np.ndarray:
        """(thrusters,) speed that is commanded. A channel that is off (0) stands still."""
        pulse = np.array(pwm, float)[self.channel]
        off = np.clip(pulse - NEUTRAL_US, -SPAN_US, SPAN_US)
        share = np.where(pulse == 0, 0.0, np.interp(off, _SPEED_OF_PULSE[:, 0], _SPEED_OF_PULSE[:, 1]))
        return np.clip(self.sign * self._scale * share, -self.most_rpm, self.most_rpm)


def _same(ours: np.ndarray, factors: np.ndarray) -> tuple[int, float]:
    """(thruster, sign) that gives what a motor's factors say, up to the sign; (0, 0) = none."""
    used = factors != 0
    is_upright = factors[3] != 0
    for thruster, given in enumerate(ours):
        if (abs(given[3]) > 0.7) != is_upright:
            continue
        for sign in (1.0, -1.0):
            if (np.sign(np.round(sign * given[used], 6)) == np.sign(factors[used])).all():
                return thruster, sign
    return 0, 0.0


# ---- From whom each kind of message counts: what an autopilot says of itself from the autopilot alone, a DVL
# and a sonar from whom they are known to come.

AUTOPILOT = 1  # MAV_COMP_ID_AUTOPILOT1
_VELOCITIES = ("VISION_POSITION_DELTA", "VISION_SPEED_ESTIMATE")
_PLACES = ("VISION_POSITION_ESTIMATE", "GLOBAL_VISION_POSITION_ESTIMATE")
KINDS = {
    "attitude": ("ATTITUDE",),
    "imu": ("SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3", "RAW_IMU", "HIGHRES_IMU"),
    "pressure": ("SCALED_PRESSURE", "SCALED_PRESSURE2", "SCALED_PRESSURE3"),
    "position": ("LOCAL_POSITION_NED",),
    "battery": ("SYS_STATUS", "BATTERY_STATUS"),
    "dvl": (*_VELOCITIES, *_PLACES),
    "sonar": ("OBSTACLE_DISTANCE", "DISTANCE_SENSOR"),
}
KIND_OF = {name: kind for kind, names in KINDS.items() for name in names}
BLUEOS = (255, 0)  # as whom extensions of BlueOS speak, its DVL's among them (mavlink2rest)
_OF_OTHERS = ("dvl", "sonar")
_WRITTEN = re.compile(r"([a-z]+)=(\d{1,3})/(\d{1,3}|\*)")

Sender = tuple[int, int | None]  # system and component; None = any component


@dataclass(frozen=True)
class Senders:
    """Of one vehicle."""

    system: int = 1
    given: Mapping[str, tuple[Sender, ...]] = field(default_factory=dict)
    """kind -> those that count in place of the usual ones"""

    @classmethod
    def typed(cls, texts: Sequence[str], system: int) -> Senders:
        """Of ``KIND=SYSTEM/COMPONENT``, each once or more. Raises LinkError."""
        given: dict[str, tuple[Sender, ...]] = {}
        for text in texts:
            found = _WRITTEN.fullmatch(text)
            numbers = [int(part) for part in found.groups()[1:] if part != "*"] if found else []
            if found is None or found[1] not in KINDS or max(numbers) > 255:
                raise LinkError(
                    f"--sender {text!r}: write KIND=SYSTEM/COMPONENT, for example --sender dvl=255/0; KIND "
                    f"is one of {', '.join(KINDS)}, numbers go to 255, COMPONENT may be *"
                )
            sender = numbers[0], None if found[3] == "*" else numbers[1]
            given[found[1]] = (*given.get(found[1], ()), sender)
        return cls(system, given)

    def counts(self, name: str, system: int, component: int) -> bool:
        """Whether a message of this name counts from there; one of no kind as what the autopilot says."""
        kind = KIND_OF.get(name, "")
        usual = ((self.system, None), BLUEOS) if kind in _OF_OTHERS else ((self.system, AUTOPILOT),)
        usual = (BLUEOS,) if name == "VISION_SPEED_ESTIMATE" else usual  # others mean north, east, down
        return any(system == known and one in (None, component) for known, one in self.given.get(kind, usual))


SUBMARINE, ARDUPILOT, GROUND_STATION = 12, 3, 6
_ARMED = 128
COMPANION = 191  # MAV_COMP_ID_ONBOARD_COMPUTER: what we are
_STICK_MOVED = 200  # of 1000
MOST_KINDS = 64  # senders of a kind of message that are told apart, and reasons why messages are left out
_DEPTH_PART, _DEPTH_OFF_M = 0.2, 0.3  # corrected of a depth's error; more: the reading is taken (EC)
_FRESH_S = 1.0  # a source that was heard within this time is preferred to a lesser one
_BATTERY_S = 10.0  # of two tellers of a voltage the lower one counts, while it is heard so often
_MOST_NAMED = 4
JUMP_M, _MOST_SPEED_M_S = 0.5, 2.0  # a position that moves further, and faster than any vehicle, has jumped
_PASCAL, _MILLI_G = 100.0, 9.80665e-3

Fields = Mapping[str, Any]


@dataclass
class Heard:
    """Who was heard last, and what they said. Times by the pilot's clock, minus infinity = never."""

    vehicle_s: float = -math.inf
    operator_s: float = -math.inf
    mode: int = -1
    is_armed: bool = False
    battery_v: float | None = None
    battery_share: float | None = None
    battery_s: float = -math.inf  # when a voltage or a charge came last
    rpy: tuple[float, float, float] = (math.nan, math.nan, math.nan)  # of the newest attitude, our world axes
    rpy_s: float = -math.inf  # when it was measured
    vel_b: tuple[float, float, float] | None = None
    vel_b_s: float = -math.inf
    yaw_rate: float = 0.0
    yaw_rate_s: float = -math.inf
    sticks_s: float = -math.inf  # when the operator's own sticks came
    sticks_moved_s: float = -math.inf  # and when they were off their middle
    granted_s: dict[int, float] = field(default_factory=dict)  # command -> when the autopilot granted it
    position_jump_s: float = -math.inf  # when a position came last that no vehicle reaches from its last
    jumped: str = ""  # how it jumped; '' = it did not
    refused: Counter[str] = field(default_factory=Counter)
    """why messages were not used -> how many; at most ``MOST_KINDS`` reasons"""

    def left_out(self) -> str:
        """The commonest reasons with their numbers, '' = nothing was left out."""
        named = [f"{why}, {count} times" for why, count in self.refused.most_common(_MOST_NAMED)]
        more = len(self.refused) - len(named)
        return "; ".join([*named, f"and {more} more reasons"] if more > 0 else named)


class Intake:
    """Takes messages one by one: ``take`` gives what they tell the pilot."""

    def __init__(
        self,
        config: Config,
        start: tuple[float, float, float],
        heading_rad: float | None,
        system: int = 1,
        operator: int = 255,
        senders: Senders | None = None,
        replaced: Collection[str] = (),
    ) -> None:
        """``start``: where the vehicle is now; ``heading_rad``: compass heading of the world's x axis, None =
        where the vehicle looks at first. ``system``, ``operator``: their MAVLink ids; ``senders``: None = the
        usual ones. ``replaced``: kinds that an instrument tells itself, so that MAVLink's do not count."""
        self.heard, self._replaced = Heard(), replaced
        self._config, self._start, self._heading = config, start, heading_rad
        self._system, self._operator = system, operator
        self._senders = senders or Senders(system)
        self._clocks: dict[tuple[int, int, str], SourceClock] = {}
        self._last: dict[tuple[int, int, str], Fields] = {}
        self._newest: dict[str, float] = {}
        self._force_b: tuple[float, np.ndarray] | None = None
        self._zero: dict[str, float] = {}
        self._depth = -math.inf, 0.0  # (time of the pressure's newest reading, depth [m] by it)
        self._origin: np.ndarray | None = None
        self._place = -math.inf, np.zeros(3)  # (time, newest position as it was told)
        self._volts: dict[str, tuple[float, float]] = {}
        self._rangers = Rangers()
        self._takers: dict[str, Callable[[Fields, float], list[onboard.SensorMessage]]] = {
            "ATTITUDE": self._attitude,
            "VISION_POSITION_DELTA": self._vision_delta,
            "VISION_SPEED_ESTIMATE": self._vision_speed,
            **dict.fromkeys(_PLACES, self._vision_place),
            "LOCAL_POSITION_NED": self._local_position,
            "OBSTACLE_DISTANCE": self._obstacles,
            "DISTANCE_SENSOR": self._ranger,
        }
        for kind, taker in (
            ("imu", self._acceleration), ("pressure", self._pressure), ("battery", self._battery),
        ):  # fmt: skip
            self._takers |= dict.fromkeys(KINDS[kind], taker)

    def take(
        self, name: str, system: int, component: int, fields: Fields, come_s: float
    ) -> list[onboard.SensorMessage]:
        """What a message that came at ``come_s`` tells the pilot: mostly nothing or one message."""
        if name == "HEARTBEAT":
            self._heartbeat(system, component, fields, come_s)
            return []
        if name == "MANUAL_CONTROL" and system == self._operator and component != COMPANION:
            self._sticks(fields, come_s)
        if name == "COMMAND_ACK" and (system, component) == (self._system, AUTOPILOT):
            if fields["result"] == 0 and fields["command"] in (DO_SET_MODE, ARM_DISARM):
                self.heard.granted_s[fields["command"]] = come_s
        taker = self._takers.get(name)
        if taker is None:
            return []
        if not self._senders.counts(name, system, component):
            who, kind = f"{system}/{component}", KIND_OF.get(name)
            return self.refuse(f"{name} of {who}" + (f" (heard by --sender {kind}={who})" if kind else ""))
        if KIND_OF.get(name) in self._replaced:
            if int(fields.get("orientation", 0)) > 7:  # an altimeter, no part of a scan
                return []
            return self.refuse(f"{name}: --{KIND_OF[name]} names an instrument that tells it itself")
        if not all(math.isfinite(value) for value in fields.values() if isinstance(value, float)):
            return self.refuse(f"{name}: a number that is not finite")
        key = system, component, name
        if key not in self._clocks and len(self._clocks) >= MOST_KINDS:
            return self.refuse("too many senders")
        clock = self._clocks.setdefault(key, SourceClock())
        sent_s, wrap_s = stamp_of(fields)
        if sent_s and clock.has_risen and fields == self._last.get(key):
            return self.refuse(f"{name}: the same message again")
        self._last[key] = fields
        time_s = clock.measured_s(sent_s, come_s, wrap_s)
        found = taker({**fields, "name": name}, time_s)
        if found:
            self._newest[name] = come_s
        return found

    def forget_clocks(self) -> None:
        """Date messages anew: our clock has run on without those of the senders."""
        self._clocks.clear()

    @property
    def heading(self) -> float | None:
        """[rad] compass heading of the world's x axis; None: not typed, and no attitude was heard."""
        return self._heading

    def correct(self, place: tuple[float, float], turn_rad: float) -> tuple[float, float, float]:
        """Count from ``place`` [m] on, ``turn_rad`` added to the yaw; gives where it is, with its depth."""
        if self._heading is not None:
            self._heading += turn_rad
        roll, pitch, yaw = self.heard.rpy
        self.heard.rpy = roll, pitch, wrapped(yaw + turn_rad)
        told_s, depth = self._depth
        self._start = (*place, -depth if told_s > -math.inf else self._start[2])
        self._origin, self._place = None, (-math.inf, np.zeros(3))
        return self._start

    def forget_jump(self) -> None:
        """A position jumped before the vehicle was taken (a new origin): count from the start once more."""
        self.heard.jumped, self._origin = "", None

    def refuse(self, why: str) -> list[onboard.SensorMessage]:
        if why in self.heard.refused or len(self.heard.refused) < MOST_KINDS:
            self.heard.refused[why] += 1
        return []

    def _heartbeat(self, system: int, component: int, fields: Fields, come_s: float) -> None:
        heard = self.heard
        if system == self._system and component == AUTOPILOT:
            if fields["type"] != SUBMARINE or fields["autopilot"] != ARDUPILOT:
                self.refuse("the vehicle is no submarine of ArduPilot's")
                return
            heard.vehicle_s, heard.mode = come_s, int(fields["custom_mode"])
            heard.is_armed = bool(int(fields["base_mode"]) & _ARMED)
        elif fields["type"] == GROUND_STATION:
            if system == self._operator:
                heard.operator_s = come_s
            else:
                self.refuse(f"a ground station has the id {system}: --operator {system}")
        elif fields["type"] == SUBMARINE and component == AUTOPILOT:
            self.refuse(f"a submarine has the id {system}: --system {system}")

    def _sticks(self, fields: Fields, come_s: float) -> None:
        """Sticks of the operator, which reach the vehicle as ours do."""
        if int(fields.get("target", self._system)) != self._system:
            return
        off = max(*(abs(int(fields[axis])) for axis in ("x", "y", "r")), abs(2 * int(fields["z"]) - 1000))
        self.heard.sticks_s = come_s
        if off > _STICK_MOVED:
            self.heard.sticks_moved_s = come_s

    # ------------------------------------------------------------------------------------------- instruments

    def _attitude(self, fields: Fields, time_s: float) -> list[onboard.SensorMessage]:
        heading = self._heading
        if heading is None:
            heading = self._heading = float(fields["yaw"])
        rpy = np.array([fields["roll"], -fields["pitch"], wrapped(heading - fields["yaw"])])
        rate = np.array([fields["rollspeed"], -fields["pitchspeed"], -fields["yawspeed"]])
        heard = self.heard
        if time_s >= heard.rpy_s:
            heard.rpy, heard.rpy_s = (float(rpy[0]), float(rpy[1]), float(rpy[2])), time_s
            heard.yaw_rate, heard.yaw_rate_s = float(rate[2]), time_s
        kept = self._force_b
        rest = self._config.vehicle.gravity_m_s2 * _upwards(*rpy[:2])
        force = kept[1] if kept is not None and time_s - kept[0] < _FRESH_S else rest
        return [onboard.ImuReading(time_s, rpy, rate, force)]

    def _acceleration(self, fields: Fields, time_s: float) -> list[onboard.SensorMessage]:
        scale = 1.0 if fields["name"] == "HIGHRES_IMU" else _MILLI_G
        x, y, z = (scale * float(fields[axis]) for axis in ("xacc", "yacc", "zacc"))
        self._force_b = time_s, np.array([x, -y, -z])
        return []

    def _vision_delta(self, fields: Fields, time_s: float) -> list[onboard.SensorMessage]:
        spent_s = float(fields["time_delta_usec"]) / 1e6
        if not 1e-3 <= spent_s <= 1.0 or fields["confidence"] <= 0.0:
            return self.refuse("VISION_POSITION_DELTA: without a time or without confidence")
        ahead, right, down = (float(value) / spent_s for value in fields["position_delta"])
        if not all(map(math.isfinite, (ahead, right, down))):
            return self.refuse("VISION_POSITION_DELTA: a number that is not finite")
        return self._velocity(time_s, (ahead, -right, -down))

    def _vision_speed(self, fields: Fields, time_s: float) -> list[onboard.SensorMessage]:
        """The DVL's extension of BlueOS sends body axes, which MAVLink has as north, east, down."""
        ahead, right, down = (float(fields[axis]) for axis in "xyz")
        return self._velocity(time_s, (ahead, -right, -down))

    def _vision_place(self, fields: Fields, time_s: float) -> list[onboard.SensorMessage]:
        return self.refuse(f"{fields['name']}: a place tells no velocity: set the DVL to POSITION_DELTA")

    def _velocity(self, time_s: float, vel_b: tuple[float, float, float]) -> list[onboard.SensorMessage]:
        reading = onboard.DvlReading(time_s, np.array(vel_b))
        self.note_velocity(reading)
        return [reading]

    def note_velocity(self, reading: onboard.DvlReading) -> None:
        """What a DVL says is the vehicle's state too."""
        if reading.time_s >= self.heard.vel_b_s:
            ahead, left, up = (float(value) for value in reading.vel_b)
            self.heard.vel_b, self.heard.vel_b_s = (ahead, left, up), reading.time_s

    def _local_position(self, fields: Fields, time_s: float) -> list[onboard.SensorMessage]:
        if self._heading is None or not math.isfinite(self.heard.rpy[2]):
            return []
        turn, yaw = self._heading, self.heard.rpy[2]
        place = np.array(_turned(fields["x"], fields["y"], fields["z"], turn))
        if self._has_jumped(time_s, place):
            return self.refuse("LOCAL_POSITION_NED: the position jumped")
        if self._origin is None:
            self._origin = place
        found: list[onboard.SensorMessage] = []
        if self._config.sensors.localization != "estimated":
            where = np.array(self._start) + place - self._origin
            since_s, depth = self._depth  # the autopilot's own height lags behind a climb
            if abs(time_s - since_s) < _FRESH_S:
                where[2] = (time_s - since_s) * self._rise_m_s(time_s) - depth
            found.append(onboard.PositionFix(time_s, where))
        newest_s = max(self._newest.get(name, -math.inf) for name in _VELOCITIES)
        if time_s - newest_s > _FRESH_S and "dvl" not in self._replaced:
            east, north, up = _turned(fields["vx"], fields["vy"], fields["vz"], turn)
            cos, sin = math.cos(yaw), math.sin(yaw)
            found += self._velocity(time_s, (cos * east + sin * north, cos * north - sin * east, up))
        return found

    def _rise_m_s(self, time_s: float) -> float:
        """By the newest velocity in body axes; 0 where none is fresh."""
        heard = self.heard
        is_known = heard.vel_b is not None and abs(time_s - heard.vel_b_s) < _FRESH_S
        return float(_upwards(*heard.rpy[:2]) @ heard.vel_b) if is_known else 0.0

    def _has_jumped(self, time_s: float, place: np.ndarray) -> bool:
        last_s, last = self._place
        if time_s < last_s:
            return False
        self._place = time_s, place
        moved, spent_s = float(np.linalg.norm(place - last)), time_s - last_s
        if has_jumped := moved > JUMP_M + _MOST_SPEED_M_S * spent_s:
            self.heard.position_jump_s = time_s
            self.heard.jumped = f"the position moved {moved:.1f} m in {spent_s:.2f} s"
        return has_jumped

    def _pressure(self, fields: Fields, time_s: float) -> list[onboard.SensorMessage]:
        """ArduSub's second barometer is the one in the water; with one alone it sends the first. The third
        is a thermometer's, without a pressure (ArduSub, ``send_scaled_pressure3``)."""
        name = str(fields["name"])
        if not fields["press_abs"] > 0 or (name != "SCALED_PRESSURE2" and "SCALED_PRESSURE2" in self._newest):
            return []
        vehicle = self._config.vehicle
        depth = _PASCAL * float(fields["press_abs"]) / (vehicle.water_density_kg_m3 * vehicle.gravity_m_s2)
        zero = self._zero.setdefault(name, depth + self._start[2])
        late_s, found = time_s - self._depth[0], depth - zero
        off = found - self._depth[1] + late_s * self._rise_m_s(time_s)
        if abs(late_s) < _FRESH_S and abs(off) < _DEPTH_OFF_M:  # in a climb early and late by turns
            found -= (1.0 - _DEPTH_PART) * off
        self._depth = time_s, found
        return [onboard.PressureReading(time_s, depth - zero)]

    def _obstacles(self, fields: Fields, time_s: float) -> list[onboard.SensorMessage]:
        if fields["frame"] != 12:
            return self.refuse("OBSTACLE_DISTANCE: not relative to the bow (frame 12, MAV_FRAME_BODY_FRD)")
        increment = float(fields.get("increment_f", 0.0)) or float(fields["increment"])
        distances = np.array(list(fields["distances"])[:SECTORS], dtype=int)
        return self._scan(time_s, distances, increment, float(fields.get("angle_offset", 0.0)), fields)

    def _ranger(self, fields: Fields, time_s: float) -> list[onboard.SensorMessage]:
        if time_s - self._newest.get("OBSTACLE_DISTANCE", -math.inf) < _FRESH_S:
            return []
        ring = self._rangers.ring(fields, time_s)
        if ring is None:
            return []
        return self._scan(time_s, ring[0], 45.0, 0.0, {"name": "DISTANCE_SENSOR", "max_distance": ring[1]})

    def _scan(
        self, time_s: float, distances: np.ndarray, increment: float, offset: float, fields: Fields
    ) -> list[onboard.SensorMessage]:
        span = int(fields.get("min_distance", 0)), int(fields["max_distance"])
        found = ping_of(self._config.sensors.sonar, time_s, distances, increment, offset, *span)
        return [found] if isinstance(found, onboard.SonarPing) else self.refuse(f"{fields['name']}: {found}")

    def _battery(self, fields: Fields, time_s: float) -> list[onboard.SensorMessage]:
        if fields["name"] == "SYS_STATUS":
            volts = int(fields["voltage_battery"])
        elif fields["id"] == 0:
            volts = sum(value for value in fields["voltages"] if value < 65535) or 65535
        else:
            return []
        heard, share = self.heard, int(fields["battery_remaining"])
        if 0 < volts < 65535:
            self._volts[str(fields["name"])] = time_s, volts / 1e3
            told = [value for at_s, value in self._volts.values() if time_s - at_s <= _BATTERY_S]
            heard.battery_v, heard.battery_s = min(told), time_s
        if 0 <= share <= 100:
            heard.battery_share, heard.battery_s = share / 100, time_s
        return []


def waiting_for(heard: Heard, messages: int, place: str, operator: int) -> str:
    """Why a flight waits although everything is switched on: nothing comes at ``place``, or no ground station
    speaks; '' = both do. ``messages``: how many have come."""
    endpoint = (
        "BlueOS: Vehicle > Pirate mode > MAVLink Endpoints, add a UDP client to this computer's port 14551 "
        "and give --mavlink udp:0.0.0.0:14551"
    )
    if not messages:
        return (
            f"nothing has come at {place} yet: --mavlink names the place that vehicle or router send to. "
            f"QGroundControl holds port 14550 of its computer ({endpoint}; ardusub: --serial1 "
            "udpclient:HOST:PORT)"
        )
    if heard.operator_s > -math.inf:
        return ""
    return (
        f"no heartbeat of a ground station with the id {operator} comes. MAVProxy passes none on: have the "
        f"router send here itself ({endpoint}), or name the ground station's id by --operator"
    )


def _turned(north: float, east: float, down: float, heading: float) -> tuple[float, float, float]:
    """A vector of north, east, down in our world, whose x axis points to ``heading``."""
    cos, sin = math.cos(heading), math.sin(heading)
    return cos * north + sin * east, sin * north - cos * east, -down


def wrapped(angle: float) -> float:
    return math.atan2(math.sin(angle), math.cos(angle))


def _upwards(roll: float, pitch: float) -> np.ndarray:
    """(3,) The world's z axis in body axes."""
    return np.array([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)])
