"""What comes by MAVLink, as messages of the pilot and as the state of vehicle and operator.

MAVLink: world north, east, down; body x ahead, y right, z down. Ours: world z up, x axis to the compass
heading given; body x ahead, y left, z up.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from uuvtai.config import Config
from uuvtai.link.orders import ARM_DISARM, DO_SET_MODE
from uuvtai.link.sectors import SECTORS, UNKNOWN_CM, ping_of
from uuvtai.pilot import DvlReading, ImuReading, PositionFix, PressureReading, SensorMessage, SonarPing

RESTART_S = 1.0
"""a clock that jumps by more has begun anew"""
_DRIFT = 1e-4
"""two clocks run apart by no more"""


class SourceClock:
    """Maps the time stamps of one sender, who counts from a moment of its own, to the pilot's clock: the
    least delay seen counts as none."""

    def __init__(self) -> None:
        self._offset_s = math.nan
        self._sent_s = self._come_s = -math.inf

    def measured_s(self, sent_s: float, come_s: float) -> float:
        """When the message that says ``sent_s`` and came at ``come_s`` was measured: never after it came."""
        offset = come_s - sent_s
        jumps = sent_s < self._sent_s - RESTART_S or offset < self._offset_s - RESTART_S
        if math.isnan(self._offset_s) or jumps:
            self._offset_s = offset
        else:
            drifted = self._offset_s + _DRIFT * max(come_s - self._come_s, 0.0)
            self._offset_s = min(drifted, offset)
        self._sent_s, self._come_s = sent_s, come_s
        return sent_s + self._offset_s


SUBMARINE, ARDUPILOT, GROUND_STATION = 12, 3, 6
AUTOPILOT = 1
_ARMED = 128
COMPANION = 191
"""MAV_COMP_ID_ONBOARD_COMPUTER: what we are"""
_STICK_MOVED = 200
"""of 1000"""
_MOST_CLOCKS = 64
_FRESH_S = 1.0
"""a source that was heard within this time is preferred to a lesser one"""
_PASCAL, _MILLI_G = 100.0, 9.80665e-3

Fields = Mapping[str, Any]


@dataclass
class Heard:
    """Who was heard last, and what they said of themselves. Times by the pilot's clock, minus infinity =
    never."""

    vehicle_s: float = -math.inf
    operator_s: float = -math.inf
    mode: int = -1
    is_armed: bool = False
    battery_v: float | None = None
    battery_share: float | None = None
    rpy: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    """of the newest attitude, world axes of ours"""
    rpy_s: float = -math.inf
    """when attitude and yaw rate were measured"""
    vel_b: tuple[float, float, float] | None = None
    vel_b_s: float = -math.inf
    yaw_rate: float = 0.0
    battery_s: float = -math.inf
    sticks_s: float = -math.inf
    """when the operator's own sticks came"""
    sticks_moved_s: float = -math.inf
    """and when they were off their middle"""
    granted_s: dict[int, float] = field(default_factory=dict)
    """command -> when the autopilot granted it"""
    jumped: str = ""
    """how the given position jumped; '' = it did not"""
    refused: Counter[str] = field(default_factory=Counter)
    """why messages were not used -> how many"""


