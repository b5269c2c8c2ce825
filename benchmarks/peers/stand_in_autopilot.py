"""An autopilot of a hundred lines in the place of ArduSub: it reads the physics' JSON, speaks MAVLink to the
pilot, and turns velocities asked for into pulses. It knows its motion exactly, which no real one does."""

from __future__ import annotations

import json
import math
import socket
import struct

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mav

RATE_HZ = 200
_FACTORS = np.array(
    [(1, -1, 1, 0), (-1, -1, -1, 0), (-1, 1, 1, 0), (1, 1, -1, 0), (0, 0, 0, -1), (0, 0, 0, -1)], float
)
"""yaw, forward, lateral, throttle of each motor of ArduSub's frame VECTORED"""
_GUIDED = 4


class StandIn:
    """One vehicle's. ``frame`` is its next packet to the physics, ``take`` the answer."""

    def __init__(self, pilot: tuple[str, int], operates: bool = True) -> None:
        """``operates``: a ground station beats beside it."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self._pilot, self._count, self._operates = pilot, 0, operates
        self._own = mav.MAVLink(None, srcSystem=1, srcComponent=1)
        self._operator = mav.MAVLink(None, srcSystem=255, srcComponent=190)
        self._parser = mav.MAVLink(None)
        self._parser.robust_parsing = True
        self.mode, self.is_armed = 19, False
        self._asked = np.zeros(4)
        """ahead, right, down [m/s], clockwise [rad/s]"""
        self.time_s, self.place, self.by_hand = 0.0, (0.0, 0.0), np.zeros(4)
        """of the water; [m] where it is, x north, y west; what is asked for where GUIDED is not on"""
        self._sum, self._pulses = np.zeros(4), [1500] * 16

    def frame(self) -> bytes:
        """The next packet."""
        packet = struct.pack("<HHI16H", 18458, RATE_HZ, self._count, *self._pulses)
        self._count += 1
        return packet

    def take(self, answer: bytes) -> None:
        """An answer of the physics; at 50 Hz it is told to the pilot, and steered by."""
        if self._count % (RATE_HZ // 50):
            return
        told = json.loads(answer)
        self.time_s = told["timestamp"]
        self.place = told["position"][0], -told["position"][1]
        self._listen()
        roll, pitch, yaw = _euler(told["quaternion"])
        north, east, down = told["velocity"]
        motion = np.array(
            [
                math.cos(yaw) * north + math.sin(yaw) * east,
                math.cos(yaw) * east - math.sin(yaw) * north,
                down,
                told["imu"]["gyro"][2],
            ]
        )
        self._steer(motion)
        self._speak(told, roll, pitch, yaw)

    def _steer(self, motion: np.ndarray) -> None:
        if not self.is_armed:
            self._pulses = [1500] * 16
            return
        error = (self._asked if self.mode == _GUIDED else self.by_hand) - motion
        self._sum = np.clip(self._sum + 0.02 * error, -1.0, 1.0)
        push = np.clip(
            np.array([1.2, 1.2, 1.5, 0.35]) * error + np.array([0.5, 0.5, 0.8, 0.3]) * self._sum, -1, 1
        )
        ahead, right, below, turn = push
        out = np.clip(_FACTORS @ np.array([turn, ahead, right, -below]), -1.0, 1.0)
        speed = np.sign(out) * np.sqrt(np.abs(out))  # thrust grows as the square of the speed
        self._pulses = [round(1500 + 400 * value) for value in speed] + [1500] * 10

    def _speak(self, told: dict, roll: float, pitch: float, yaw: float) -> None:
        time_s = told["timestamp"]
        boot, micro = round(1e3 * time_s), round(1e6 * time_s)
        milli = [round(1e3 * value / 9.80665) for value in told["imu"]["accel_body"]]
        position, velocity = told["position"], told["velocity"]
        depth_hpa = position[2] * 997.0 * 9.81 / 100
        self._send(mav.MAVLink_attitude_message(boot, roll, pitch, yaw, *told["imu"]["gyro"]))
        self._send(mav.MAVLink_raw_imu_message(micro, *milli, 0, 0, 0, 0, 0, 0))
        self._send(mav.MAVLink_local_position_ned_message(boot, *position, *velocity))
        self._send(mav.MAVLink_scaled_pressure2_message(boot, 1013.25 + depth_hpa, 0.0, 2000))
        if self._count % RATE_HZ == 0:
            armed = 128 if self.is_armed else 0
            self._send(mav.MAVLink_heartbeat_message(12, 3, 1 | armed, self.mode, 4, 3))
            if self._operates:
                beat = mav.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(self._operator)
                self._socket.sendto(beat, self._pilot)

    def _send(self, message: mav.MAVLink_message) -> None:
        self._socket.sendto(message.pack(self._own), self._pilot)

    def _listen(self) -> None:
        while True:
            try:
                data = self._socket.recv(4096)
            except BlockingIOError:
                return
            for message in self._parser.parse_buffer(data) or []:
                kind = message.get_type()
                if kind == "SET_POSITION_TARGET_LOCAL_NED":
                    self._asked = np.array([message.vx, message.vy, message.vz, message.yaw_rate])
                elif kind == "COMMAND_LONG" and message.command == 176:
                    self.mode = int(message.param2)
                elif kind == "COMMAND_LONG" and message.command == 400:
                    self.is_armed = message.param1 == 1

    def close(self) -> None:
        """Let go of its port."""
        self._socket.close()


def _euler(quat: list[float]) -> tuple[float, float, float]:
    w, x, y, z = quat
    return (
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x)))),
        math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )
