"""Our water behind ArduSub's JSON interface: bytes, lockstep, restarts, axes, sensors the pilot knows."""

import dataclasses
import json
import math
import re
import socket
import struct
import threading
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav
from scipy.spatial.transform import Rotation

from tests.command import uuv
from tests.mavlink_vehicle import LIMITS, START, free_port, link_config
from tests.oracles.actuation import thrust_of_rpm
from uuvtai.common import signals
from uuvtai.common.errors import SettingError
from uuvtai.compile import launch
from uuvtai.config.loader import load_config
from uuvtai.kernels.vehicle import dynamics
from uuvtai.sim.setup import allocation_matrices
from uuvtai.vehicle import sitl
from uuvtai.vehicle.mavlink import (
    ALT_HOLD,
    GUIDED,
    LinkError,
    LinkPlace,
    MavCodec,
    arm,
    set_mode,
    set_velocity,
)
from uuvtai.vehicle.onboard import DvlReading, SonarPing
from uuvtai.vehicle.sitl import Instance, SitlPlan, SitlPort, WaterRows, frame_of, turn_of
from uuvtai.vehicle.sitl_protocol import Motion, ReportedSensors, reply_of
from uuvtai.vehicle.stand_in import StandIn
from uuvtai.vehicle.telemetry import Intake, Motors

NEUTRAL = (1500,) * 16
GOLDEN_PACKET = bytes.fromhex(
    "1a48b004070000006405dc05dc056c07dc05dc050000000000000000000000000000000000000000"
)
"""magic 18458, 1200 Hz, frame 7, channels 1380 1500 1500 1900 1500 1500 and ten that are off"""
GOLDEN_REPLY = (
    b'\n{"timestamp":1.250000,"imu":{"gyro":[0.1,-0.2,-0.3],"accel_body":[0.5,-0.25,-9.81]},'
    b'"position":[2,-3,0.8],"quaternion":[0.5,0.5,-0.5,0.5],"velocity":[0.25,0.125,-0.0625],"rng_1":0.8000,'
    b'"battery":{"voltage":16.000,"current":1.000}}\n'
)
MOTION = Motion(
    1.25, (2.0, 3.0, -0.8), (0.25, -0.125, 0.0625), (0.5, 0.5, 0.5, -0.5), (0.1, 0.2, 0.3),
    (0.5, 0.25, 9.81), 0.8,
)  # fmt: skip


def packet(count, pwm=NEUTRAL, rate=400, magic=18458):
    return struct.pack(f"<HHI{len(pwm)}H", magic, rate, count, *pwm)


# ------------------------------------------------------------------------------------------------------ bytes


def test_golden_packet():
    frame = frame_of(GOLDEN_PACKET)
    assert frame is not None and (frame.rate_hz, frame.count) == (1200, 7)
    assert frame.pwm == (1380, 1500, 1500, 1900, 1500, 1500, *(0,) * 10)
    long = frame_of(packet(9, (1500,) * 32, magic=29569))
    assert long is not None and len(long.pwm) == 32


def test_golden_reply():
    assert reply_of(MOTION) == GOLDEN_REPLY
    assert json.loads(GOLDEN_REPLY)["position"] == [2, -3, 0.8]


def ardusub_reads(line, section, key):
    """As SIM_JSON.cpp does: look for the section's text, then the key's, skip quote and colon, scan."""
    text = line.decode().strip("\n")
    at = text.index(section) + len(section) + 1
    at = text.index(key, at) + len(key) + 2
    return [
        float(value) for value in re.match(r"\[?([-+0-9.e, ]+)", text[at:])[1].split(",") if value.strip()
    ]


def test_ardusubs_parser_finds_every_key():
    """Names as in ArduPilot, libraries/SITL/SIM_JSON.h."""
    assert ardusub_reads(GOLDEN_REPLY, "", "timestamp") == [1.25]
    assert ardusub_reads(GOLDEN_REPLY, "imu", "accel_body") == [0.5, -0.25, -9.81]
    assert ardusub_reads(GOLDEN_REPLY, "", "quaternion") == [0.5, 0.5, -0.5, 0.5]
    assert ardusub_reads(GOLDEN_REPLY, "", "rng_1")[0] == 0.8
    assert GOLDEN_REPLY.startswith(b"\n") and GOLDEN_REPLY.endswith(b"\n") and b": " not in GOLDEN_REPLY