class Intake:
    """Takes messages one by one: ``take`` gives what they tell the pilot."""

    def __init__(
        self,
        config: Config,
        start: tuple[float, float, float],
        heading_rad: float | None,
        system: int = 1,
        operator: int = 255,
    ) -> None:
        """``start``: where the vehicle is now; ``heading_rad``: compass heading of the world's x axis, None =
        where the vehicle looks at first. ``system``, ``operator``: their MAVLink ids."""
        self.heard = Heard()
        self._config, self._start, self._heading = config, start, heading_rad
        self._system, self._operator = system, operator
        self._clocks: dict[tuple[int, int, str], SourceClock] = {}
        self._newest: dict[str, float] = {}
        self._force_b: tuple[float, np.ndarray] | None = None
        self._zero: dict[str, float] = {}
        self._depth = -math.inf, 0.0
        """(time, newest depth [m] of the pressure sensor)"""
        self._origin: np.ndarray | None = None
        self._rangers: dict[int, tuple[float, int, int]] = {}
        self._takers: dict[str, Callable[[Fields, float], list[SensorMessage]]] = {
            "ATTITUDE": self._attitude,
            "VISION_POSITION_DELTA": self._vision_delta,
            "LOCAL_POSITION_NED": self._local_position,
            "OBSTACLE_DISTANCE": self._obstacles,
            "DISTANCE_SENSOR": self._ranger,
            "SYS_STATUS": self._battery,
            "BATTERY_STATUS": self._battery,
            "COMMAND_ACK": self._answer,
        }
        for name in ("SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3", "RAW_IMU", "HIGHRES_IMU"):
            self._takers[name] = self._acceleration
        for name in ("SCALED_PRESSURE", "SCALED_PRESSURE2", "SCALED_PRESSURE3"):
            self._takers[name] = self._pressure

    def take(
        self, name: str, system: int, component: int, fields: Fields, come_s: float
    ) -> list[SensorMessage]:
        """What a message that came at ``come_s`` tells the pilot: mostly nothing or one message."""
        if name == "HEARTBEAT":
            self._heartbeat(system, component, fields, come_s)
            return []
        if name == "MANUAL_CONTROL" and system == self._operator and component != COMPANION:
            self._sticks(fields, come_s)
        taker = self._takers.get(name)
        if taker is None or system != self._system:
            return []
        if not all(math.isfinite(value) for value in fields.values() if isinstance(value, float)):
            return self.refuse(f"{name}: a number that is not finite")
        if not self._is_known(system, component, name):
            return self.refuse("too many senders")
        sent_s = _time_of(fields)
        clock = self._clocks[system, component, name]
        time_s = come_s if sent_s is None else clock.measured_s(sent_s, come_s)
        found = taker({**fields, "name": name}, time_s)
        if found:
            self._newest[name] = come_s
        return found

    def forget_clocks(self) -> None:
        """Date messages anew: our clock has run on without those of the senders."""
        self._clocks.clear()

    def _is_known(self, system: int, component: int, name: str) -> bool:
        key = system, component, name
        if key not in self._clocks and len(self._clocks) < _MOST_CLOCKS:
            self._clocks[key] = SourceClock()
        return key in self._clocks

    def refuse(self, why: str) -> list[SensorMessage]:
        """Count a message that is not used."""
        if why in self.heard.refused or len(self.heard.refused) < _MOST_CLOCKS:
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
        off = max(*(abs(int(fields[axis])) for axis in ("x", "y", "r")), abs(2 * int(fields["z"]) - 1000))
        self.heard.sticks_s = come_s
        if off > _STICK_MOVED:
            self.heard.sticks_moved_s = come_s

    def _answer(self, fields: Fields, time_s: float) -> list[SensorMessage]:
        if fields["result"] == 0 and int(fields["command"]) in (DO_SET_MODE, ARM_DISARM):
            self.heard.granted_s[int(fields["command"])] = time_s
        return []

    # ------------------------------------------------------------------------------------------- instruments

    def _attitude(self, fields: Fields, time_s: float) -> list[SensorMessage]:
        heading = self._heading
        if heading is None:
            heading = self._heading = float(fields["yaw"])
        rpy = np.array([fields["roll"], -fields["pitch"], _wrapped(heading - fields["yaw"])])
        rate = np.array([fields["rollspeed"], -fields["pitchspeed"], -fields["yawspeed"]])
        self.heard.rpy, self.heard.yaw_rate = (float(rpy[0]), float(rpy[1]), float(rpy[2])), float(rate[2])
        self.heard.rpy_s = time_s
        kept = self._force_b
        gravity = self._config.vehicle.gravity_m_s2
        roll, pitch = rpy[:2]
        rest = gravity * np.array(
            [-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)]
        )
        force = kept[1] if kept is not None and time_s - kept[0] < _FRESH_S else rest
        return [ImuReading(time_s, rpy, rate, force)]

    def _acceleration(self, fields: Fields, time_s: float) -> list[SensorMessage]:
        scale = 1.0 if fields["name"] == "HIGHRES_IMU" else _MILLI_G
        x, y, z = (scale * float(fields[axis]) for axis in ("xacc", "yacc", "zacc"))
        self._force_b = time_s, np.array([x, -y, -z])
        return []

    def _vision_delta(self, fields: Fields, time_s: float) -> list[SensorMessage]:
        spent_s = float(fields["time_delta_usec"]) / 1e6
        if not 1e-3 <= spent_s <= 1.0 or fields["confidence"] <= 0.0:
            return self.refuse("VISION_POSITION_DELTA: without a time or without confidence")
        ahead, right, down = (float(value) / spent_s for value in fields["position_delta"])
        if not all(map(math.isfinite, (ahead, right, down))):
            return self.refuse("VISION_POSITION_DELTA: a number that is not finite")
        return self._velocity(time_s, (ahead, -right, -down))

    def _velocity(self, time_s: float, vel_b: tuple[float, float, float]) -> list[SensorMessage]:
        self.heard.vel_b, self.heard.vel_b_s = vel_b, time_s
        return [DvlReading(time_s, np.array(vel_b))]

    def _local_position(self, fields: Fields, time_s: float) -> list[SensorMessage]:
        if self._heading is None or not math.isfinite(self.heard.rpy[2]):
            return []
        turn, yaw = self._heading, self.heard.rpy[2]
        place = np.array(_turned(fields["x"], fields["y"], fields["z"], turn))
        if self._origin is None:
            self._origin = place
        found: list[SensorMessage] = []
        if self._config.sensors.localization != "estimated":
            where = np.array(self._start) + place - self._origin
            if abs(time_s - self._depth[0]) < _FRESH_S:  # the autopilot's own height lags behind a climb
                where[2] = -self._depth[1]
            found.append(PositionFix(time_s, where))
        if time_s - self._newest.get("VISION_POSITION_DELTA", -math.inf) > _FRESH_S:
            east, north, up = _turned(fields["vx"], fields["vy"], fields["vz"], turn)
            cos, sin = math.cos(yaw), math.sin(yaw)
            found += self._velocity(time_s, (cos * east + sin * north, cos * north - sin * east, up))
        return found

    def _pressure(self, fields: Fields, time_s: float) -> list[SensorMessage]:
        """ArduSub's second barometer is the one in the water; with one alone it sends the first."""
        name = str(fields["name"])
        if name == "SCALED_PRESSURE" and "SCALED_PRESSURE2" in self._newest:
            return []
        vehicle = self._config.vehicle
        depth = _PASCAL * float(fields["press_abs"]) / (vehicle.water_density_kg_m3 * vehicle.gravity_m_s2)
        zero = self._zero.setdefault(name, depth + self._start[2])
        self._depth = time_s, depth - zero
        return [PressureReading(time_s, depth - zero)]

    def _obstacles(self, fields: Fields, time_s: float) -> list[SensorMessage]:
        if fields["frame"] != 12:
            return self.refuse("OBSTACLE_DISTANCE: not relative to the bow (frame 12, MAV_FRAME_BODY_FRD)")
        increment = float(fields.get("increment_f", 0.0)) or float(fields["increment"])
        distances = np.array(list(fields["distances"])[:SECTORS], dtype=int)
        return self._scan(time_s, distances, increment, float(fields.get("angle_offset", 0.0)), fields)

    def _ranger(self, fields: Fields, time_s: float) -> list[SensorMessage]:
        """Eight rangefinders around the hull make a ring of eight sectors, told when the one ahead speaks."""
        turn = int(fields["orientation"])
        if not 0 <= turn < 8 or time_s - self._newest.get("OBSTACLE_DISTANCE", -math.inf) < _FRESH_S:
            return []
        reach = int(fields["max_distance"])
        read = int(fields["current_distance"])
        self._rangers[turn] = time_s, reach + 1 if read >= reach else read, reach
        if turn != 0:
            return []
        recent = {at: row for at, row in self._rangers.items() if abs(time_s - row[0]) <= _FRESH_S}
        distances = np.array([recent[at][1] if at in recent else UNKNOWN_CM for at in range(8)])
        least = min(row[2] for row in recent.values())
        distances = np.where((distances > least) & (distances < UNKNOWN_CM), least + 1, distances)
        return self._scan(time_s, distances, 45.0, 0.0, {"name": "DISTANCE_SENSOR", "max_distance": least})

    def _scan(
        self, time_s: float, distances: np.ndarray, increment: float, offset: float, fields: Fields
    ) -> list[SensorMessage]:
        sonar = self._config.sensors.sonar
        found = ping_of(sonar, time_s, distances, increment, offset, int(fields["max_distance"]))
        return [found] if isinstance(found, SonarPing) else self.refuse(f"{fields['name']}: {found}")

    def _battery(self, fields: Fields, time_s: float) -> list[SensorMessage]:
        if fields["name"] == "SYS_STATUS":
            volts = int(fields["voltage_battery"])
        elif fields["id"] == 0:
            volts = sum(value for value in fields["voltages"] if value < 65535) or 65535
        else:
            return []
        share = int(fields["battery_remaining"])
        if 0 < volts < 65535 or 0 <= share <= 100:
            self.heard.battery_s = time_s
        self.heard.battery_v = volts / 1e3 if 0 < volts < 65535 else self.heard.battery_v
        self.heard.battery_share = share / 100 if 0 <= share <= 100 else self.heard.battery_share
        return []


def _time_of(fields: Fields) -> float | None:
    """[s] of the sender's clock; None where the message has none."""
    if "time_boot_ms" in fields:
        return float(fields["time_boot_ms"]) / 1e3
    return float(fields["time_usec"]) / 1e6 if "time_usec" in fields else None


def _turned(north: float, east: float, down: float, heading: float) -> tuple[float, float, float]:
    """A vector of north, east, down in our world, whose x axis points to ``heading``."""
    cos, sin = math.cos(heading), math.sin(heading)
    return cos * north + sin * east, sin * north - cos * east, -down


def _wrapped(angle: float) -> float:
    return math.atan2(math.sin(angle), math.cos(angle))
