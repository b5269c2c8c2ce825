"""A submarine of pymavlink on UDP that obeys modes and arming; a ground station; an obedient pilot."""

import contextlib
import math
import random
import socket
from functools import cache
from types import SimpleNamespace

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mav

from uuvtai.config.loader import load_config
from uuvtai.vehicle.control_loop import FlightPlan, OnboardLoop
from uuvtai.vehicle.mavlink import Endpoint, LinkPlace
from uuvtai.vehicle.messages import NAMES
from uuvtai.vehicle.onboard import KINDS, Mission, Tally
from uuvtai.vehicle.pilot_log import LinkLog
from uuvtai.vehicle.safety import SafetyLimits

START, GOAL = (2.0, 3.0, -0.8), (18.0, 3.0, -0.8)
LIMITS = SafetyLimits(box_m=(0.0, 0.0, 20.0, 6.0), depth_m=(0.2, 1.4))


@cache
def link_config(**changes):
    """The pool seen by a fan without Doppler, its position estimated."""
    given = {"sensors.localization": "estimated"} | changes
    return load_config("pool", "multibeam", overrides=given)


def free_port():
    """A port that nobody holds by UDP or TCP, below those that systems hand out by themselves."""
    for port in random.SystemRandom().sample(range(20_000, 32_000), 200):
        with contextlib.suppress(OSError), contextlib.ExitStack() as stack:
            for kind in (socket.SOCK_DGRAM, socket.SOCK_STREAM):
                stack.enter_context(socket.socket(socket.AF_INET, kind)).bind(("127.0.0.1", port))
            return port
    raise OSError("no port is free")


class WishfulPilot:
    """Takes messages, and wants what ``velocity`` says."""

    def __init__(self):
        self.velocity, self.held, self.pos_w, self.fed = (0.3, 0.0, 0.0, 0.1), (), START, []
        self.place_sigma_m, self.tallies = 0.0, {name: Tally() for name in KINDS}

    def feed(self, message):
        self.fed.append(message)
        self.tallies[NAMES[type(message)]].used += 1

    def tick(self):
        return SimpleNamespace(
            velocity=np.array(self.velocity), held=self.held, leaf="FollowRoute", pos_w=np.array(self.pos_w),
            place_sigma_m=self.place_sigma_m,
        )  # fmt: skip


class FakeSub:
    """Vehicle and ground station at one socket."""

    def __init__(self, port, system=1, modes=(2, 4, 9), obeys=True):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.setblocking(False)
        self.to = ("127.0.0.1", port)
        self.system, self.modes, self.obeys = system, modes, obeys
        self.mode, self.armed, self.time_s = 19, False, 0.0
        self.told, self.raw = [], []
        self.out = mav.MAVLink(None, srcSystem=system, srcComponent=1)
        self.operator = mav.MAVLink(None, srcSystem=255, srcComponent=190)
        self.parser = mav.MAVLink(None)
        self.parser.robust_parsing = True
        self.silent = set()
        """what is not told: names of messages, or 'operator'"""
        self.volts, self.tilt, self.north, self.depth = 15.5, 0.0, 0.0, 0.8

    def send(self, message, link=None):
        self.socket.sendto(message.pack(link or self.out), self.to)
        (link or self.out).seq = ((link or self.out).seq + 1) % 256

    def speak(self, dt=0.02):
        """One step of everything that it tells."""
        self.time_s += dt
        boot, micro = round(1e3 * self.time_s), round(1e6 * self.time_s)
        heartbeat = mav.MAVLink_heartbeat_message
        armed = 128 if self.armed else 0
        far = [3000] * 72
        told = {
            "HEARTBEAT": heartbeat(12, 3, 1 | armed, self.mode, 4, 3),
            "ATTITUDE": mav.MAVLink_attitude_message(boot, self.tilt, 0.0, 0.0, 0.0, 0.0, 0.0),
            "RAW_IMU": mav.MAVLink_raw_imu_message(micro, 0, 0, -1000, 0, 0, 0, 0, 0, 0),
            "VISION_POSITION_DELTA": mav.MAVLink_vision_position_delta_message(
                micro, 20000, [0.0] * 3, [0.006, 0.0, 0.0], 100.0
            ),
            "SCALED_PRESSURE2": mav.MAVLink_scaled_pressure2_message(
                boot, 1013.25 + self.depth * 997 * 9.81 / 100, 0.0, 2000
            ),
            "OBSTACLE_DISTANCE": mav.MAVLink_obstacle_distance_message(
                micro, 3, far, 5, 20, 2999, 130 / 72, -65 + 65 / 72, 12
            ),
            "SYS_STATUS": mav.MAVLink_sys_status_message(
                0, 0, 0, 100, round(1e3 * self.volts), 500, 80, 0, 0, 0, 0, 0, 0
            ),
        }
        for name, message in told.items():
            if name not in self.silent:
                self.emit(name, message, self.out)
        if "operator" not in self.silent:
            self.emit("operator", heartbeat(6, 8, 0, 0, 4, 3), self.operator)

    def emit(self, name, message, link):
        """Send one of these; faults of a flight change it here."""
        self.send(message, link)

    def listen(self):
        """Take in what was said and obey."""
        while True:
            try:
                data = self.socket.recv(4096)
            except BlockingIOError:
                return
            self.raw.append(data)
            for message in self.parser.parse_buffer(data) or []:
                self.told.append(message)
                if message.get_type() == "COMMAND_LONG" and message.command in (176, 400):
                    self.answer(message)

    def answer(self, command):
        """Do what is commanded, or not, and say which, as ArduSub does."""
        is_mode = command.command == 176
        granted = int(command.param2) in self.modes if is_mode else self.obeys
        if granted and is_mode:
            self.mode = int(command.param2)
        elif granted:
            self.armed = command.param1 == 1
        self.send(mav.MAVLink_command_ack_message(command.command, 0 if granted else 4))

    def kinds(self):
        """Names of what it was told, those of commands with their number."""
        return [
            message.get_type() + (f" {message.command}" if message.get_type() == "COMMAND_LONG" else "")
            for message in self.told
        ]

    def moved_by(self):
        """What it was told that moves it, arms it or changes its mode."""
        still = {"HEARTBEAT", "COMMAND_LONG 511"}
        return [kind for kind in self.kinds() if kind not in still]

    def close(self):
        self.socket.close()