def test_a_number_that_is_not_finite_is_never_sent():
    with pytest.raises(ValueError, match="not finite"):
        reply_of(
            Motion(
                0.0, (math.nan, 0.0, 0.0), *[(0.0, 0.0, 0.0)], (1.0, 0.0, 0.0, 0.0), *[(0.0,) * 3] * 2, 1.0
            )
        )


def test_turning_over_the_axes_turns_attitudes_over():
    """A turn to port here is one against the compass there, a bow down a bow up's opposite."""
    half = math.radians(15)
    for axis, sign in ((1, 1.0), (2, -1.0), (3, -1.0)):
        quat = [math.cos(half), 0.0, 0.0, 0.0]
        quat[axis] = math.sin(half)
        turned = json.loads(reply_of(Motion(0, (0, 0, 0), (0, 0, 0), tuple(quat), (0, 0, 0), (0, 0, 0), 1)))
        quats = np.roll([quat, turned["quaternion"]], -1, axis=1)  # SciPy has w last
        ours, theirs = Rotation.from_quat(quats).as_euler("xyz")
        assert ours[axis - 1] == pytest.approx(2 * half)
        assert theirs[axis - 1] == pytest.approx(sign * 2 * half)


@pytest.mark.parametrize(
    "data",
    [
        b"", b"\x1a", GOLDEN_PACKET[:-1], GOLDEN_PACKET + b"\0", packet(1, magic=1),
        packet(1, (1500,) * 32), packet(1, magic=29569), b"\xff" * 40,
    ],
)  # fmt: skip
def test_what_is_no_packet(data):
    assert frame_of(data) is None


def test_random_packets_break_nothing():
    rng = np.random.default_rng(77001)
    motors = Motors(load_config("pool", "multibeam", "bluerov2_16v").vehicle)
    for _ in range(1000):
        data = bytearray(rng.bytes(40) if rng.random() < 0.5 else GOLDEN_PACKET)
        data[8:] = rng.bytes(len(data) - 8)
        frame = frame_of(bytes(data))
        if frame is not None:
            assert np.isfinite(motors.rpm(frame.pwm)).all() and np.abs(motors.rpm(frame.pwm)).max() <= 3465


# --------------------------------------------------------------------------------------------------- lockstep


@pytest.mark.parametrize(
    ("count", "last", "waited_s", "turn"),
    [
        (0, None, 99.0, "reset"),
        (12345, None, 99.0, "reset"),  # our side has begun anew
        (0, 12345, 99.0, "reset"),  # theirs has
        (12344, 12345, 0.0, "reset"),
        (6, 5, 0.001, "step"),
        (9, 5, 0.001, "step"),  # lost on the way; it waited for none of them
        (5, 5, 1.0, "again"),
        (5, 5, 0.001, "ignore"),
    ],
)
def test_what_a_packet_asks_for(count, last, waited_s, turn):
    assert turn_of(count, last, waited_s) == turn


class StillWater:
    """Counts what it is asked for."""

    def __init__(self):
        self.asked = Counter()
        self.outcome, self.moved_s = "", 0.0

    def begin(self, row):
        self.asked["begin"] += 1
        self.moved_s = 0.0

    def push(self, row, pwm, dt_s):
        self.asked["push"] += 1
        self.moved_s += dt_s

    def control_step(self, row):
        self.asked["control"] += 1
        return self.outcome

    def sense(self, row):
        self.asked["sense"] += 1

    def turns(self, pwm):
        return any(value not in (0, 1500) for value in pwm)

    def motion(self, row, time_s):
        return Motion(time_s, (self.moved_s, 0, -0.8), (0, 0, 0), (1, 0, 0, 0), (0, 0, 0), (0, 0, 9.81), 0.8)

    def value(self, name, row):
        beams = CONFIG.sensors.sonar.n_ray
        return {
            "ego.dvl_fresh": np.array(1), "ego.dvl_b": np.array([0.3, -0.1, 0.2]), "ego.rate_b": np.zeros(3),
            "scan.range_m": np.full(beams, 4.0), "scan.hit": np.ones(beams, int), "scan.fresh": np.array(1),
            "clock.step": np.array(7), "scan.ping_step": np.array(7),
        }[name]  # fmt: skip


