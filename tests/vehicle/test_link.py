"""The stack on MAVLink: bytes, meaning, every failsafe against pymavlink's vehicle, and strangers."""

import dataclasses
import json
import math
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from tests.command import uuv
from tests.mavlink_vehicle import (
    GOAL,
    LIMITS,
    START,
    FakeSub,
    Flight,
    WishfulPilot,
    assert_within,
    free_port,
    link_config,
    plan_of,
)
from uuvtai.logs.reader import read_messages
from uuvtai.vehicle import control_loop, mavlink
from uuvtai.vehicle.control_loop import OnboardLoop
from uuvtai.vehicle.mavlink import LONGEST, Endpoint, LinkError, LinkPlace, MavCodec, place_of
from uuvtai.vehicle.onboard import DvlReading, ImuReading, PositionFix, PressureReading, SonarPing
from uuvtai.vehicle.telemetry import (
    KINDS,
    MOST_KINDS,
    Heard,
    Intake,
    Senders,
    ping_of,
    sectors_of,
    waiting_for,
)

DT = 0.02
_DELTA = {"time_delta_usec": 100_000, "angle_delta": [0.0] * 3, "confidence": 100.0}
COARSE = 0.1
"""[s] of a step where no step of its own counts"""
CONFIG = link_config()


@pytest.fixture
def flight(tmp_path):
    made = []

    def make(**given):
        made.append(Flight(tmp_path, **given))
        return made[-1]

    yield make
    for one in made:
        one.close()


# ------------------------------------------------------------------------------------------------------ bytes


def test_golden_bytes():
    """Packed by hand here, by MAVLink's own description: header, payload in order of size, checksum X.25."""
    order = mavlink.set_velocity((0.3, -0.1, 0.05, 0.25), 1.5, 1, LIMITS)
    payload = struct.pack(
        "<I11fHBBB", 1500, 0, 0, 0, 0.3, 0.1, -0.05, 0, 0, 0, 0, -0.25, 0x5C7, 1, 1, 8
    )  # fmt: skip
    assert MavCodec(1, 191).encode(order) == framed(payload, 84, 143, 1, 191)
    stick = mavlink.push_sticks((0.25, 0.1, 0.06, -0.4), None, 1, LIMITS)
    payload = struct.pack("<4hHB", 150, -60, 530, 120, 0, 1)
    assert MavCodec(1, 191).encode(stick) == framed(payload, 69, 243, 255, 191)
    payload = struct.pack("<7fHBBB", 1, 4, 0, 0, 0, 0, 0, 176, 1, 1, 0)
    assert MavCodec(1, 191).encode(mavlink.set_mode(4, 1)) == framed(payload, 76, 152, 1, 191)
    payload = struct.pack("<7fHBBB", 1, 0, 0, 0, 0, 0, 0, 400, 1, 1, 0)
    assert MavCodec(1, 191).encode(mavlink.arm(1)) == framed(payload, 76, 152, 1, 191)


def framed(payload, number, extra, system, component):
    """A packet of MAVLink 2: trailing zeros of the payload are left out."""
    payload = payload.rstrip(b"\0") or payload[:1]
    head = struct.pack("<BBBBBBB", len(payload), 0, 0, 0, system, component, number) + bytes(2)
    crc = 0xFFFF
    for byte in head + payload + bytes([extra]):
        mixed = byte ^ (crc & 0xFF)
        mixed = (mixed ^ (mixed << 4)) & 0xFF
        crc = (crc >> 8) ^ (mixed << 8) ^ (mixed << 3) ^ (mixed >> 4)
    return b"\xfd" + head + payload + struct.pack("<H", crc & 0xFFFF)


def test_what_is_asked_for_is_what_a_client_reads():
    message = mav.MAVLink(None).parse_buffer(
        MavCodec(1, 191).encode(mavlink.set_velocity((9.0, 0.0, 9.0, -9.0), 0.0, 1, LIMITS))
    )[0]
    assert (message.vx, message.vy, message.get_srcComponent()) == (0.5, 0.0, 191)
    assert (message.vz, message.yaw_rate) == (pytest.approx(-0.3), pytest.approx(0.8))
    assert_within([message])


def test_sticks_push_harder_where_the_vehicle_lags():
    asked = (0.3, 0.0, 0.0, 0.0)
    alone = mavlink.push_sticks(asked, None, 1, LIMITS).fields["x"]
    slow = mavlink.push_sticks(asked, (0.1, 0.0, 0.0, 0.0), 1, LIMITS).fields["x"]
    fast = mavlink.push_sticks(asked, (0.9, 0.0, 0.0, 0.0), 1, LIMITS).fields["x"]
    most = round(mavlink.STICK * LIMITS.speed_m_s / mavlink.FULL_STICK[0])
    assert (alone, slow, most) == (180, 300, 300) and fast < 0
    assert mavlink.push_sticks(asked, (math.nan,) * 4, 1, LIMITS).fields["x"] == alone
    assert mavlink.push_sticks(asked, (-1e9,) * 4, 1, LIMITS).fields["x"] == most, "whatever is measured"


# ---------------------------------------------------------------------------------------------------- meaning


def taken(intake, name, come_s=0.0, system=1, component=1, **fields):
    return intake.take(name, system, component, fields, come_s)


def attitude(intake, yaw=0.0, come_s=0.0, **fields):
    given = {"roll": 0.1, "pitch": 0.2, "yaw": yaw, "rollspeed": 0.01, "pitchspeed": 0.02, "yawspeed": 0.03}
    return taken(intake, "ATTITUDE", come_s, **({"time_boot_ms": round(1e3 * come_s)} | given | fields))


@pytest.fixture
def intake():
    return Intake(CONFIG, START, 0.0)


def test_axes_of_the_attitude():
    """A bow up and a turn to starboard are positive there, a bow down and a turn to port here."""
    intake = Intake(CONFIG, START, math.radians(30))
    (imu,) = attitude(intake, yaw=math.radians(50))
    assert isinstance(imu, ImuReading)
    assert imu.rpy == pytest.approx([0.1, -0.2, math.radians(-20)])
    assert imu.rate_b == pytest.approx([0.01, -0.02, -0.03])
    gravity = CONFIG.vehicle.gravity_m_s2
    assert np.linalg.norm(imu.specific_force_b) == pytest.approx(gravity) and imu.specific_force_b[0] > 0
    taken(intake, "RAW_IMU", time_usec=0, xacc=100, yacc=200, zacc=-1000)
    (imu,) = attitude(intake)
    assert imu.specific_force_b == pytest.approx([0.980665, -1.96133, 9.80665])


