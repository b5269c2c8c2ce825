"""``uuv pilot --check``: mistakes that are planted are found, and nothing that moves a vehicle is sent."""

import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav
from rich.console import Console

from tests.command import uuv
from tests.mavlink_vehicle import LIMITS, FakeSub, Flight, WishfulPilot, free_port, link_config
from tests.vehicle.test_link import BASE
from uuvtai.config.loader import ConfigError, load_config
from uuvtai.console.screen import Screen
from uuvtai.console.vehicle_views import show_check, show_flight
from uuvtai.vehicle import control_loop
from uuvtai.vehicle.control_loop import FlightPlan, OnboardLoop
from uuvtai.vehicle.instruments.emulate import FakeA50, FakePing360
from uuvtai.vehicle.instruments.rig import PORTS, Rig
from uuvtai.vehicle.mavlink import Endpoint, LinkPlace
from uuvtai.vehicle.onboard import Mission
from uuvtai.vehicle.start_fix import StartFix, expected
from uuvtai.vehicle.telemetry import sectors_of

DT, SECONDS = 0.05, 6.0
PLACE = (15.5, 3.0, -0.8)
GOOD = {
    "FS_GCS_ENABLE": 3, "FS_LEAK_ENABLE": 2, "FS_EKF_ACTION": 1, "FS_PRESS_ENABLE": 1, "FS_PILOT_INPUT": 1,
    "FRAME_CONFIG": 1, "SYSID_MYGCS": 255, "VISO_TYPE": 1, "EK3_SRC1_VELXY": 6,
}  # fmt: skip


class RestingSub(FakeSub):
    """At rest in the pool, at its far end: it sees walls, and answers for its parameters."""

    def __init__(self, *given, **more):
        super().__init__(*given, **more)
        self.parameters, self.config, self.steps = dict(GOOD), link_config(), 0
        self.every = {}
        """name -> every so many steps it comes"""
        self.changed, self.stuck = {}, set()
        """name -> fields of it as they are told; names that are told without noise"""

    def speak(self, dt=DT):
        self.steps += 1
        super().speak(dt)

    def emit(self, name, message, link):
        if self.steps % self.every.get(name, 1):
            return
        if name == "OBSTACLE_DISTANCE":
            message = self.scan()
        fields = {"position_delta": [0.0] * 3} if name == "VISION_POSITION_DELTA" else {}
        for field, value in (fields | self.changed.get(name, {})).items():
            setattr(message, field, value)
        noise = 1e-6 * (self.steps % 7) * (name not in self.stuck)
        if name == "VISION_POSITION_DELTA":
            message.position_delta = [value + noise for value in message.position_delta]
        elif name == "ATTITUDE":
            message.roll += noise
        super().emit(name, message, link)

    def scan(self):
        sonar, tank = self.config.sensors.sonar, self.config.world.tank
        bearing = sonar.first_beam_rad + sonar.beam_step_rad * np.arange(sonar.n_ray)
        range_m = expected(tank, np.tile(PLACE[:2], (sonar.n_ray, 1)), bearing)[0]
        distances, increment, offset = sectors_of(sonar, range_m, range_m < sonar.max_range_m)
        micro = round(1e6 * self.time_s)
        return mav.MAVLink_obstacle_distance_message(micro, 3, distances, 5, 1, 1200, increment, offset, 12)

    def listen(self):
        told = len(self.told)
        super().listen()
        for message in self.told[told:]:
            if message.get_type() == "PARAM_REQUEST_READ" and message.param_id in self.parameters:
                value = self.parameters[message.param_id]
                self.send(mav.MAVLink_param_value_message(message.param_id.encode(), value, 9, 900, 65535))


class RestingPilot(WishfulPilot):
    """Without walls to watch."""

    stack = SimpleNamespace(views={"clock.step": [0], "scan.fresh": [0]})

    def begin_again(self, mission):
        self.pos_w = mission.start