CONFIG = link_config()
TURNING = (1500, 1600) + (1500,) * 14


def time_of(reply):
    return json.loads(reply)["timestamp"]


def test_lockstep():
    water = StillWater()
    one = Instance(CONFIG, water, 0)
    replies = [one.answer(packet(count, TURNING), 0.01 * count)[0] for count in range(40)]
    assert [time_of(reply) for reply in replies] == pytest.approx(np.arange(1, 41) / 400)
    assert water.asked["push"] == 40 and water.asked["control"] == 6, (
        "a control step is 20 ms: at 0, 20, .. 100"
    )
    assert one.answer(packet(39, TURNING), 0.391) == (b"", []), "doubled"
    assert one.answer(packet(39, TURNING), 2.0)[0] == replies[-1], "the answer was lost"
    assert water.asked["push"] == 40
    assert time_of(one.answer(packet(45, TURNING), 2.1)[0]) == pytest.approx(41 / 400)
    assert one.answer(b"nonsense", 2.2) == (b"", [])
    again = one.answer(packet(0, TURNING), 3.0)[0]
    assert again == replies[0] and water.asked["begin"] == 2, "ArduSub has begun anew"
    assert one.document()["packets"] == {"step": 40, "reset": 2, "again": 1, "ignore": 1, "bad": 1}


@pytest.mark.parametrize(
    "rate", [0, 16959, 65535]
)  # the second by a real ArduSub, which then waited for ever
def test_a_rate_that_is_not_believed_is_the_last_one(rate):
    one = Instance(CONFIG, StillWater(), 0)
    assert one.answer(packet(0, rate=rate), 0.0) == (b"", []) and one.counts["bad"] == 1
    one.answer(packet(0), 0.0)
    assert time_of(one.answer(packet(1, rate=rate), 0.01)[0]) == pytest.approx(2 / 400)


def test_the_vehicle_is_held_until_a_thruster_turns():
    water = StillWater()
    one = Instance(CONFIG, water, 0)
    for count in range(400):
        one.answer(packet(count), 0.0)
    assert (water.asked["push"], water.asked["control"]) == (0, 0) and water.asked["sense"] == 51
    assert one.document()["outcome"] == "waiting" and one.time_s == pytest.approx(1.0)
    one.answer(packet(400, TURNING), 0.0)
    one.answer(packet(401), 0.0)
    assert water.asked["push"] == 2 and one.document()["outcome"] == "running"
    water.outcome = "success"
    for count in range(402, 420):
        one.answer(packet(count), 0.0)
    water.outcome = "collision"
    for count in range(420, 440):
        one.answer(packet(count), 0.0)
    assert one.outcome == "success", "the first ending counts"


def test_sensors_speak_as_the_real_ones_and_the_pilot_understands():
    one = Instance(CONFIG, StillWater(), 0)
    said = [order for count in range(400) for order in one.answer(packet(count), 0.0)[1]]
    assert Counter(order.kind for order in said) == {
        "VISION_POSITION_DELTA": 11, "OBSTACLE_DISTANCE": 11, "DISTANCE_SENSOR": 11
    }  # fmt: skip
    intake, codec, found = Intake(CONFIG, START, 0.0), MavCodec(1, 197), []
    for order in said[-3:]:
        (message,) = MavCodec(1, 191).decode(codec.encode(order))
        found += intake.take(message.name, message.system, message.component, message.fields, 1.0)
    dvl, ping = found
    assert isinstance(dvl, DvlReading) and dvl.vel_b == pytest.approx([0.3, -0.1, 0.2], abs=1e-6)
    assert isinstance(ping, SonarPing) and set(ping.range_m) == {4.0} and ping.hit.all()
    altitude = mav.MAVLink(None).parse_buffer(codec.encode(said[-1]))[0]
    assert (altitude.orientation, altitude.current_distance) == (25, 80)
    assert not intake.heard.refused