def test_the_first_look_is_along_the_worlds_x_axis():
    intake = Intake(CONFIG, START, None)
    assert attitude(intake, yaw=2.0)[0].rpy[2] == 0
    assert attitude(intake, yaw=2.5)[0].rpy[2] == pytest.approx(-0.5)


def test_axes_of_velocity_depth_and_position():
    intake = Intake(link_config(**{"sensors.localization": "truth"}), START, math.radians(90))
    attitude(intake, yaw=math.radians(90))
    delta = {"time_delta_usec": 100000, "angle_delta": [0.0] * 3, "confidence": 90.0, "time_usec": 0}
    (dvl,) = taken(intake, "VISION_POSITION_DELTA", position_delta=[0.03, 0.01, -0.02], **delta)
    assert isinstance(dvl, DvlReading) and dvl.vel_b == pytest.approx([0.3, -0.1, 0.2])
    place = {"vx": 0.0, "vy": 0.5, "vz": 0.1}
    (first,) = taken(intake, "LOCAL_POSITION_NED", x=5.0, y=7.0, z=1.0, time_boot_ms=0, **place)
    assert first.pos_w == pytest.approx(START)
    found = taken(intake, "LOCAL_POSITION_NED", 2.0, x=5.0, y=8.0, z=1.5, time_boot_ms=2000, **place)
    assert isinstance(found[0], PositionFix)
    assert found[0].pos_w == pytest.approx([3.0, 3.0, -1.3]), "east is ahead, down is down"
    assert found[1].vel_b == pytest.approx([0.5, 0.0, -0.1]), "no DVL for two seconds"


BLUEOS = mav.MAVLink(None, srcSystem=255, srcComponent=0)
SPEED = mav.MAVLink_vision_speed_estimate_message(7_000_000, 0.3, 0.1, -0.2)
DELTA = mav.MAVLink_vision_position_delta_message(0, 116_000, [0.0] * 3, [0.0348, 0.0116, -0.0232], 98.0)
PLACES = (
    mav.MAVLink_global_vision_position_estimate_message(9_000, 1.0, 2.0, 0.1, 0.0, 0.0, 1.6),
    mav.MAVLink_vision_position_estimate_message(9_000, 1.0, 2.0, 0.1, 0.0, 0.0, 1.6),
)


def from_blueos(intake, message, come_s):
    """As the extension of a DVL in BlueOS sends it, through the codec."""
    (found,) = MavCodec(1, 191).decode(message.pack(BLUEOS))
    return intake.take(found.name, found.system, found.component, found.fields, come_s)


@pytest.mark.parametrize("message", [DELTA, SPEED])
def test_a_dvl_of_blueos_tells_its_velocity_in_body_axes(message):
    """Whatever the heading; the autopilot's own estimate counts no more then."""
    intake = Intake(CONFIG, START, 0.0)
    attitude(intake, yaw=math.radians(120))
    (dvl,) = from_blueos(intake, message, 4.0)
    assert dvl.time_s == 4.0 and dvl.vel_b == pytest.approx([0.3, -0.1, 0.2])
    assert intake.heard.vel_b == pytest.approx((0.3, -0.1, 0.2))
    place = {"time_boot_ms": 4000, "x": 0.0, "y": 0.0, "z": 0.0, "vx": 9.0, "vy": 9.0, "vz": 9.0}
    assert taken(intake, "LOCAL_POSITION_NED", 4.0, **place) == []


@pytest.mark.parametrize("message", PLACES)
def test_a_dvl_of_blueos_that_tells_places_leaves_velocity_to_the_autopilot(message):
    intake = Intake(CONFIG, START, math.radians(90))
    attitude(intake, yaw=math.radians(90))
    assert from_blueos(intake, message, 4.0) == []
    assert "set the DVL to POSITION_DELTA" in intake.heard.left_out()
    place = {"time_boot_ms": 4000, "x": 0.0, "y": 0.0, "z": 0.0, "vx": 0.0, "vy": 0.5, "vz": 0.1}
    (dvl,) = taken(intake, "LOCAL_POSITION_NED", 4.0, **place)
    assert dvl.vel_b == pytest.approx([0.5, 0.0, -0.1])


def test_a_speed_of_others_is_north_east_down_and_not_heard(intake):
    fields = SPEED.to_dict()
    assert intake.take("VISION_SPEED_ESTIMATE", 1, 197, fields, 0.0) == []
    assert "VISION_SPEED_ESTIMATE of 1/197 (heard by --sender dvl=1/197)" in intake.heard.left_out()


def test_a_start_that_is_corrected_moves_and_turns_what_is_told():
    intake = Intake(link_config(**{"sensors.localization": "truth"}), START, math.radians(90))
    attitude(intake, yaw=math.radians(90))
    place = {"vx": 0.0, "vy": 0.5, "vz": 0.0, "y": 7.0, "z": 0.0}
    taken(intake, "LOCAL_POSITION_NED", x=5.0, time_boot_ms=0, **place)
    assert intake.correct((2.4, 3.1), math.radians(90)) == (2.4, 3.1, START[2])
    assert attitude(intake, yaw=math.radians(90))[0].rpy[2] == pytest.approx(math.radians(90))
    taken(intake, "LOCAL_POSITION_NED", 2.0, x=5.0, time_boot_ms=2000, **place)
    found = taken(intake, "LOCAL_POSITION_NED", 4.0, x=6.0, time_boot_ms=4000, **place)
    assert found[0].pos_w == pytest.approx([1.4, 3.1, START[2]]), "the x axis looks to the south now"
    assert found[1].vel_b == pytest.approx([0.5, 0.0, 0.0]), "to the east is still ahead"