class Check(Flight):
    """A check of a vehicle, or a calibration, step by step, without a clock."""

    def __init__(self, folder, config=None, rig=None, places=None, heading_rad=None, purpose="check"):
        config = config or link_config()
        super().__init__(folder, arms=False, config=config, sub=RestingSub)
        mission = Mission(PLACE, (3.0, 3.0, -0.8))
        plan = FlightPlan(
            self.endpoint.place, mission, LIMITS, self.log.path, seconds=SECONDS, purpose=purpose,
            instruments=places or {}, heading_rad=heading_rad,
        )  # fmt: skip
        self.pilot = RestingPilot()
        fix = StartFix(config, PLACE) if purpose == "check" else None
        self.loop = OnboardLoop(config, self.pilot, plan, self.endpoint, self.log, fix=fix, rig=rig)

    def found(self, before=lambda step: None, seconds=SECONDS):
        self.run(seconds, before, dt=DT)
        assert set(self.sub.kinds()) <= {"HEARTBEAT", "COMMAND_LONG 511", "PARAM_REQUEST_READ"}
        assert (self.sub.mode, self.sub.armed or self.loop._handover.has_asked) == (19, False)
        return self.loop.document()

    def rows(self, *given, **more):
        """By name: (state, what is told), several of a name joined."""
        rows = {}
        for row in self.found(*given, **more)["check"]["rows"]:
            state, told = rows.get(row["what"], ("ok", ""))
            worse = max(state, row["state"], key=["ok", "note", "bad"].index)
            rows[row["what"]] = worse, f"{told} {row['told']}"
        return rows


@pytest.fixture
def check(tmp_path):
    made = []

    def make(**given):
        made.append(Check(tmp_path, **given))
        return made[-1]

    yield make
    for one in made:
        one.close()


def test_a_vehicle_that_is_as_it_should_be_may_drive(check):
    found = check().found()
    rows = {row["what"]: row for row in found["check"]["rows"]}
    assert found["check"]["ready"], [row for row in rows.values() if row["state"] == "bad"]
    assert [name for name, row in rows.items() if row["state"] != "ok"] == []
    assert rows["imu"]["rate_hz"] == pytest.approx(20, rel=0.1) and rows["imu"]["sender"] == "ATTITUDE 1/1"
    assert rows["imu"]["gap_s"] == pytest.approx(DT, abs=0.01) and rows["autopilot"]["sender"] == "1/1"
    assert "found by the walls" in rows["start"]["told"] and {*GOOD} <= {*rows}
    assert {"wall x 20", "wall y 0", "wall y 6"} <= {*rows}
    json.dumps(found, allow_nan=False)
    console = Console(width=80, record=True)
    show_check(Screen(console=console), found)
    text = console.export_text()
    assert "it may drive" in text and max(map(len, text.splitlines())) <= 80


def test_a_heading_that_the_walls_correct_is_no_error_of_the_gyro(check):
    rows = check(heading_rad=math.radians(12)).rows()
    assert rows["gyro"][0] == "ok" and "off" not in rows["gyro"][1]
    assert rows["start"][0] == "note" and "-12.0 degrees" in rows["start"][1]


def other(**given):
    """A second autopilot at an address of its own."""

    def plant(one):
        stranger = FakeSub(one.endpoint.port, **given)
        return lambda step: stranger.speak(DT)

    return plant


def told(name, **fields):
    return lambda one: one.sub.changed.update({name: fields})


def silent(*names):
    return lambda one: one.sub.silent.update(names)


def parameter(name, value):
    return lambda one: one.sub.parameters.update({name: value})


def often(*given, link=None):
    """A message that comes in every step."""

    def plant(one):
        sender = mav.MAVLink(None, srcSystem=link[0], srcComponent=link[1]) if link else None
        return lambda step: one.sub.send(given[0](*given[1:]), sender)

    return plant


def by_the_hull(one):
    """The depth sensor is not found: the hull's barometer alone."""
    one.sub.silent.add("SCALED_PRESSURE2")
    return often(mav.MAVLink_scaled_pressure_message, 0, 1013.25, 0.0, 2000)(one)


def swings(one):
    return lambda step: setattr(one.sub, "depth", 0.8 + 0.35 * math.sin(step))


def jumps(one):
    """The vehicle's clock is set an hour ahead."""
    return lambda step: setattr(one.sub, "time_s", one.sub.time_s + 3600.0 * (step == 80))


PLANTED = {
    "DVL silent": (silent("VISION_POSITION_DELTA"), "dvl", "bad", "no velocity comes: --dvl"),
    "DVL invalid": (told("VISION_POSITION_DELTA", confidence=0.0), "dvl", "bad", "without confidence"),
    "DVL moves": (told("VISION_POSITION_DELTA", position_delta=[0.01, 0, 0]), "dvl", "note", "0.50 m/s"),
    "sonar silent": (silent("OBSTACLE_DISTANCE"), "sonar", "bad", "no scan comes: --sonar"),
    "operator silent": (silent("operator"), "operator", "bad", "--operator"),
    "battery empty": (lambda one: setattr(one.sub, "volts", 12.0), "battery", "bad", "12.0 V"),
    "battery silent": (silent("SYS_STATUS"), "battery", "note", "nobody watches"),
    "two autopilots": (other(), "left out", "bad", "a second sender speaks as system 1"),
    "several vehicles": (other(system=7), "left out", "note", "--system 7"),
    "vehicle of another type": (told("HEARTBEAT", type=2), "left out", "bad", "no submarine of ArduPilot"),
    "no vehicle of that type": (told("HEARTBEAT", type=2), "autopilot", "bad", "--system"),
    "GCS failsafe off": (parameter("FS_GCS_ENABLE", 0), "FS_GCS_ENABLE", "bad", "set 3"),
    "GCS failsafe warns": (parameter("FS_GCS_ENABLE", 1), "FS_GCS_ENABLE", "note", "only warns"),
    "leak failsafe off": (parameter("FS_LEAK_ENABLE", 0), "FS_LEAK_ENABLE", "bad", "off"),
    "sticks are missed": (parameter("FS_PILOT_INPUT", 2), "FS_PILOT_INPUT", "bad", "disarms"),
    "wrong frame": (parameter("FRAME_CONFIG", 2), "FRAME_CONFIG", "bad", "6 thrusters"),
    "other ground station": (parameter("SYSID_MYGCS", 254), "SYSID_MYGCS", "bad", "--operator 254"),
    "no DVL for GUIDED": (parameter("VISO_TYPE", 0), "VISO_TYPE", "note", "ALT_HOLD"),
    "no answer": (lambda one: one.sub.parameters.clear(), "parameters", "note", "FS_GCS_ENABLE, FS_LEAK"),
    "gyro bias": (told("ATTITUDE", rollspeed=0.03), "gyro", "bad", "0.0300 rad/s"),
    "accelerometer upside down": (told("RAW_IMU", zacc=1000), "accelerometer", "bad", "upside down"),
    "no accelerometer": (silent("RAW_IMU"), "accelerometer", "note", "at rest"),
    "vehicle upside down": (lambda one: setattr(one.sub, "tilt", math.pi), "upright", "bad", "180 degrees"),
    "depth outside the tank": (lambda one: setattr(one.sub, "depth", 3.0), "pressure", "bad", "1.6 m"),
    "attitude at 4 Hz": (lambda one: one.sub.every.update(ATTITUDE=5), "imu", "bad", "slower than 10 Hz"),
    "attitude in gaps": (lambda one: one.sub.every.update(ATTITUDE=14), "imu", "bad", "longer than 0.5 s"),
    "clock jumps": (jumps, "clock jumps", "bad", "ATTITUDE 1 times"),
    "DVL stuck": (lambda one: one.sub.stuck.add("VISION_POSITION_DELTA"), "dvl", "bad", "it is stuck"),
    "attitude stuck": (lambda one: one.sub.stuck.add("ATTITUDE"), "imu", "bad", "it is stuck"),
    "hull's barometer": (by_the_hull, "pressure", "bad", "is the depth sensor connected"),
    "depth swings": (swings, "pressure", "bad", "at rest"),
    "leak": (often(mav.MAVLink_statustext_message, 2, b"Leak Detected"), "autopilot says", "bad", "Leak"),
    "emergency": (told("HEARTBEAT", system_status=6), "autopilot says", "bad", "emergency"),
    "checks fail": (
        told("SYS_STATUS", onboard_control_sensors_enabled=1 << 28), "autopilot says", "bad", "checks"),
    "stick at its end": (
        often(mav.MAVLink_manual_control_message, 1, 0, 0, 0, 0, 0, link=(255, 190)), "sticks", "bad", "off"),
    "joystick without GUIDED": (parameter("VISO_TYPE", 0), "VISO_TYPE", "bad", "joystick off"),
    "second pilot": (
        often(mav.MAVLink_heartbeat_message, 18, 8, 0, 0, 4, 3, link=(1, 191)), "left out", "bad", "second"),
    "leak failsafe warns": (parameter("FS_LEAK_ENABLE", 1), "FS_LEAK_ENABLE", "note", "only warns: set 2"),
    "GCS failsafe disarms": (parameter("FS_GCS_ENABLE", 2), "FS_GCS_ENABLE", "note", "only disarms"),
    "armed": (lambda one: setattr(one.sub, "armed", True), "armed", "bad", "disarm"),
    "stack undecided": (lambda one: setattr(one.pilot, "held", ("dvl: old",)), "free run", "bad", "dvl"),
}  # fmt: skip


TOGETHER = [
    "GCS failsafe off, leak failsafe off, sticks are missed, wrong frame, other ground station, "
    "no DVL for GUIDED, battery empty, DVL moves, gyro bias, accelerometer upside down, several vehicles",
    "GCS failsafe warns, DVL silent, sonar silent, operator silent, battery silent, "
    "no accelerometer, attitude at 4 Hz, depth outside the tank",
    "DVL invalid, attitude in gaps, stack undecided", "two autopilots",
    "vehicle of another type, no vehicle of that type",
    "vehicle upside down, no answer", "clock jumps", "armed",
    "DVL stuck, attitude stuck, hull's barometer, leak, leak failsafe warns, GCS failsafe disarms",
    "emergency", "checks fail, second pilot, depth swings", "stick at its end, joystick without GUIDED",
]  # fmt: skip
"""what one vehicle can have at once"""


def test_no_planted_mistake_is_left_out():
    assert sorted(", ".join(TOGETHER).split(", ")) == sorted(PLANTED)


@pytest.mark.parametrize("names", TOGETHER)
def test_a_planted_mistake_is_found(check, names):
    one = check()
    mistakes = [PLANTED[name] for name in names.split(", ")]
    often = [before for plant, *_ in mistakes if callable(before := plant(one))]
    if names == "armed":
        one.found = lambda *_: (one.run(SECONDS, dt=DT), one.loop.document())[1]
    rows = one.rows(lambda step: [before(step) for before in often])
    for _, row, state, words in mistakes:
        assert rows[row][0] == state and words in rows[row][1], (row, rows[row])


@pytest.mark.parametrize(
    ("wall", "size", "row", "state"),
    [
        ("y_m", (0.0, 7.0), "wall y 7", "bad"), ("y_m", (0.0, 5.0), "start", "bad"),
        ("x_m", (0.0, 21.0), "start", "note"), ("x_m", (0.0, 22.0), "start", "bad"),
    ],
)  # fmt: skip
def test_a_tank_that_is_wrong_by_a_metre_is_found(check, wall, size, row, state):
    """One wall of an axis in view cannot tell a wrong tank from a wrong start: then it is noted."""
    rows = check(config=link_config(**{f"world.tank.{wall}": size})).rows()
    assert rows[row][0] == state, rows


# ---- Instruments that are heard themselves, and the file that says where they are.


def echo(bearing):
    """[m] to the pool's wall, as a Ping360 of 6 m meets it."""
    return float(expected(link_config().world.tank, np.array([PLACE[:2]]), np.array([bearing]))[0][0])


def heard_itself(check, lost=0.0, echo=echo, minimum_m=0.3, mute=(), seconds=6.0):
    """Rows of a check that hears an A50 and a Ping360 themselves."""
    mounted = {"sensors.localization": "estimated", "sensors.sonar.min_range_m": minimum_m}
    config = load_config("pool", "ping360", overrides=mounted)
    dvl, sonar = FakeA50("127.0.0.1", 0, lost=lost, burst_s=2.0), FakePing360("127.0.0.1", 0)
    places = {"dvl": f"a50:127.0.0.1:{dvl.port}", "sonar": f"ping360:127.0.0.1:{sonar.port}"}

    def step(number):
        if "dvl" not in mute:
            dvl.tell(number * DT, np.full(3, 1e-3 * (number % 7)), 1.0)
        if "sonar" not in mute:
            sonar.step(number * DT, echo)

    with Rig(config, places) as rig:
        one = check(config=config, rig=rig, places=places)
        one.sub.silent |= {"VISION_POSITION_DELTA", "OBSTACLE_DISTANCE"}
        rows = one.rows(step, seconds)
    dvl.close()
    sonar.close()
    return rows, one.loop.document()


def test_the_free_run_of_a_check_begins_once_the_start_is_found(check):
    preflight = check().loop._check
    for now_s, steps in ((4.0, 0), (6.0, 1), (7.0, 2)):
        preflight.stepped(now_s, 30.0, ("sonar: 2 s old",), ("sonar lost",))
        assert preflight._steps == preflight._undecided == steps
    preflight.begun(20.0)
    for now_s, steps in ((20.5, 0), (21.5, 1)):
        preflight.stepped(now_s, 30.0, (), ())
        assert preflight._steps == steps and preflight._undecided == 0


def test_instruments_that_are_well_may_drive(check):
    rows, found = heard_itself(check, seconds=14.0)
    assert found["check"]["ready"], rows
    assert "figure of merit 0.001 m/s" in rows["dvl"][1] and "valid 100 %" in rows["dvl"][1]
    assert "wall x 20" in rows and found["instruments"]


@pytest.mark.parametrize(
    ("given", "row", "words"),
    [
        ({"mute": ("dvl",)}, "dvl", "no velocity comes"),
        ({"lost": 3.0}, "dvl", "is the bottom out of its range"),
        ({"lost": 30.0}, "dvl", "bottom is lost, "),
        ({"mute": ("sonar",)}, "sonar", "no scan comes"),
        ({"echo": lambda _bearing: 0.22, "minimum_m": 0.1}, "sonar", "ring-down"),
    ],
)
def test_an_instrument_with_a_planted_mistake_is_found(check, given, row, words):
    rows, found = heard_itself(check, **given)
    assert rows[row][0] == "bad" and words in rows[row][1], rows[row]
    console = Console(width=80, record=True)
    show_check(Screen(console=console), found)
    text = console.export_text()
    assert "it may NOT drive" in text and ("NOTHING was heard" in text) == ("mute" in given)


def test_several_tellers_of_one_thing_are_found_and_other_vehicles_parameters_are_not_ours(check):
    one, stranger = check(), mav.MAVLink(None, srcSystem=7, srcComponent=1)
    one.sub.parameters.clear()
    extension = mav.MAVLink(None, srcSystem=255, srcComponent=0)

    still = [0.0] * 3

    def speak(step):
        one.sub.send(mav.MAVLink_vision_position_delta_message(0, 20000, still, still, 90.0), extension)
        one.sub.send(mav.MAVLink_param_value_message(b"FS_GCS_ENABLE", 3, 9, 900, 65535), stranger)
        one.sub.send(mav.MAVLink_scaled_pressure3_message(1 + step, 0.0, 0.0, 2000))

    rows = one.rows(speak)
    assert rows["pressure"][0] == "ok" and not {*GOOD} & {*rows}
    state, words = rows["dvl"]
    assert state == "bad" and "VISION_POSITION_DELTA 1/1" in words and "--sender dvl=" in words


RIG = (Path(__file__).parents[2] / "examples/rig.yaml").read_text()


@pytest.fixture
def rig_file(tmp_path):
    (tmp_path / "rig.yaml").write_text(RIG)
    return tmp_path / "rig.yaml"


def planned(config, **given):
    told = {"arms": False, "heading_deg": None, "seconds": None, "rate": 1.0, "log": None} | given
    return FlightPlan.typed(
        config, "udp:127.0.0.1:14550", PLACE, (3.0, 3.0, -0.8), None, None, 0.5, 13.2, system=1, operator=255,
        **told,
    )  # fmt: skip


def test_a_rig_file_says_where_instruments_are_heard_and_options_win(rig_file):
    config = load_config("pool", str(rig_file), overrides={"world.tank.heading_deg": 90.0})
    plan = planned(config)
    assert plan.instruments == {"dvl": "a50:192.168.2.95", "sonar": "ping360:192.168.2.2"}
    assert plan.heading_rad == pytest.approx(math.pi / 2) and plan.seconds == math.inf
    typed = planned(
        config, heading_deg=0.0, instruments={"dvl": "json::14700", "sonar": None}, purpose="check"
    )
    assert typed.instruments == {"dvl": "json::14700", "sonar": "ping360:192.168.2.2"}
    assert typed.heading_rad == 0.0 and typed.seconds == 30.0
    assert planned(load_config("pool", "multibeam")).instruments == {}, "MAVLink's"


@pytest.mark.parametrize("text", ["a50", "ping360:192.168.2.2", "a50:host:0", "a50:host:70000", "a50:a b"])
def test_a_place_of_a_rig_file_that_is_none_is_refused_by_every_command(rig_file, text):
    rig_file.write_text(RIG.replace("a50:192.168.2.95", f'"{text}"'))
    with pytest.raises(
        ConfigError, match=r"rig.yaml:6: sensors\.dvl\.at: .*write KIND:HOST.* KIND is a50, json"
    ):
        load_config("pool", str(rig_file))
    for kind, ports in PORTS.items():
        for one in ports:
            load_config("pool", "ping360", overrides={f"sensors.{kind}.at": f"{one}:192.168.2.9:77"})


# ---- The command.


@pytest.mark.parametrize("words", [["--json"], []])
def test_the_command_refuses_to_pass_what_nobody_speaks_to(capfd, monkeypatch, tmp_path, words):
    monkeypatch.setattr(control_loop, "warmed", lambda config, tree, mission: RestingPilot())
    place = [
        "--mavlink",
        f"udp:127.0.0.1:{free_port()}",
        "--seconds",
        "0.2",
        "--log",
        str(tmp_path / "a.mcap"),
    ]
    code, out, err = uuv(capfd, *BASE[:1], *BASE[3:], *place, "--check", "--dvl", "a50:127.0.0.1:9", *words)
    assert code == 3 and "check: no order that moves the vehicle is sent" in err
    if words:
        assert json.loads(out)["check"]["ready"] is False
    else:
        assert "it may NOT drive: autopilot" in out and "a50:127.0.0.1:9: NOTHING was heard" in out


def test_a_calibration_sends_nothing_that_moves_the_vehicle(check):
    one = check(purpose="calibrate")
    found = one.found()  # which looks at all that was sent
    assert one.loop._calibration.places and not found["ready"] and found["calibration"]["rig"] is None
    one.loop._leave(("interrupted",))
    one.sub.listen()
    assert set(one.sub.kinds()) <= {"HEARTBEAT", "COMMAND_LONG 511"} and not one.sub.armed


def test_a_check_never_arms(capfd, monkeypatch):
    monkeypatch.setattr(control_loop, "fly", lambda *_: pytest.fail("it flies"))
    code, _, err = uuv(capfd, *BASE, "--check", "--arm")
    assert code == 2 and "leave out --arm" in err


def test_a_port_that_is_taken_names_the_option_to_change(capfd, tmp_path):
    with Endpoint(LinkPlace("127.0.0.1", 0, False)) as first:
        place = ["--mavlink", f"udp:127.0.0.1:{first.port}", "--log", str(tmp_path / "a.mcap"), "--check"]
        code, _, err = uuv(capfd, *BASE[:1], *BASE[3:], *place)
    assert code == 2 and f"--mavlink udp:127.0.0.1:{first.port + 1}" in "".join(err.split("\n"))


def test_the_last_screen_shows_what_instruments_told(check):
    found = check().found(seconds=0.5) | {"check": None}
    found["instruments"] = {
        "a50:10.0.0.9:16171": {"heard": 0, "refused": {}, "strange": 0},
        "json::14700": {"heard": 7, "refused": {"dvl: not asked for": 3}, "strange": 2},
    }
    console = Console(width=80, record=True)
    show_flight(Screen(console=console), found)
    text = " ".join(console.export_text().split())
    assert "json::14700 7 2" in text and "json::14700: not used, 3 times: dvl: not asked for" in text
    assert "a50:10.0.0.9:16171: NOTHING was heard" in text
