"""Flights with faults: what breaks is drawn by a seed, what may never happen is looked at from outside."""

import math
import random
import struct
import tempfile
from pathlib import Path

from pymavlink.dialects.v20 import ardupilotmega as mav

from tests.mavlink_vehicle import LIMITS, FakeSub, Flight, assert_within, link_config

DT, SECONDS = 0.05, 24.0
SENSORS = {
    "ATTITUDE": "imu", "VISION_POSITION_DELTA": "dvl", "SCALED_PRESSURE2": "pressure",
    "OBSTACLE_DISTANCE": "sonar",
}  # fmt: skip
FAULTS = (
    "dead", "late", "stuck", "nan", "foreign", "clock", "slow", "takes over", "disarms", "sticks",
    "link lost", "operator silent", "battery ends",
)  # fmt: skip
_SLACK_S = 2 * DT
"""between what the vehicle did and what a step can know of it"""


class FaultySub(FakeSub):
    """Faults are (kind, sensor, begin, end, size), by the vehicle's clock. It beats every ``beat_s``."""

    def __init__(self, *given, faults=(), beat_s=DT, **more):
        super().__init__(*given, **more)
        self.faults, self.waiting, self.kept = faults, [], {}
        self.beat_s, self.next_beat_s, self.beats = beat_s, 0.0, []
        self.true_s = dict.fromkeys(SENSORS, -math.inf)
        """when the newest reading that can be used and was delivered was measured"""
        self.foreign = mav.MAVLink(None, srcSystem=self.system, srcComponent=14)

    def speak(self, dt=DT):
        """Also what has come late."""
        super().speak(dt)
        for due_s, name, message, link, measured_s in list(self.waiting):
            if due_s <= self.time_s and not self.of("link lost"):
                self.waiting.remove((due_s, name, message, link, measured_s))
                self.deliver(name, message, link, measured_s)
        if self.of("foreign"):
            self.send(mav.MAVLink_attitude_message(7, 1.4, 1.4, 1.0, 0.0, 0.0, 0.0), self.foreign)
            self.send(mav.MAVLink_heartbeat_message(12, 3, 128, 4, 4, 3), self.foreign)
            self.send(mav.MAVLink_sys_status_message(0, 0, 0, 0, 9000, 0, 1, 0, 0, 0, 0, 0, 0), self.foreign)
        if self.of("sticks"):
            self.send(mav.MAVLink_manual_control_message(1, 700, 0, 500, 0, 0), self.operator)

    def of(self, kind, name=None):
        """The fault of this kind that is there now."""
        for fault in self.faults:
            if fault[0] == kind and fault[2] <= self.time_s < fault[3] and name in (None, fault[1]):
                return fault
        return None

    def emit(self, name, message, link):
        """With its faults."""
        ends = {"operator": "operator silent", "SYS_STATUS": "battery ends"}.get(name, "dead")
        if self.of("link lost") or self.of(ends, name if ends == "dead" else None):
            return
        if name == "HEARTBEAT":
            if self.time_s < self.next_beat_s:
                return
            self.next_beat_s = self.time_s + self.beat_s
            self.beats.append((self.time_s, self.mode, self.armed))
        measured_s = self.time_s
        if self.of("stuck", name):
            message, measured_s = self.kept.setdefault(name, (message, self.time_s))
        elif name in SENSORS:
            self.kept.pop(name, None)
        if self.of("nan", name):
            for field in message.fieldnames:
                if isinstance(getattr(message, field), float):
                    setattr(message, field, math.nan)
            measured_s = -math.inf
        if (jump := self.of("clock", name)) is not None:
            for field, unit in (("time_boot_ms", 1e3), ("time_usec", 1e6)):
                if hasattr(message, field):
                    setattr(message, field, max(0, getattr(message, field) + round(unit * jump[4])))
        if (late := self.of("late", name)) is not None:
            self.waiting.append((self.time_s + abs(late[4]), name, message, link, measured_s))
        else:
            self.deliver(name, message, link, measured_s)

    def deliver(self, name, message, link, measured_s):
        """Put it on the wire."""
        try:
            self.send(message, link)
        except struct.error:  # no such number can be packed
            return
        if name in SENSORS:
            self.true_s[name] = max(self.true_s[name], measured_s)

    def listen(self):
        """What comes while the link is lost is lost too."""
        told, state = len(self.told), (self.mode, self.armed)
        super().listen()
        if self.of("link lost"):
            del self.told[told:]
            self.mode, self.armed = state


def drawn(seed):
    """(modes of the vehicle, between its heartbeats [s], one to three faults)."""
    luck = random.Random(f"flights {seed}")
    faults = []
    for _ in range(luck.randint(1, 3)):
        begin = luck.uniform(1.0, 16.0)
        size = luck.choice((-1, 1)) * luck.uniform(0.2, 4.0)
        faults.append(
            (luck.choice(FAULTS), luck.choice(list(SENSORS)), begin, begin + luck.uniform(0.3, 9.0), size)
        )
    return luck.choice(((2, 4, 9), (2, 4), (2, 9))), luck.choice((DT, 0.5, 1.0)), faults


def violations(seed):
    """What a flight did that it must never do."""
    modes, beat_s, faults = drawn(seed)
    with tempfile.TemporaryDirectory() as place:
        flight = Flight(
            Path(place), config=link_config(), sub=FaultySub, modes=modes, faults=faults, beat_s=beat_s
        )
        flight.pilot.velocity = (0.4, 0.1, 0.1, 0.3)
        flight.log.close()
        flight.log.trouble = "nobody reads it"
        try:
            return [f"seed {seed} {modes} {faults}: {text}" for text in _watched(flight)]
        finally:
            flight.close()


def _watched(flight):
    sub, wrong, is_taken = flight.sub, [], False
    while sub.time_s < SECONDS:
        if sub.of("takes over") and not is_taken:
            sub.mode, is_taken = 0, True  # no mode that it had or was asked for
        if sub.of("disarms"):
            sub.armed = False
        told = len(sub.told)
        flight.run(DT, dt=DT, stalled=0.3 if sub.of("slow") else 0.0)
        wrong += _wrong(flight, sub.told[told:])
    try:
        assert_within(sub.told)
    except AssertionError as error:
        wrong.append(f"outside the limits: {error}")
    return wrong


def _wrong(flight, told):
    """Of one step: ``told`` is what the vehicle was told in it."""
    sub, action = flight.sub, flight.loop.last.action.name
    moving = [message for message in told if moves(message)]
    found = []
    if action != "DRIVE" and moving:
        found.append(f"{sub.time_s:.2f} s: {action} moves it: {moving[0]}")
    heard = [beat for beat in sub.beats if beat[0] <= sub.time_s - _SLACK_S]
    if any(mode == 0 for _, mode, _ in heard) and any(map(orders, told)):
        found.append(f"{sub.time_s:.2f} s: the operator has it and it is told {told[0]}")
    was_armed = [is_armed for _, _, is_armed in heard]
    if False in was_armed[was_armed.index(True) :] if True in was_armed else False:
        if moving or any(map(arms, told)):
            found.append(f"{sub.time_s:.2f} s: disarmed by the operator and it is told {told[0]}")
    if moving and sub.of("slow") is None:
        for name, sensor in SENSORS.items():
            age_s = sub.time_s - sub.true_s[name]
            if age_s > LIMITS.sensor_s[sensor] + _SLACK_S and not sub.of("stuck", name):
                found.append(f"{sub.time_s:.2f} s: drives by a {sensor} reading {age_s:.2f} s old")
    return found


def moves(message):
    """Whether an order asks for motion."""
    kind = message.get_type()
    if kind == "SET_POSITION_TARGET_LOCAL_NED":
        return any((message.vx, message.vy, message.vz, message.yaw_rate))
    return kind == "MANUAL_CONTROL" and (message.x, message.y, message.z, message.r) != (0, 0, 500, 0)


def orders(message):
    """Whether a message is an order at all."""
    kind = message.get_type()
    return kind not in ("HEARTBEAT", "COMMAND_LONG") or (kind == "COMMAND_LONG" and message.command != 511)


def arms(message):
    """Whether an order arms."""
    return message.get_type() == "COMMAND_LONG" and message.command == 400