def test_a_sensor_that_has_lost_the_bottom_says_nothing():
    sensors = ReportedSensors(CONFIG)
    water = StillWater()
    said = sensors.report(
        0.0, 0.8, lambda name: np.array(0) if name == "ego.dvl_fresh" else water.value(name, 0)
    )
    assert "VISION_POSITION_DELTA" not in {order.kind for order in said}


@pytest.mark.parametrize("waits", range(5))
def test_readings_are_told_when_they_are_taken(waits):
    """However long the water has waited for the vehicle; a sonar that is a step late tells of its ping."""
    sensors, water, told = ReportedSensors(CONFIG), StillWater(), Counter()
    for step in range(50):
        clock = max(0, step - waits)
        now = {
            "ego.dvl_fresh": clock % 5 == 0,
            "scan.fresh": clock % 5 == 1 or clock == 0,
            "clock.step": clock,
        }
        now["scan.ping_step"] = max(0, clock - 1)
        for order in sensors.report(
            0.02 * step,
            0.8,
            lambda name, now=now: np.array(now[name]) if name in now else water.value(name, 0),
        ):
            told[order.kind] += 1
            if order.kind == "OBSTACLE_DISTANCE" and clock:
                assert order.fields["time_usec"] == pytest.approx(20_000 * (step - 1), abs=1)
    assert told["VISION_POSITION_DELTA"] >= 9 and told["OBSTACLE_DISTANCE"] >= 9


@pytest.mark.parametrize("own", [(), ("dvl",), ("sonar",), ("dvl", "sonar")])
def test_what_speaks_for_itself_alone_is_not_told_by_mavlink(own):
    """With an emulated DVL the sonar still has to be heard."""
    water, kinds = StillWater(), {"dvl": "VISION_POSITION_DELTA", "sonar": "OBSTACLE_DISTANCE"}
    said = ReportedSensors(CONFIG, own).report(0.0, 0.8, lambda name: water.value(name, 0))
    told = {order.kind for order in said}
    assert told >= {"DISTANCE_SENSOR"} and {name for name in kinds if kinds[name] not in told} == set(own)


# -------------------------------------------------------------------------------------------------- thrusters


def pulses(**asked):
    """Channels of frame VECTORED, roll to lateral in parts of a full stick: PWM = 1500 + 400 x thrust."""
    factors = [
        (0, 0, 1, 0, -1, 1), (0, 0, -1, 0, -1, -1), (0, 0, -1, 0, 1, 1), (0, 0, 1, 0, 1, -1),
        (1, 0, 0, -1, 0, 0), (-1, 0, 0, -1, 0, 0),
    ]  # fmt: skip
    names = ("roll", "pitch", "yaw", "throttle", "forward", "lateral")
    outputs = [sum(f * asked.get(name, 0.0) for f, name in zip(row, names, strict=True)) for row in factors]
    return tuple(round(1500 + 400 * max(-1.0, min(1.0, out))) for out in outputs) + (1500,) * 10


def test_pulse_and_speed_are_the_makers():
    motors = Motors(load_config("pool", "multibeam", "bluerov2_16v").vehicle)
    assert motors.rpm(NEUTRAL) == pytest.approx(np.zeros(6))
    assert motors.rpm((1524,) * 16) == pytest.approx(np.zeros(6)), "dead band"
    assert motors.rpm((0,) * 16) == pytest.approx(np.zeros(6)), "a channel that is off"
    assert np.abs(motors.rpm((1900,) * 16)) == pytest.approx(np.full(6, 3465.0)), "one limit both ways"
    assert np.abs(motors.rpm((1420,) * 16)) == pytest.approx(np.full(6, 1016.0))


@pytest.mark.parametrize(("axis", "name"), [(0, "forward"), (1, "lateral")])
@pytest.mark.parametrize("speed", [0.3, 0.45, 0.6])
def test_the_example_feeds_forward_what_the_vehicle_needs(axis, name, speed):
    """ArduSub makes of an acceleration an angle, and of its share of ANGLE_MAX (45 degrees) a thrust."""
    text = (Path(__file__).parents[2] / "examples/ardusub.parm").read_text()
    gain = float(text.partition("PSC_VELXY_FF ")[2].partition("\n")[0])
    vehicle = load_config("pool", "multibeam", "bluerov2_16v").vehicle
    share = math.degrees(math.atan(gain * speed / 9.81)) / 45.0
    thrust_n = thrust_of_rpm(Motors(vehicle).rpm(pulses(**{name: share})), vehicle)
    force_n = abs(float(allocation_matrices(vehicle)[0][axis] @ thrust_n))
    linear, quadratic = vehicle.linear_damping[axis], vehicle.quadratic_damping[axis]
    reached = (math.sqrt(linear**2 + 4 * quadratic * force_n) - linear) / (2 * quadratic)
    assert 0.6 < reached / speed < 1.2, "the feedback does the rest"


def test_frames_that_ardusub_does_not_have_are_refused():
    vehicle = load_config("pool", "multibeam", "bluerov2_16v").vehicle
    with pytest.raises(SettingError, match="5 thrusters"):
        Motors(vehicle.model_copy(update={"thrusters": vehicle.thrusters[:5]}))
    with pytest.raises(SettingError, match="do not sit"):
        Motors(vehicle.model_copy(update={"thrusters": vehicle.thrusters[:1] * 6}))
    assert sorted(Motors(load_config("pool", "multibeam", "bluerov2_heavy").vehicle).channel) == list(
        range(8)
    )


@pytest.fixture
def water(small):
    return WaterRows(small.sim, seed=77001, first=3)


@pytest.mark.parametrize(
    ("asked", "index", "sign"),
    [
        ({"forward": 0.3}, 0, 1),
        ({"forward": -0.3}, 0, -1),
        ({"lateral": 0.3}, 1, 1),
        ({"lateral": -0.3}, 1, -1),
        ({"throttle": 0.3}, 2, -1),
        ({"throttle": -0.3}, 2, 1),
        ({"yaw": 0.2}, 5, 1),
        ({"yaw": -0.2}, 5, -1),
        ({"roll": 0.5}, 3, 1),
        ({"roll": -0.5}, 3, -1),
    ],
)
def test_what_ardusub_asks_for_is_what_the_vehicle_does(water, asked, index, sign):
    """In ArduSub's axes: ahead, right and down; roll right side down, turn to starboard."""
    water.begin(2)
    for _ in range(10 if "roll" in asked else 100):  # the ideal hold turns a roll back
        water.push(2, pulses(**asked), 0.0025)
    vel, rate = water.value("vehicle.vel_b", 2), water.value("vehicle.rate_b", 2)
    motion = np.array([vel[0], -vel[1], -vel[2], rate[0], -rate[1], -rate[2]])
    rest = motion - np.array([0, 0, -0.02, 0, 0, 0])  # it floats up a little
    assert sign * rest[index] > 0.01
    assert np.abs(np.delete(rest, [index, 4])).max() < 0.5 * abs(rest[index]) + 0.02


def test_a_step_is_a_step_of_the_simulators_own_dynamics(small, water):
    """And no other row moves by a bit."""
    for row in (2, 5):
        water.begin(row)
    before = small.arrays("vehicle")
    for _ in range(8):
        water.push(2, pulses(forward=0.4, yaw=0.1), 0.0025)
    after = small.arrays("vehicle")
    for name, value in after.items():
        others = [row for row in range(small.N) if row != 2]
        assert np.array_equal(value[others], before[name][others]), name
    water.begin(5)
    water._wake(5)
    water._rpm[5, :6] = water.motors.rpm(pulses(forward=0.4, yaw=0.1))
    dynamics.move_vehicle(small.sim.io.dynamics, 0.02, 8)
    for name in ("vehicle.vel_b", "vehicle.rate_b"):
        assert water.value(name, 5) == pytest.approx(water.value(name, 2), abs=1e-5)


def test_a_step_is_launched_again_without_another_look(water, monkeypatch):
    """A kernel looks at arguments that it has not seen, by identity: 10 ms instead of 0.1."""
    looked = []
    first = launch._first
    monkeypatch.setattr(launch, "_first", lambda *given: looked.append(given) or first(*given))
    water.begin(4)
    water.push(4, NEUTRAL, 1.0 / 400)
    before = len(looked)
    for rate in (400.0, 400, 400.0):
        water.push(4, NEUTRAL, 1.0 / rate)
    assert len(looked) == before


def test_an_episode_begins_as_uuv_eval_has_it_and_the_referee_judges(small, water):
    water.begin(2)
    start = water.motion(2, 0.0).pos_w
    small.begin([5], seed=77001)
    assert small.sim.rows(small.sim.s.mission.start_w, [0])[0] == pytest.approx(start, abs=1e-6)
    water.begin(2)
    ended = ""
    for _ in range(3000):
        for _ in range(2):
            water.push(2, pulses(forward=1.0), 0.01)
        ended = ended or water.control_step(2)
        if ended:
            break
    assert ended in ("collision", "ttc", "out_of_tank", "success"), "straight ahead at full speed"
    water.begin(2)
    assert water.motion(2, 0.0).pos_w == pytest.approx(start), "begun anew"
    water.sense(2)
    assert water.value("scan.hit", 2).sum() > 10


def test_at_rest_the_accelerometer_feels_gravity(water):
    water.begin(1)
    force = json.loads(reply_of(water.motion(1, 0.0)))["imu"]["accel_body"]
    assert force == pytest.approx([0, 0, -water.config.vehicle.gravity_m_s2], abs=1e-4)


def test_the_x_axis_looks_where_the_tank_says(water):
    """ArduSub's compass and place by north; uuv pilot with the tank's heading is back in our axes."""
    water.begin(2)
    for _ in range(40):
        water.push(2, pulses(forward=0.5, yaw=0.3), 0.0025)
    ours = water.motion(2, 0.0)
    world = water.config.world
    tank = world.tank.model_copy(update={"heading_deg": 120.0})
    water.config = water.config.model_copy(update={"world": world.model_copy(update={"tank": tank})})
    theirs, intake = json.loads(reply_of(water.motion(2, 0.0))), Intake(CONFIG, (0, 0, 0), math.radians(120))
    quat = Rotation.from_quat(np.roll(theirs["quaternion"], -1))
    roll, pitch, yaw = quat.as_euler("xyz")
    rates = dict.fromkeys(("rollspeed", "pitchspeed", "yawspeed"), 0.0)
    (imu,) = intake.take("ATTITUDE", 1, 1, {"roll": roll, "pitch": pitch, "yaw": yaw, **rates}, 0.0)
    assert imu.rpy == pytest.approx(Rotation.from_quat(np.roll(ours.quat_wb, -1)).as_euler("xyz"), abs=1e-6)
    cos, sin = math.cos(math.radians(120)), math.sin(math.radians(120))
    for name, (x, y, z) in (("position", ours.pos_w), ("velocity", ours.vel_w)):
        assert theirs[name] == pytest.approx([x * cos + y * sin, x * sin - y * cos, -z], abs=1e-6)


# ---------------------------------------------------------------------------------------------------- sockets


class Served:
    """A port with still water on a thread of its own."""

    def __init__(self, places=()):
        self.number = free_port()
        plan = SitlPlan(port=self.number, places=places)
        self.port = SitlPort(plan, Instance(CONFIG, StillWater(), 0), 0)
        self.port.socket.setblocking(True)
        self.port.socket.settimeout(0.05)
        self._go = True
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self):
        now = 0.0
        while self._go:
            now += 0.001
            self.port.serve(now)

    def close(self):
        self._go = False
        self._thread.join()
        self.port.close()


@pytest.fixture
def served():
    made = []

    def make(**given):
        made.append(Served(**given))
        return made[-1]

    yield make
    for one in made:
        one.close()


def client():
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.bind(("127.0.0.1", 0))
    made.settimeout(5)
    return made


def test_packets_by_socket_and_a_second_client_is_not_answered(served):
    one = served()
    ardusub, stranger = client(), client()
    for count in range(5):
        ardusub.sendto(packet(count, TURNING), ("127.0.0.1", one.number))
        assert time_of(ardusub.recv(4096)) == pytest.approx((count + 1) / 400)
    stranger.settimeout(0.2)
    stranger.sendto(packet(0, TURNING), ("127.0.0.1", one.number))
    with pytest.raises(TimeoutError):
        stranger.recv(4096)
    ardusub.sendto(packet(5, TURNING), ("127.0.0.1", one.number))
    assert time_of(ardusub.recv(4096)) == pytest.approx(6 / 400)
    for made in (ardusub, stranger):
        made.close()


def test_who_speaks_to_the_sensors_port_is_told(served):
    listener = client()
    sensors = free_port()
    one = served(
        places=(
            LinkPlace("127.0.0.1", sensors, False),
            LinkPlace("127.0.0.1", listener.getsockname()[1], True),
        )
    )
    autopilot, ardusub = client(), client()
    autopilot.sendto(b"\0", ("127.0.0.1", sensors))
    for count in range(60):
        ardusub.sendto(packet(count), ("127.0.0.1", one.number))
        ardusub.recv(4096)
    for made in (autopilot, listener):
        names = {mav.MAVLink(None).parse_buffer(made.recv(4096))[0].get_type() for _ in range(3)}
        assert names == {"VISION_POSITION_DELTA", "OBSTACLE_DISTANCE", "DISTANCE_SENSOR"}
    for made in (autopilot, listener, ardusub):
        made.close()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--instances", "0"], "--instances 0"),
        (["--instances", "65"], "--instances 65"),
        (["--instances", "9", "--port", "65500"], "beyond 65535"),
        (["--instances", "10", "--as", "ping360"], "from 9092 up; --port 9003"),
        (["--seconds", "0"], "--seconds 0"),
        (["--rate", "-1"], "--rate"),
        (["--mavlink", "tcp:x:1"], "udp:HOST:PORT"),
    ],
)
def test_what_makes_no_sense_is_refused(capfd, words, says):
    code, _out, err = uuv(capfd, "sitl", *words)
    assert code == 2 and says in err


def test_the_water_waits_for_the_clock(served, monkeypatch):
    port, slept = served().port, []
    monkeypatch.setattr(sitl.time, "sleep", slept.append)
    monkeypatch.setattr(sitl.time, "monotonic", lambda: 100.0)
    port.paced_from_s = 100.0
    port.instance.time_s = 0.05
    sitl._pace(port, 0.0)
    assert slept == []
    sitl._pace(port, 0.5)
    assert slept == pytest.approx([0.1]), "0.05 s of water take 0.1 s of the clock at half the pace"
    port.instance.time_s = 50.0
    sitl._pace(port, 1.0)
    assert len(slept) == 1 and port.paced_from_s == 50.0, "begun anew, or held up: nothing to catch up with"


def test_an_interrupted_water_tells_what_happened(capfd, monkeypatch, small):
    """A signal ends a command at once unless that has said that there is something to do."""

    def stopped(*_):
        assert signals._engaged
        raise signals.Interrupted

    monkeypatch.setattr(signals, "_engaged", [])
    monkeypatch.setattr(sitl, "Sim", lambda config, rows, tree: small.sim)
    monkeypatch.setattr(sitl, "_serve", stopped)
    place = ["--port", str(free_port()), "--mavlink", "udpout:127.0.0.1:9", "--json"]
    code, out, err = uuv(capfd, "sitl", *place)
    assert code == 0 and "interrupted" in err and len(json.loads(out)["instances"]) == 1


@pytest.mark.parametrize("words", [["--json"], []])
def test_the_command_serves_and_tells(capfd, monkeypatch, small, words):
    monkeypatch.setattr(sitl, "Sim", lambda config, rows, tree: small.sim)
    number = free_port()
    place = ["--port", str(number), "--mavlink", "udpout:127.0.0.1:9", "--seconds", "0.2"]
    monkeypatch.setattr(sitl, "FakeRig", lambda *_: SimpleNamespace(speaks=(), close=lambda: None))
    code, out, err = uuv(capfd, "sitl", *place, "--as", "a50,ping360", *words)
    assert code == 0 and f"physics for ArduSub at UDP 127.0.0.1:{number}" in err
    assert "--heading 0 --dvl a50:127.0.0.1:16171 --sonar ping360:127.0.0.1:9092\n" in err
    if words:
        assert json.loads(out)["instances"][0]["outcome"] == "waiting"
    else:
        assert "waiting" in out


def test_an_autopilot_of_ours_stands_in(capfd, monkeypatch, small):
    monkeypatch.setattr(sitl, "Sim", lambda config, rows, tree: small.sim)
    stranger, number = client(), free_port()
    stranger.sendto(packet(0, TURNING), ("127.0.0.1", number))
    heard = client()
    pilot = heard.getsockname()[1]
    words = ["--port", str(number), "--seconds", "0.5", "--operator", "--as", f"autopilot:{pilot}", "--json"]
    code, out, err = uuv(capfd, "sitl", *words)
    assert code == 0 and "a small autopilot waits for uuv pilot" in err
    assert f"--heading 0 --mavlink udp:127.0.0.1:{pilot} --system 1\n" in err
    (found,) = json.loads(out)["instances"]
    assert found["packets"]["bad"] == 0 and found["packets"]["reset"] == 1, "nobody else drives"
    assert 0.0 < found["seconds"] < 0.7 and found["outcome"] == "waiting", "by the clock"
    names = {mav.MAVLink(None).parse_buffer(heard.recv(4096))[0].get_type() for _ in range(20)}
    assert names >= {"ATTITUDE", "RAW_IMU", "LOCAL_POSITION_NED", "SCALED_PRESSURE2", "OBSTACLE_DISTANCE"}
    for one in (heard, stranger):
        one.close()


@pytest.mark.parametrize("thrusters", [6, 8])
def test_the_stand_in_drives_as_guided_asks_and_forgets_it(thrusters):
    pilot = client()
    one = StandIn(pilot.getsockname(), thrusters=thrusters)
    codec, there = MavCodec(1, 191), one._endpoint.port

    def lived(seconds, *orders):
        for order in orders:
            pilot.sendto(codec.encode(order), ("127.0.0.1", there))
        for _ in range(round(200 * seconds)):
            pulses = frame_of(one.frame()).pwm[:thrusters]
            rest = (0.0, 0.0, 0.0)
            still = Motion(one.time_s + 0.02, rest, rest, (1.0, 0.0, 0.0, 0.0), rest, (0.0, 0.0, 9.8), 1.0)
            one.take(reply_of(still))
        return pulses

    ahead = set_velocity((0.3, 0.0, 0.0, 0.0), 0.0, 1, LIMITS)
    assert set(lived(0.1, ahead)) == {1500}, "neither armed nor in GUIDED"
    assert set(lived(0.1, set_mode(GUIDED, 1))) == {1500}
    driven = max(lived(2.8, arm(1)))
    assert driven > 1700 and max(lived(0.4)) < driven, "what was asked for 3 s ago is asked no more"
    broken = dataclasses.replace(ahead, fields=ahead.fields | {"vx": math.nan})
    assert max(lived(0.1, ahead)) >= driven and max(lived(0.1, broken, set_mode(77, 1))) >= driven
    assert max(lived(0.1, set_mode(ALT_HOLD, 1))) < driven
    pilot.close()
    one.close()


def test_a_port_that_is_taken_is_told():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        plan = SitlPlan(port=taken.getsockname()[1])
        with pytest.raises(LinkError, match="another uuv sitl may run"):
            SitlPort(plan, Instance(CONFIG, StillWater(), 0), 0)