class Flight:
    """A vehicle, a pilot and the loop between them, step by step, without a clock."""

    def __init__(self, folder, arms=True, config=None, sub=FakeSub, **vehicle):
        self.endpoint = Endpoint(LinkPlace("127.0.0.1", 0, False))
        self.sub = sub(self.endpoint.port, **vehicle)
        self.pilot, self.now_s = WishfulPilot(), 0.0
        self.log = LinkLog(folder / "flight.mcap", {})
        plan = plan_of(self.endpoint.place, self.log.path, arms)
        self.loop = OnboardLoop(config or link_config(), self.pilot, plan, self.endpoint, self.log)

    def run(self, seconds, before=lambda step: None, farewell="", dt=0.02, stalled=0.0):
        for step in range(round(seconds / dt)):
            before(step)
            self.sub.speak(dt)
            self.now_s += dt
            self.loop.step(self.now_s, stalled, farewell)
            self.sub.listen()
        return self.loop.last

    def close(self):
        self.log.close()
        self.endpoint.close()
        self.sub.close()


def assert_within(told, limits=LIMITS):
    """Whatever a vehicle was told keeps to the limits and to the kinds of orders that there are."""
    for message in told:
        kind = message.get_type()
        if kind == "SET_POSITION_TARGET_LOCAL_NED":
            assert (message.coordinate_frame, message.type_mask) == (8, 0x5C7)
            assert math.hypot(message.vx, message.vy) <= limits.speed_m_s + 1e-6
            assert abs(message.vz) <= limits.heave_m_s + 1e-6
            assert abs(message.yaw_rate) <= limits.yaw_rate_rad_s + 1e-6
        elif kind == "MANUAL_CONTROL":
            assert max(abs(message.x), abs(message.y), abs(message.r), abs(2 * message.z - 1000)) <= 600
            assert message.buttons == 0
        elif kind == "COMMAND_LONG":
            assert message.command in (176, 400, 511)
            assert message.command != 400 or (message.param1, message.param2) == (1.0, 0.0), "never by force"
            assert message.command != 176 or message.param2 in (2.0, 4.0, 9.0)
        else:
            assert kind == "HEARTBEAT"


def plan_of(place, log, arms=True, limits=LIMITS):
    return FlightPlan(place, Mission(START, GOAL), limits, log, arms)