def test_the_height_of_a_position_is_the_pressure_sensors():
    """The autopilot's own lags: ArduSub's by 0.24 m after two seconds of climbing."""
    intake = Intake(link_config(**{"sensors.localization": "truth"}), START, math.radians(90))
    attitude(intake, yaw=math.radians(90))
    place = {"vx": 0.0, "vy": 0.0, "vz": 0.0, "x": 0.0, "y": 0.0}
    rest = {"press_diff": 0.0, "temperature": 20}
    taken(intake, "SCALED_PRESSURE2", press_abs=1100.0, time_boot_ms=0, **rest)
    taken(intake, "LOCAL_POSITION_NED", z=0.0, time_boot_ms=0, **place)
    hpa = CONFIG.vehicle.water_density_kg_m3 * CONFIG.vehicle.gravity_m_s2 / 100
    taken(intake, "SCALED_PRESSURE2", 1.0, press_abs=1100.0 - 0.5 * hpa, time_boot_ms=1000, **rest)
    found = taken(intake, "LOCAL_POSITION_NED", 1.0, z=-0.2, time_boot_ms=1000, **place)
    assert found[0].pos_w[2] == pytest.approx(START[2] + 0.5)
    later = taken(intake, "LOCAL_POSITION_NED", 4.0, z=-0.2, time_boot_ms=4000, **place)
    assert later[0].pos_w[2] == pytest.approx(START[2] + 0.2), "an old depth tells nothing"


def test_depths_by_turns_early_and_late_make_no_jumps():
    """Climbing by 0.4 m/s while the sensor's values are 10 and 90 ms old by turns."""
    intake = Intake(link_config(**{"sensors.localization": "truth"}), START, math.radians(90))
    attitude(intake, yaw=math.radians(90))
    place = {"vx": 0.0, "vy": 0.0, "vz": 0.0, "x": 0.0, "y": 0.0, "z": 0.0}
    hpa = CONFIG.vehicle.water_density_kg_m3 * CONFIG.vehicle.gravity_m_s2 / 100
    rest, climb = {"press_diff": 0.0, "temperature": 20}, {"position_delta": [0.0, 0.0, -0.04]}
    heights = []
    for tick in range(60):
        now_s = 0.05 * tick
        stamp = {"time_boot_ms": round(1e3 * now_s)}
        if tick % 2 == 0:
            taken(intake, "VISION_POSITION_DELTA", now_s, **climb, **_DELTA, time_usec=round(1e6 * now_s))
            risen_m = 0.4 * max(0.0, now_s - (0.01, 0.09)[tick // 2 % 2])
            taken(intake, "SCALED_PRESSURE2", now_s, press_abs=1100.0 - risen_m * hpa, **rest, **stamp)
        (found, *_) = taken(intake, "LOCAL_POSITION_NED", now_s, **place, **stamp)
        heights.append(found.pos_w[2] - START[2])
    off = np.array(heights) - 0.4 * 0.05 * np.arange(60)
    assert np.abs(off).max() < 0.04 and np.abs(np.diff(off)[20:]).max() < 0.005
    for now_s, hpas in ((3.0, 9000.0), (3.1, 1100.0), (-90.0, 1100.0)):  # a spike; an old clock
        taken(intake, "SCALED_PRESSURE2", now_s, press_abs=hpas, time_boot_ms=0, **rest)
        (found, *_) = taken(intake, "LOCAL_POSITION_NED", now_s, **place, time_boot_ms=0)
    assert found.pos_w[2] == pytest.approx(START[2]), "one spike and no clock is remembered"


def test_depth_is_zeroed_at_the_start_and_the_sensor_in_the_water_counts(intake):
    hpa = CONFIG.vehicle.water_density_kg_m3 * CONFIG.vehicle.gravity_m_s2 / 100
    rest = {"press_diff": 0.0, "temperature": 20, "time_boot_ms": 0}
    assert taken(intake, "SCALED_PRESSURE", press_abs=1000.0, **rest)[0].depth_m == pytest.approx(0.8)
    (first,) = taken(intake, "SCALED_PRESSURE2", press_abs=1100.0, **rest)
    (deeper,) = taken(intake, "SCALED_PRESSURE2", press_abs=1100.0 + hpa, **rest)
    assert isinstance(first, PressureReading)
    assert (first.depth_m, deeper.depth_m) == (pytest.approx(0.8), pytest.approx(1.8))
    assert taken(intake, "SCALED_PRESSURE", press_abs=1000.0, **rest) == []
    assert taken(intake, "SCALED_PRESSURE3", press_abs=1000.0, **rest) == []
    thermometer = Intake(CONFIG, START, 0.0)
    assert taken(thermometer, "SCALED_PRESSURE3", press_abs=0.0, **rest) == []


def obstacles(intake, distances, **fields):
    given = {
        "time_usec": 0, "sensor_type": 3, "distances": distances, "increment": 5, "min_distance": 20,
        "max_distance": 1200, "increment_f": 130 / 72, "angle_offset": -65 + 65 / 72, "frame": 12,
    }  # fmt: skip
    return taken(intake, "OBSTACLE_DISTANCE", **(given | fields))


def test_sectors_become_beams_clockwise_to_counter_clockwise(intake):
    distances = [1201] * 72
    distances[0], distances[71] = 300, 700
    (ping,) = obstacles(intake, distances)
    assert isinstance(ping, SonarPing) and ping.doppler_m_s.size == 0
    assert ping.hit[0] == ping.hit[-1] == 1 and ping.hit.sum() == 8
    assert ping.range_m[0] == 7.0, "beam 0 of a fan is at its right edge"
    assert ping.range_m[-1] == 3.0


def test_there_and_back_keeps_the_nearest_return():
    rng = np.random.default_rng(77001)
    for config in (CONFIG, link_config(**{"sensors.sonar.horizontal_aperture_deg": 360.0})):
        sonar = config.sensors.sonar
        range_m, hit = rng.uniform(0.5, 12.0, sonar.n_ray), rng.integers(0, 2, sonar.n_ray)
        distances, increment, offset = sectors_of(sonar, range_m, hit)
        ping = ping_of(sonar, 0.0, np.array(distances), increment, offset, 1, 1200)
        assert isinstance(ping, SonarPing) and len(distances) == 72
        seen = np.where(hit > 0, range_m, np.inf)
        told = np.where(ping.hit > 0, ping.range_m, np.inf)
        assert (told <= seen + 0.006).all(), "nothing that was seen is further away or gone"
        assert set(np.round(told[np.isfinite(told)], 2)) <= set(np.round(seen[np.isfinite(seen)], 2))


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"max_distance": 500}, r"sees 5 m far, the config says 12: --set sensors.sonar.max_range_m=5"),
        ({"increment_f": 1.0}, "beams lie in sectors that nobody looked into"),
        ({"frame": 0}, "not relative to the bow"),
        ({"increment_f": math.nan}, "not finite"),
        ({"increment_f": 1e-9}, "make no sense"),
        ({"angle_offset": math.inf}, "not finite"),
    ],
)
def test_a_scan_that_would_lie_is_refused(fields, says, intake):
    assert obstacles(intake, [300] * 72, **fields) == []
    (reason,) = intake.heard.refused
    assert re.search(says, reason)


@pytest.mark.parametrize(
    ("distance", "hits"),
    [(300, True), (1200, True), (20, True), (0, True), (1201, False)]
    + [(blind, None) for blind in (1, 19, 1202, 65534, 65535)],
)
def test_a_sector_counts_as_mavlink_says(distance, hits, intake):
    """0 is a touch, one beyond the maximum is free water; what is unknown, or not measurable, is neither."""
    found = obstacles(intake, [300] * 71 + [distance])
    if hits is None:
        assert found == [] and len(intake.heard.refused) == 1
    else:
        assert found[0].hit[0] == hits


def test_rangefinders_around_the_hull_are_a_ring(intake):
    ranger = {
        "time_boot_ms": 0, "min_distance": 20, "max_distance": 1200, "type": 1, "id": 0, "covariance": 0,
    }  # fmt: skip
    assert taken(intake, "DISTANCE_SENSOR", orientation=0, current_distance=500, **ranger) == []
    for turn, distance in ((1, 300), (7, 1200), (25, 80)):
        taken(intake, "DISTANCE_SENSOR", orientation=turn, current_distance=distance, **ranger)
    (ping,) = taken(intake, "DISTANCE_SENSOR", orientation=0, current_distance=500, **ranger)
    middle = len(ping.range_m) // 2
    assert ping.range_m[middle] == 5.0 and ping.range_m[0] == 3.0 and ping.hit[-1] == 0
    for odd in ({"signal_quality": 1}, {"current_distance": 19}, {"current_distance": 65535}):
        blind = {"orientation": 0, "current_distance": 1200, **ranger, **odd}
        assert taken(intake, "DISTANCE_SENSOR", **blind) == [], "no free water"
    later = ranger | {"time_boot_ms": 9000}
    assert taken(intake, "DISTANCE_SENSOR", 9.0, orientation=0, current_distance=500, **later) == []


def test_who_is_heard(intake):
    beat = {"type": 12, "autopilot": 3, "base_mode": 129, "custom_mode": 4}
    taken(intake, "HEARTBEAT", 1.0, component=191, **beat)
    taken(intake, "HEARTBEAT", 1.0, system=7, **beat)
    taken(intake, "HEARTBEAT", 1.0, **(beat | {"type": 2}))
    taken(intake, "HEARTBEAT", 1.0, system=255, component=190, **(beat | {"type": 18}))
    assert intake.heard.vehicle_s == intake.heard.operator_s == -math.inf
    taken(intake, "HEARTBEAT", 2.0, **beat)
    taken(intake, "HEARTBEAT", 3.0, system=255, component=190, **(beat | {"type": 6}))
    heard = intake.heard
    assert (heard.vehicle_s, heard.operator_s, heard.mode, heard.is_armed) == (2.0, 3.0, 4, True)
    assert attitude(intake) != [] and intake.take("ATTITUDE", 7, 1, {"yaw": 0.0}, 0.0) == []


NAMES = [name for names in KINDS.values() for name in names]
OF_OTHERS = (*KINDS["dvl"], *KINDS["sonar"])


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("sender", "is_heard"),
    [((1, 1), True), ((1, 154), "others"), ((255, 0), "others"), ((255, 190), False), ((2, 1), False)],
)
def test_each_kind_of_message_counts_from_its_own_senders(name, sender, is_heard, intake):
    intake.take(name, *sender, {"broken": math.nan}, 0.0)
    (why,) = intake.heard.refused
    is_body = name != "VISION_SPEED_ESTIMATE" or sender == (255, 0)  # others mean north, east, down by it
    if is_body and (is_heard is True or (is_heard and name in OF_OTHERS)):
        assert "not finite" in why
    else:
        assert f"{name} of {sender[0]}/{sender[1]} (heard by --sender" in why
        assert why.split("--sender ")[1][:-1] in [f"{kind}={sender[0]}/{sender[1]}" for kind in KINDS]


@pytest.mark.parametrize(
    ("texts", "name", "heard", "left_out"),
    [
        (["dvl=1/197"], "VISION_POSITION_DELTA", [(1, 197)], [(255, 0), (1, 1)]),
        (["dvl=1/197", "dvl=255/0"], "VISION_POSITION_DELTA", [(1, 197), (255, 0)], [(1, 1)]),
        (["sonar=3/*"], "DISTANCE_SENSOR", [(3, 1), (3, 99)], [(1, 1)]),
        (["position=2/191"], "LOCAL_POSITION_NED", [(2, 191)], [(1, 1)]),
        (["position=2/191"], "ATTITUDE", [(1, 1)], [(2, 191)]),
    ],
)
def test_senders_that_are_typed_count_in_place_of_the_usual_ones(texts, name, heard, left_out):
    senders = Senders.typed(texts, 1)
    assert all(senders.counts(name, *one) for one in heard)
    assert not any(senders.counts(name, *one) for one in left_out)


def test_what_a_payload_says_of_itself_is_not_the_autopilots(intake):
    attitude(intake)
    empty = {"id": 0, "voltages": [11000] + [65535] * 9, "battery_remaining": 5}
    taken(intake, "BATTERY_STATUS", component=100, **empty)
    intake.take("ATTITUDE", 1, 154, {"time_boot_ms": 9, "roll": 1.5}, 0.1)
    assert intake.heard.battery_v is None and intake.heard.rpy[0] == pytest.approx(0.1)
    assert "BATTERY_STATUS of 1/100 (heard by --sender battery=1/100), 1 times" in intake.heard.left_out()


def test_what_is_left_out_is_bounded_and_the_commonest_is_named(intake):
    for component in range(2, 200):
        for _ in range(1 + 2 * (component == 9)):
            intake.take("ATTITUDE", 1, component, {}, 0.0)
    assert len(intake.heard.refused) == MOST_KINDS
    assert intake.heard.left_out().startswith("ATTITUDE of 1/9 (heard by --sender attitude=1/9), 3 times; ")
    assert intake.heard.left_out().endswith(f"and {MOST_KINDS - 4} more reasons")


def dvl(intake, come_s, stamp_s):
    delta = {"time_delta_usec": 100000, "angle_delta": [0.0] * 3, "confidence": 90.0}
    stamp = {"time_usec": round(1e6 * stamp_s), "position_delta": [0.03, 0.0, 0.0]}
    return taken(intake, "VISION_POSITION_DELTA", come_s, 255, 0, **delta, **stamp)


@pytest.mark.parametrize("stamp_s", [0.0, 77.0, 1.7e9])
def test_a_dvl_without_a_clock_is_dated_by_its_arrival(stamp_s, intake):
    assert [dvl(intake, 0.1 * k, stamp_s)[0].time_s for k in range(90)] == [0.1 * k for k in range(90)]


def test_a_late_attitude_replaces_no_newer_one_and_a_restart_counts_for_all_messages(intake):
    for k in range(200):
        attitude(intake, yaw=0.01, come_s=100 + 0.02 * k)
        dvl(intake, 100 + 0.02 * k, 50 + 0.02 * k)
    (late,) = attitude(intake, yaw=1.0, come_s=104.0, time_boot_ms=101_000)
    heard = intake.heard
    assert late.time_s == pytest.approx(101.0, abs=1e-3) and heard.rpy[2] == pytest.approx(-0.01)
    assert heard.rpy_s == heard.yaw_rate_s == pytest.approx(103.98) and heard.vel_b_s == pytest.approx(103.98)
    pressure = {"press_abs": 1000.0, "press_diff": 0.0, "temperature": 20}
    taken(intake, "SCALED_PRESSURE", 104.1, time_boot_ms=104_100, **pressure)
    for k in range(10):
        (imu,) = attitude(intake, yaw=0.02, come_s=120 + 0.02 * k, time_boot_ms=20 * k + 9)
    assert imu.time_s == pytest.approx(120.18) and heard.rpy[2] == pytest.approx(-0.02)
    (depth,) = taken(intake, "SCALED_PRESSURE", 120.2, time_boot_ms=209, **pressure)
    assert depth.time_s == 120.2


def test_the_same_message_again_makes_nothing_younger(intake):
    for k in range(10):
        attitude(intake, come_s=1 + 0.02 * k)
    for k in range(100):
        assert attitude(intake, come_s=1.2 + 0.02 * k, time_boot_ms=1180) == []
    assert intake.heard.rpy_s == pytest.approx(1.18)
    assert dict(intake.heard.refused) == {"ATTITUDE: the same message again": 100}
    assert attitude(intake, yaw=0.1, come_s=3.2, time_boot_ms=3200)[0].time_s == 3.2


def test_a_battery_that_is_silent_is_known_to_be(intake):
    """Not told: 0 V, 65535, -1. Of two tellers the lower one counts while it speaks."""
    heard = intake.heard

    def status(come_s, millivolts, share=-1):
        taken(intake, "SYS_STATUS", come_s, voltage_battery=millivolts, battery_remaining=share)

    def pack(come_s, *cells):
        cells = [*cells, *[65535] * (10 - len(cells))]
        taken(intake, "BATTERY_STATUS", come_s, id=0, voltages=cells, battery_remaining=-1)

    for nothing in (0, 65535):
        status(1.0, nothing)
        pack(1.0, nothing)
    assert heard.battery_v is None and heard.battery_s == -math.inf
    status(2.0, 12000)
    pack(3.0, 8000, 8000)
    assert (heard.battery_v, heard.battery_s) == (12.0, 3.0)
    status(4.0, 0)
    assert (heard.battery_v, heard.battery_s) == (12.0, 3.0)
    pack(20.0, 8000, 8000)
    assert (heard.battery_v, heard.battery_s) == (16.0, 20.0)
    status(21.0, 65535, share=40)
    assert (heard.battery_share, heard.battery_s) == (0.4, 21.0)


@pytest.mark.parametrize(
    ("step_m", "step_s", "jumps"),
    [(0.1, 0.1, False), (3.0, 0.1, True), (-3.0, 0.1, True), (0.8, 0.0, True), (3.0, 5.0, False)],
)
def test_a_position_that_jumps_is_noticed(step_m, step_s, jumps):
    intake = Intake(link_config(**{"sensors.localization": "truth"}), START, 0.0)
    attitude(intake)
    place = {"y": 0.0, "z": 0.8, "vx": 0.0, "vy": 0.0, "vz": 0.0}
    taken(intake, "LOCAL_POSITION_NED", 1.0, x=0.0, time_boot_ms=1000, **place)
    at_s = 1.0 + step_s
    found = taken(intake, "LOCAL_POSITION_NED", at_s, x=step_m, time_boot_ms=round(1e3 * at_s), **place)
    assert (intake.heard.position_jump_s, found == []) == ((at_s, True) if jumps else (-math.inf, False))
    assert ("LOCAL_POSITION_NED: the position jumped" in intake.heard.refused) == jumps
    assert bool(intake.heard.jumped) == jumps


@pytest.mark.parametrize(
    ("heard", "messages", "says"),
    [
        (Heard(), 0, "nothing has come at HERE yet.*QGroundControl holds port 14550.*port 14551"),
        (Heard(vehicle_s=1.0), 9, r"id 255 comes\. MAVProxy passes none on.*MAVLink Endpoints.*14551"),
        (Heard(vehicle_s=1.0, operator_s=1.0), 9, "^$"),
    ],
)
def test_why_it_waits_is_told_with_the_endpoint_to_add(heard, messages, says):
    assert re.search(says, waiting_for(heard, messages, "HERE", 255))


# -------------------------------------------------------------------------------------------------- failsafes


def test_it_arms_takes_guided_and_drives(flight):
    one = flight()
    assert one.run(5).action.name == "DRIVE"
    kinds = one.sub.moved_by()
    assert kinds[:2] == ["COMMAND_LONG 400", "COMMAND_LONG 176"]
    assert set(kinds[2:]) == {"SET_POSITION_TARGET_LOCAL_NED"} and 40 <= len(kinds[2:]) <= 50
    last = one.sub.told[-1]
    assert (last.vx, last.yaw_rate) == (pytest.approx(0.3), pytest.approx(-0.1))
    assert_within(one.sub.told)
    assert {type(message) for message in one.pilot.fed} == {
        ImuReading, DvlReading, PressureReading, SonarPing,
    }  # fmt: skip
    assert one.loop.document()["driven_in"] == "GUIDED"


def test_a_dry_run_moves_nothing_and_logs_what_it_would_say(flight):
    one = flight(arms=False)
    assert one.run(5).action.name == "DRIVE"
    assert one.sub.moved_by() == [] and one.sub.kinds(), "a heartbeat, and requests for messages"
    one.run(6, lambda step: one.sub.silent.add("operator"))
    one.sub.silent.clear()
    one.run(1, farewell="interrupted")
    assert one.sub.moved_by() == [] and (one.sub.mode, one.sub.armed) == (19, False)
    one.log.close()
    said = [message.data for message in read_messages(one.log.path, ("/mavlink/said",))]
    wanted = [row for row in said if row["name"] == "SET_POSITION_TARGET_LOCAL_NED"]
    assert wanted and not any(row["sent"] for row in wanted)
    assert wanted[0]["fields"]["vx"] == pytest.approx(0.3)
    assert any(row["fields"]["vx"] == 0 for row in wanted), "it would have held"
    assert {row["kind"] for row in said} >= {"MAV_CMD_COMPONENT_ARM_DISARM", "MAV_CMD_DO_SET_MODE"}
    names = {message.data["name"] for message in read_messages(one.log.path, ("/mavlink/seen",))}
    assert "OBSTACLE_DISTANCE" in names


def test_where_guided_is_refused_it_drives_by_sticks(flight):
    one = flight(modes=(2, 9))
    one.run(12, dt=COARSE)
    assert one.loop.document()["fallback"] and one.sub.mode == 2
    sticks = [message for message in one.sub.told if message.get_type() == "MANUAL_CONTROL"]
    assert sticks and sticks[-1].x > 0 and sticks[-1].get_srcSystem() == 255
    one.sub.silent.add("operator")
    one.run(4)
    last = one.sub.told[-1] if one.sub.told[-1].get_type() == "MANUAL_CONTROL" else one.sub.told[-2]
    assert (last.x, last.y, last.z, last.r) == (0, 0, 500, 0), "it holds by itself"
    assert_within(one.sub.told)


@pytest.mark.parametrize(("given", "mode"), [({"modes": (9,)}, 19), ({"obeys": False}, 19)])
def test_a_vehicle_that_refuses_is_left_alone(flight, given, mode):
    one = flight(**given)
    assert one.run(16, dt=COARSE).action.name == "HAND_BACK" and one.sub.mode == mode
    before = len(one.sub.moved_by())
    assert 5 <= before <= 11
    one.run(5, dt=COARSE)
    assert len(one.sub.moved_by()) == before and not one.loop.document()["driven_in"]


FAILS = [
    # what fails, seconds, action, mode at the end
    (lambda one: one.sub.silent.add("operator"), 3, "HOLD", 4),
    (lambda one: one.sub.silent.add("operator"), 36, "SURFACE", 9),
    (lambda one: one.sub.silent.add("OBSTACLE_DISTANCE"), 2, "HOLD", 4),
    (lambda one: one.sub.silent.add("OBSTACLE_DISTANCE"), 34, "SURFACE", 9),
    (lambda one: one.sub.silent.add("ATTITUDE"), 1, "HOLD", 4),
    (lambda one: one.sub.silent.add("ATTITUDE"), 8, "HAND_BACK", 2),
    (lambda one: one.sub.silent.add("VISION_POSITION_DELTA"), 3, "HOLD", 4),
    (lambda one: one.sub.silent.add("VISION_POSITION_DELTA"), 9, "HAND_BACK", 2),
    (lambda one: one.sub.silent.add("SCALED_PRESSURE2"), 9, "HAND_BACK", 2),
    (lambda one: setattr(one.sub, "volts", 12.5), 7, "SURFACE", 9),
    (lambda one: setattr(one.sub, "tilt", 1.0), 1, "HOLD", 4),
    (lambda one: setattr(one.sub, "tilt", 1.0), 5, "HAND_BACK", 2),
    (lambda one: setattr(one.pilot, "pos_w", (10.0, 6.5, -0.8)), 1, "HOLD", 4),
    (lambda one: setattr(one.pilot, "pos_w", (10.0, 6.5, -0.8)), 7, "HAND_BACK", 2),
    (lambda one: setattr(one.pilot, "pos_w", (10.0, 3.0, -1.5)), 7, "HAND_BACK", 2),
    (lambda one: setattr(one.pilot, "held", ("sonar: 2 s old",)), 2, "HOLD", 4),
    (lambda one: setattr(one.pilot, "velocity", (math.nan,) * 4), 2, "HOLD", 4),
    (lambda one: setattr(one.sub, "mode", 19), 1, "HAND_BACK", 19),
    (lambda one: setattr(one.sub, "armed", False), 1, "HAND_BACK", 2),
]


@pytest.mark.parametrize(("fail", "seconds", "action", "mode"), FAILS)
def test_every_failsafe_on_a_vehicle(flight, fail, seconds, action, mode):
    one = flight()
    assert one.run(4, dt=COARSE).action.name == "DRIVE" and one.sub.mode == 4
    fail(one)
    assert one.run(seconds, dt=COARSE).action.name == action
    assert one.sub.mode == mode
    speeds = [m for m in one.sub.told if m.get_type() == "SET_POSITION_TARGET_LOCAL_NED"]
    if action == "HOLD":
        assert (speeds[-1].vx, speeds[-1].vy, speeds[-1].vz, speeds[-1].yaw_rate) == (0, 0, 0, 0)
    else:
        before = len(one.sub.moved_by())
        one.sub.silent.clear()
        one.run(3, dt=COARSE)
        assert len(one.sub.moved_by()) == before, "for good"
    assert_within(one.sub.told)


def test_a_silent_autopilot_is_left_alone(flight):
    one = flight()
    one.run(4, dt=COARSE)
    one.sub.silent.add("HEARTBEAT")
    assert one.run(4, dt=COARSE).action.name == "HAND_BACK"
    assert "COMMAND_LONG 176" in one.sub.kinds()[-30:] or one.sub.mode == 2


def test_messages_that_stand_still_are_old(flight):
    """They come on time, but their time stamps do not: a relay that says the same again and again."""
    one = flight()
    one.run(4, dt=COARSE)
    one.sub.silent.add("ATTITUDE")
    same = mav.MAVLink_attitude_message(round(1e3 * one.sub.time_s), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert one.run(2, lambda step: one.sub.send(same)).action.name == "HOLD"


def test_a_stall_of_this_computer_holds_for_a_step(flight):
    one = flight()
    one.run(4, dt=COARSE)
    one.loop.step(one.now_s + 0.5, stalled_s=0.48)
    assert one.loop.last.action.name == "HOLD"
    one.now_s += 0.5
    assert one.run(0.1).action.name == "DRIVE"


def test_the_goal_ends_the_flight(flight):
    one = flight()
    one.run(4, dt=COARSE)
    ends = []
    near = (0.9, 0.1), (0.95, 0.0), (0.5, 0.1), (0.45, 2.0), (0.45, math.nan), (0.89, 0.0)
    for off_m, one.pilot.place_sigma_m in near:
        one.pilot.pos_w = (GOAL[0] - off_m, GOAL[1], GOAL[2])
        ends.append(one.loop._farewell(one.now_s, one.loop.step(one.now_s)))
    assert ends == ["", "", *["goal reached"] * 4], "within the radius wherever in two deviations it is"
    one.run(3, farewell="goal reached")
    document = one.loop.document()
    assert one.sub.mode == 2 and document["reached"] and document["safe"]


class Clock:
    """Time passes only while somebody sleeps; the vehicle lives meanwhile."""

    def __init__(self, one, interrupted_s=math.inf, stalled_s=math.inf):
        self.one, self.now_s, self.interrupted_s, self.stalled_s = one, 1000.0, interrupted_s, stalled_s

    def now(self):
        return self.now_s

    def sleep(self, seconds):
        assert 0 < seconds <= DT + 1e-9
        self.one.sub.listen()
        self.one.sub.speak()
        self.now_s += seconds
        if self.now_s > 1000 + self.stalled_s:
            self.now_s, self.stalled_s = self.now_s + 2.0, math.inf
            self.one.sub.time_s += 2.0
        if self.now_s > 1000 + self.interrupted_s:
            self.interrupted_s = math.inf
            raise KeyboardInterrupt


def flown(one, clock, seconds=math.inf):
    plan = dataclasses.replace(plan_of(one.endpoint.place, one.log.path), seconds=seconds)
    loop = OnboardLoop(CONFIG, one.pilot, plan, one.endpoint, one.log, clock.now, clock.sleep)
    loop.run()
    one.sub.listen()
    return loop.document()


def test_it_keeps_the_clock_and_gives_the_vehicle_back_when_the_time_is_up(flight):
    one = flight()
    clock = Clock(one)
    document = flown(one, clock, seconds=5.0)
    assert document["ended"] == "time is up" and document["safe"] and not document["reached"]
    assert 5.0 <= clock.now_s - 1000 < 5.2 and document["steps"] == pytest.approx(50 * 5, abs=12)
    assert one.sub.mode == 2


def test_an_interrupt_gives_the_vehicle_back(flight):
    one = flight()
    document = flown(one, Clock(one, interrupted_s=4.0))
    assert document["ended"] == "interrupted" and one.sub.mode == 2 and document["safe"]


def test_an_interrupt_before_it_drives_ends_at_once(flight):
    one = flight()
    one.sub.silent.add("operator")
    document = flown(one, Clock(one, interrupted_s=1.0))
    assert document["ended"] == "interrupted" and one.sub.moved_by() == []


def test_a_stall_shifts_the_pilots_clock_and_ages_grow(flight):
    one = flight()
    document = flown(one, Clock(one, stalled_s=3.0), seconds=8.0)
    assert document["reasons"]["computer late"] == 1
    assert document["steps"] == pytest.approx(50 * 6, abs=12), "what was lost is not made up for"
    newest = max(message.time_s for message in one.pilot.fed)
    assert newest == pytest.approx(DT * document["steps"], abs=0.3), "the pilot's clock is that of its steps"


# -------------------------------------------------------------------------------------------------- strangers


def hostile(rng, count):
    """Datagrams of a stranger: noise, packets cut and changed, impossible numbers, senders of every kind."""
    names = [mav.MAVLINK_MSG_ID_ATTITUDE, 63, 32, 330, 132, 11011, 29, 137, 1, 0, 27, 84, 76, 69, 147, 253]
    values = [0.0, -1.0, 1e38, -1e38, math.nan, math.inf, -math.inf, 1e-45, 3.0]
    for _ in range(count):
        number = int(rng.choice(names))
        kind = mav.mavlink_map[number]
        link = mav.MAVLink(
            None, srcSystem=int(rng.choice([1, 255, 7, 0])), srcComponent=int(rng.integers(0, 256))
        )
        size = struct.calcsize(kind.unpacker.format) if hasattr(kind, "unpacker") else 20
        payload = rng.bytes(size)
        if rng.random() < 0.5:
            payload = struct.pack("<f", rng.choice(values)) * (size // 4) + rng.bytes(size % 4)
        packet = real_packet(payload, number, kind.crc_extra, link)
        luck = rng.random()
        if luck < 0.2:
            packet = packet[: rng.integers(1, len(packet))]
        elif luck < 0.4:
            at = int(rng.integers(0, len(packet)))
            packet = packet[:at] + rng.bytes(1) + packet[at + 1 :]
        elif luck < 0.5:
            packet = rng.bytes(int(rng.integers(0, LONGEST + 200)))
        elif luck < 0.6:
            packet = packet * int(rng.integers(2, 30))
        yield packet


def real_packet(payload, number, extra, link):
    """With a checksum that holds, and numbers of messages beyond a byte."""
    payload = payload.rstrip(b"\0") or payload[:1]
    head = struct.pack("<BBBBBB", len(payload), 0, 0, 0, link.srcSystem, link.srcComponent)
    head += struct.pack("<I", number)[:3]
    return b"\xfd" + head + payload + struct.pack("<H", mav.x25crc(head + payload + bytes([extra])).crc)


@pytest.fixture(scope="module")
def packets():
    return list(hostile(np.random.default_rng(77001), 1000))


@pytest.mark.parametrize("arms", [True, False])
def test_a_thousand_hostile_packets_send_nothing_outside_the_limits(flight, packets, arms):
    one = flight(arms=arms)
    one.pilot.velocity = (5.0, -5.0, 5.0, 50.0)
    one.run(4, dt=COARSE)
    one.run(2, lambda step: [one.sub.socket.sendto(p, one.sub.to) for p in packets[10 * step :][:10]])
    document = one.loop.document()
    assert sum(document["heard"].values()) > 1000 and document["broken"] > 100
    assert_within(one.sub.told)
    if not arms:
        assert one.sub.moved_by() == []
    assert all(
        math.isfinite(value)
        for message in one.pilot.fed
        for field in vars(message).values()
        for value in np.ravel(field)
    )


def test_a_flood_is_bounded_in_every_step(flight):
    one = flight()
    one.run(4, dt=COARSE)
    junk = b"\xfe" * 2000
    for _ in range(300):
        one.sub.socket.sendto(junk, one.sub.to)
    assert len(one.endpoint.receive()) <= 64
    one.sub.socket.sendto(b"x" * 5000, one.sub.to)
    assert all(len(data) <= LONGEST for _, data in one.endpoint.receive())
    one.run(1, lambda step: [one.sub.speak() for _ in range(10)])
    one.log.close()
    assert "messages: 10 a step are kept" in one.loop.document()["log_trouble"]


def test_a_stranger_does_not_get_the_orders(flight):
    """Orders go where the first heartbeat came from, while that one speaks."""
    one = flight()
    one.run(1)
    stranger = FakeSub(one.endpoint.port)
    one.run(3, lambda step: stranger.speak())
    stranger.listen()
    one.sub.listen()
    assert stranger.told == [] and one.sub.told
    stranger.close()


# --------------------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    "text",
    ["tcp:127.0.0.1:5760", "udp:127.0.0.1", "udp::14550", "udp:127.0.0.1:0", "udp:127.0.0.1:70000", "x"],
)
def test_places_that_are_none(text):
    with pytest.raises(LinkError, match="udp:HOST:PORT"):
        place_of(text)


def test_a_port_that_is_taken_is_told():
    with Endpoint(LinkPlace("127.0.0.1", 0, False)) as first, pytest.raises(LinkError, match="cannot listen"):
        Endpoint(LinkPlace("127.0.0.1", first.port, False))


BASE = ["pilot", "--mavlink", "udp:127.0.0.1:14550", "--start", "2,3,-0.8", "--goal", "18,3,-0.8"]


BAD_SENDERS = ("dvl", "dvl=1", "dvl=256/0", "gps=1/1", "dvl=1/-1", "=1/1", "dvl=*/1", "")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--goal", "18,3,0.8"], "outside the fence"),
        (["--start", "2,3"], "give 3 finite numbers"),
        (["--sensors", "paper"], "--sensors multibeam"),
        (["--max-speed", "9"], "--max-speed 9"),
        (["--max-speed", "nan"], "--max-speed nan"),
        (["--box", "5,5,1,1"], "--box"),
        (["--depth", "2,1"], "--depth"),
        (["--system", "255"], "--operator"),
        (["--battery", "-1"], "--battery"),
        (["--rate", "-1"], "--rate"),
        (["--seconds", "0"], "--seconds"),
        (["--heading", "400"], "--heading"),
        (["--mavlink", "serial:/dev/ttyS0"], "udp:HOST:PORT"),
        *((["--sender", text], "write KIND=SYSTEM/COMPONENT") for text in BAD_SENDERS),
    ],
)
def test_what_makes_no_sense_is_refused(capfd, words, says):
    code, _out, err = uuv(capfd, *BASE, *words)
    assert code == 2 and says in err


@pytest.mark.parametrize("words", [["--json"], []])
def test_the_command_flies_and_tells(capfd, monkeypatch, tmp_path, words):
    monkeypatch.setattr(control_loop, "warmed", lambda config, tree, mission: WishfulPilot())
    place = [
        "--mavlink", f"udp:127.0.0.1:{free_port()}", "--seconds", "0.2", "--log", str(tmp_path / "a.mcap"),
    ]  # fmt: skip
    code, out, err = uuv(capfd, *BASE[:1], *BASE[3:], *place, *words)
    assert code == 0 and "dry run: no order that moves the vehicle is sent" in err
    if words:
        found = json.loads(out)
        assert found["dry_run"] and found["ended"] == "time is up" and found["said"] == {}
    else:
        assert "ended: time is up" in out and "dry run: nothing was sent" in out
    assert (tmp_path / "a.mcap").exists()


def test_a_log_that_is_there_is_not_replaced(capfd, monkeypatch, tmp_path):
    monkeypatch.setattr(control_loop, "fly", lambda *_: pytest.fail("it flies"))
    old = tmp_path / "a.mcap"
    old.write_text("an older flight")
    code, _, err = uuv(capfd, *BASE[:1], *BASE[3:], "--mavlink", "udp:127.0.0.1:14550", "--log", str(old))
    assert code == 2 and "--force" in err and old.read_text() == "an older flight"


def test_a_log_that_cannot_be_written_any_more_does_not_stop_the_flight(flight, monkeypatch):
    one = flight()
    one.run(3)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(one.log._file, "add_message", full)
    assert one.run(3).action.name == "DRIVE"
    assert "No space left" in one.loop.document()["log_trouble"]


def test_without_pymavlink_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr(mavlink, "_NEEDED", "pymavlink_is_not_here.dialects")
    with pytest.raises(LinkError, match=r"pip install 'uuvtai\[mavlink\]'"):
        MavCodec(1, 191)


def test_names_of_mavlink_are_mavlinks():
    """A word of ours in such a name once told ArduSub nothing."""
    root = Path(__file__).parents[2]
    files = *root.glob("uuvtai/vehicle/**/*.py"), root / "docs/safety.md", root / "docs/on_a_vehicle.md"
    names = {name for file in files for name in re.findall(r"\bMAV_[A-Z0-9_]+[A-Z0-9]\b", file.read_text())}
    assert len(names) > 5 and [name for name in names if not (hasattr(mav, name) or name in mav.enums)] == []
