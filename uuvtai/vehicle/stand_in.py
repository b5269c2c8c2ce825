"""A small autopilot in ArduSub's place: it reads the physics' JSON, speaks MAVLink to the pilot, and turns
velocities asked for into pulses. It knows its motion exactly, which no real one does."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

import numpy as np

from uuvtai.common.files import parsed_json
from uuvtai.vehicle import mavlink
from uuvtai.vehicle.telemetry import AUTOPILOT, FRAMES, NEUTRAL_US, SPAN_US

RATE_HZ, LOOP_HZ = 200, 50  # packets to the physics; steps of its own
_MAGIC, _MANUAL, _ARMED = 18458, 19, 128  # of a packet with 16 channels; first mode; flag of a heartbeat
_AIR_HPA, _WATER_HPA_M = 1013.25, 97.8057  # by metre of depth: 997 kg/m^3
_PUSH, _PUSH_SUM = np.array([0.35, 1.2, 1.2, 1.5]), np.array([0.3, 0.5, 0.5, 0.8])
"""round, ahead, right, down: parts of a full push for an error of 1 rad/s or 1 m/s, and for its sum in 1 s"""
_FORGETS_S = 3.0  # a velocity asked for so long ago; as ArduSub's GUIDED does
_STILL = (0.0, 0.0, 0.0, 0.0)


class StandIn:
    """One vehicle's. ``frame`` is its next packet to the physics, ``take`` the answer."""

    def __init__(self, pilot: mavlink.Address, system: int = 1, thrusters: int = 6) -> None:
        """``pilot``: where it speaks to. Raises LinkError."""
        self._endpoint = mavlink.Endpoint(mavlink.LinkPlace(*pilot, calls=True))
        self._codec, self._count = mavlink.MavCodec(system, AUTOPILOT), 0
        self._motors = np.array(FRAMES[thrusters], float)[:, [2, 4, 5, 3]] * (1.0, 1.0, 1.0, -1.0)
        self.mode, self.is_armed = _MANUAL, False
        self._asked, self._asked_s = np.array(_STILL), -math.inf
        self.time_s, self.place, self.by_hand = 0.0, (0.0, 0.0), np.array(_STILL)
        """of the water; [m] where it is, x north, y west; what is asked for where GUIDED is not on: clockwise
        [rad/s], ahead, right, down [m/s]"""
        self._sum, self._pulses = np.zeros(4), np.full(16, NEUTRAL_US, int)

    def frame(self) -> bytes:
        """The next packet."""
        packet = struct.pack("<HHI16H", _MAGIC, RATE_HZ, self._count, *self._pulses)
        self._count += 1
        return packet

    def take(self, answer: bytes) -> None:
        """An answer of the physics; in a step of its own it is told to the pilot, and steered by."""
        if self._count % (RATE_HZ // LOOP_HZ):
            return
        told = parsed_json(answer, "the physics' answer")
        self.time_s = told["timestamp"]
        self.place = told["position"][0], -told["position"][1]
        self._listen()
        self._steer(told)
        self._speak(told)

    def _listen(self) -> None:
        for _, datagram in self._endpoint.receive():
            for said in self._codec.decode(datagram):
                self._obey(said.name, said.fields)

    def _obey(self, name: str, fields: dict) -> None:
        if name == "SET_POSITION_TARGET_LOCAL_NED":
            asked = np.array([fields[name] for name in ("yaw_rate", "vx", "vy", "vz")])
            if np.isfinite(asked).all():
                self._asked, self._asked_s = asked, self.time_s
        elif name == "COMMAND_LONG" and fields["command"] == mavlink.ARM_DISARM:
            self.is_armed = fields["param1"] == 1
        elif name == "COMMAND_LONG" and fields["command"] == mavlink.DO_SET_MODE:
            self.mode = int(fields["param2"]) if fields["param2"] in mavlink.MODE_NAMES else self.mode

    def _steer(self, told: dict) -> None:
        self._pulses[:] = NEUTRAL_US
        if not self.is_armed:
            return
        yaw = _euler(told["quaternion"])[2]
        north, east, down = told["velocity"]
        cos, sin = math.cos(yaw), math.sin(yaw)
        motion = told["imu"]["gyro"][2], cos * north + sin * east, cos * east - sin * north, down
        is_old = self.time_s - self._asked_s > _FORGETS_S
        asked = self.by_hand if self.mode != mavlink.GUIDED else np.array(_STILL) if is_old else self._asked
        error = asked - np.array(motion)
        self._sum = np.clip(self._sum + error / LOOP_HZ, -1.0, 1.0)
        push = np.clip(self._motors @ np.clip(_PUSH * error + _PUSH_SUM * self._sum, -1.0, 1.0), -1.0, 1.0)
        speed = np.sign(push) * np.sqrt(np.abs(push))  # thrust grows as the square of the speed
        self._pulses[: len(push)] = np.rint(NEUTRAL_US + SPAN_US * speed)

    def _speak(self, told: dict) -> None:
        time_s, imu, position = told["timestamp"], told["imu"], told["position"]
        rpy, boot_ms, hpa = (
            _euler(told["quaternion"]),
            round(1e3 * time_s),
            _AIR_HPA + _WATER_HPA_M * position[2],
        )
        accel = [round(1e3 * value / 9.80665) for value in imu["accel_body"]]
        boot = {"time_boot_ms": boot_ms}
        turn = _named("rollspeed pitchspeed yawspeed", imu["gyro"])
        self._say("ATTITUDE", boot | _named("roll pitch yaw", rpy) | turn)
        unheard = _named("xgyro ygyro zgyro xmag ymag zmag", [0] * 6)
        self._say("RAW_IMU", {"time_usec": 1000 * boot_ms} | _named("xacc yacc zacc", accel) | unheard)
        velocity = _named("vx vy vz", told["velocity"])
        self._say("LOCAL_POSITION_NED", boot | _named("x y z", position) | velocity)
        self._say("SCALED_PRESSURE2", boot | _named("press_abs press_diff temperature", (hpa, 0.0, 2000)))
        if self._count % RATE_HZ == 0:
            kind = {"type": 12, "autopilot": 3, "system_status": 4, "mavlink_version": 3}
            self._say("HEARTBEAT", kind | {"base_mode": 1 | _ARMED * self.is_armed, "custom_mode": self.mode})

    def _say(self, name: str, fields: dict) -> None:
        order = mavlink.Order(name, name, fields)
        assert self._endpoint.calls is not None
        self._endpoint.send(self._codec.encode(order), self._endpoint.calls)
        self._codec.sent(order)

    def close(self) -> None:
        """Let go of its port."""
        self._endpoint.close()


def _named(names: str, values: Sequence[float]) -> dict:
    return dict(zip(names.split(), values, strict=True))


def _euler(quat: Sequence[float]) -> tuple[float, float, float]:
    w, x, y, z = quat
    return (
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x)))),
        math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )
