"""``uuv sitl --operator`` and ``uuv pilot --rate 0`` with an autopilot between them, over real UDP: the pilot
follows the vehicle's clock, so nothing depends on how fast anything runs here; and what each of them says
while something is missing."""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest

from tests.mavlink_vehicle import FakeSub, WishfulPilot, free_port, link_config
from uuvtai.vehicle.control_loop import DEAF_S, FlightNotes, FlightPlan, OnboardLoop
from uuvtai.vehicle.mavlink import SILENT_S, FollowedEndpoint, LinkError, LinkPlace
from uuvtai.vehicle.onboard import ImuReading, Mission, PositionFix
from uuvtai.vehicle.pilot_log import LinkLog
from uuvtai.vehicle.safety import STOP, SafeAction, SafeDecision, SafetyLimits
from uuvtai.vehicle.sitl import Instance, ServingNotes, SimulatedOperator, SitlPlan, SitlPort, WaterRows
from uuvtai.vehicle.stand_in import StandIn
from uuvtai.vehicle.telemetry import Heard, Intake

HERE = LinkPlace("127.0.0.1", 0, False)
ROW = 2


class Wall:
    """Our clock, moved by hand."""

    def __init__(self):
        self.now_s = 100.0

    def __call__(self):
        return self.now_s


# --------------------------------------------------------------------------------------- the vehicle's clock


@pytest.fixture
def followed():
    wall = Wall()
    with FollowedEndpoint(HERE, 1, wall) as endpoint:
        sub = FakeSub(endpoint.port)
        sub.silent = {"RAW_IMU", "VISION_POSITION_DELTA", "SCALED_PRESSURE2", "SYS_STATUS"}
        yield endpoint, sub, wall
        sub.close()


def test_time_is_the_vehicles_at_any_pace(followed):
    endpoint, sub, wall = followed
    sub.speak()
    endpoint.receive()
    begun = endpoint.now()
    for _ in range(50):
        sub.speak(0.02)
        wall.now_s += 0.1  # five times as slow as we are
        endpoint.receive()
    assert endpoint.now() - begun == pytest.approx(1.0)
    for _ in range(50):
        sub.speak(0.02)
        endpoint.receive()
    assert endpoint.now() - begun == pytest.approx(2.0), "it runs ahead of us"


def test_a_silent_vehicle_does_not_stop_the_dead_mans_time(followed):
    endpoint, sub, wall = followed
    sub.speak()
    endpoint.receive()
    begun = endpoint.now()
    wall.now_s += SILENT_S
    assert endpoint.now() == begun
    wall.now_s += 3.0
    assert endpoint.now() - begun == pytest.approx(3.0)
    sub.speak(0.02)
    endpoint.receive()
    assert endpoint.now() - begun == pytest.approx(3.0), "never back"
    sub.time_s = 0.0  # begun anew
    sub.speak(0.02)
    endpoint.receive()
    sub.speak(0.02)
    endpoint.receive()
    assert endpoint.now() - begun == pytest.approx(3.02)


def test_a_late_datagram_does_not_set_its_clock_forward(followed):
    endpoint, sub, _ = followed
    sub.speak(3.0)
    endpoint.receive()
    begun = endpoint.now()
    for _ in range(4):
        sub.time_s -= 2.0
        sub.speak(0.0)
        sub.time_s += 2.0
        sub.speak(0.02)
        endpoint.receive()
    assert endpoint.now() - begun == pytest.approx(0.08)


def test_before_it_tells_its_time_heartbeats_alone_are_heard(followed):
    endpoint, sub, wall = followed
    sub.silent |= {"ATTITUDE"}
    sub.speak()
    assert len(endpoint.receive()) == 2, "its own and the operator's"
    wall.now_s += 0.25
    assert endpoint.now() == pytest.approx(0.25), "our clock counts"
    sub.silent -= {"ATTITUDE"}
    sub.speak()
    assert len(endpoint.receive()) == 4, "from the time on everything"


def test_others_do_not_set_its_clock(followed):
    endpoint, sub, _ = followed
    stranger = FakeSub(endpoint.port, system=7)
    stranger.speak()
    sub.speak()
    endpoint.receive()
    begun = endpoint.now()
    stranger.speak(4.0)
    stranger.socket.sendto(b"\xfd\xff", stranger.to)
    stranger.socket.sendto(b"", stranger.to)
    endpoint.receive()
    assert endpoint.now() == begun
    stranger.close()


def test_sleep_waits_for_the_vehicle():
    wall = Wall()
    port = free_port()
    sub = FakeSub(port)

    def pause():
        wall.now_s += 7.0 / 50
        sub.speak(0.02)

    with FollowedEndpoint(LinkPlace("127.0.0.1", port, False), 1, wall, pause) as endpoint:
        sub.speak(0.02)
        endpoint.receive()
        begun, told = endpoint.now(), sub.time_s
        endpoint.sleep(0.1)
        assert endpoint.now() - begun == pytest.approx(0.1) and sub.time_s - told == pytest.approx(0.1)
    sub.close()


def test_a_vehicle_elsewhere_is_not_followed():
    with pytest.raises(LinkError, match="--rate 1"):
        FollowedEndpoint(LinkPlace("192.168.2.2", 14550, True), 1)
    with pytest.raises(LinkError, match="on this computer"):
        FollowedEndpoint(LinkPlace("localhost.example.com", 14550, True), 1)


# ------------------------------------------------------------------------------------------ the three of them


class HomingPilot(WishfulPilot):
    """Knows its place from messages alone and goes straight to the goal."""

    def __init__(self, goal):
        super().__init__()
        self.goal, self.yaw = np.array(goal), 0.0

    def feed(self, message):
        super().feed(message)
        if isinstance(message, PositionFix):
            self.pos_w = tuple(message.pos_w)
        elif isinstance(message, ImuReading):
            self.yaw = float(message.rpy[2])

    def tick(self):
        away = self.goal - np.array(self.pos_w)
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        ahead = [cos * away[0] + sin * away[1], cos * away[1] - sin * away[0], away[2]]
        self.velocity = (*np.clip(ahead, -0.4, 0.4), 0.0)
        return super().tick()


class Three:
    """Water, autopilot and pilot at sockets of their own; the autopilot's steps are the time."""

    def __init__(self, small, folder, operator=True):
        self.wall, self.now_s, self.packets = Wall(), 0.0, 0
        config = small.sim.config
        self.water = WaterRows(small.sim, seed=77001, first=3)
        self.endpoint = FollowedEndpoint(HERE, 1, self.wall, self.step)
        places = (LinkPlace("127.0.0.1", self.endpoint.port, True),)
        own = {"autopilot": self.endpoint.port}
        plan = SitlPlan(port=free_port(), places=places, operator=operator, emulated=own)
        self.port = SitlPort(plan, Instance(config, self.water, ROW), 0)
        self.water.begin(ROW)
        self.start = tuple(self.water.value("mission.start_w", ROW).tolist())
        self.goal = (self.start[0] + 2.5, self.start[1] + 0.6, self.start[2] - 0.1)
        limits = SafetyLimits((-9.0, -9.0, 99.0, 99.0), (0.0, 9.0), 0.5, 0.3)
        mission = Mission(self.start, self.goal)
        flight = FlightPlan(HERE, mission, limits, folder / "a.mcap", arms=True, heading_rad=0.0, seconds=60)
        self.log, self.said = LinkLog(flight.log, {}), []
        self.pilot = HomingPilot(self.goal)
        self.loop = OnboardLoop(
            config, self.pilot, flight, self.endpoint, self.log, self.endpoint.now, self.endpoint.sleep,
            self.said.append,
        )  # fmt: skip

    def step(self):
        """A frame of the autopilot's; by our clock it takes twice as long as by its own."""
        self.wall.now_s += 0.01
        self.now_s += 1.0
        self.port.drive(self.now_s)

    def close(self):
        self.log.close()
        self.endpoint.close()
        self.port.close()


@pytest.fixture
def three(small, tmp_path):
    made = []

    def make(**given):
        made.append(Three(small, tmp_path, **given))
        return made[-1]

    yield make
    for one in made:
        one.close()


def test_the_three_drive_to_the_goal(three):
    one = three()
    one.loop.run()
    found = one.loop.document()
    assert found["reached"] and found["safe"] and found["driven_in"] == "GUIDED", (found, one.said)
    place = one.water.motion(ROW, 0.0).pos_w
    assert math.dist(place, one.goal) < one.loop._config.episode.goal_radius_m + 0.2
    assert one.said[0].startswith("waits: ") and one.said[-1].startswith("hand back: goal reached")
    assert "drives" in one.said
    assert not one.port.instance.is_held and math.dist(place, one.start) > 1.0


def test_without_an_operator_it_waits_and_says_for_whom(three):
    one = three(operator=False)
    one.loop._plan = dataclasses.replace(one.loop._plan, seconds=4.0)
    one.loop.run()
    assert one.loop.document()["driven_in"] == "" and one.port.instance.is_held
    assert any("operator: nothing yet" in text for text in one.said)


def test_water_that_begins_anew_under_a_vehicle_on_its_way_is_noticed(three):
    one = three()
    steps = iter(range(10**9))
    begin_anew = one.step

    def step():
        if next(steps) == 1200:
            one.port.instance = Instance(one.loop._config, one.water, ROW)
        begin_anew()

    one.endpoint._pause = step
    one.pilot.goal = np.array([9.0, 3.0, one.start[2]])
    one.loop.run()
    found = one.loop.document()
    assert not found["reached"] and not found["safe"] and "position jumped" in found["ended"], one.said
    assert found["mode"] == "ALT_HOLD" and one.port.instance.joined_late
    one.port.autopilot.close()
    one.port.autopilot = StandIn(("127.0.0.1", one.endpoint.port))
    begin_anew()
    assert not one.port.instance.joined_late, "ArduSub has begun anew too"


def test_a_vehicle_that_stood_still_is_heard_as_of_now_again(three):
    """Our clock ran on without its clock: its readings are not older for that."""
    one = three()
    steps, go_on = iter(range(10**9)), one.step

    def step():
        if next(steps) == 200:
            one.wall.now_s += SILENT_S + 1.2
        go_on()

    one.endpoint._pause = step
    one.loop.run()
    found = one.loop.document()
    assert one.endpoint.clock_jumps and found["reached"] and found["safe"], (found, one.said)


def test_the_water_stays_for_a_while_after_the_end(three):
    one = three()
    one.step()
    one.port.instance.outcome, one.port.instance._ended_s = "success", one.port.instance.time_s
    for _ in range(20):
        one.step()
    assert one.port.instance.lingered_s == pytest.approx(0.1)


# --------------------------------------------------------------------------------------------------- operator


def test_the_operator_beats_by_the_waters_clock_and_tells_the_place_for_a_minute():
    operator = SimulatedOperator(1)
    said = [order for step in range(12_000) for order in operator.report(0.01 * step)]
    names = [order.message for order in said]
    assert names.count("HEARTBEAT") == 120 and names.count("SET_GPS_GLOBAL_ORIGIN") == 241
    assert all(order.as_operator for order in said)
    assert [order.message for order in operator.report(0.0)] == ["HEARTBEAT", "SET_GPS_GLOBAL_ORIGIN"]


# ------------------------------------------------------------------------------------------------------ notes


def test_what_the_pilot_says_it_waits_for():
    notes, heard = FlightNotes("127.0.0.1:14550", 255), Heard()
    hold = SafeDecision(SafeAction.HOLD, STOP, ("operator silent: operator: nothing yet",))
    assert notes.look(1.0, hold, False, 0, heard) == ""
    assert "nothing has come at 127.0.0.1:14550 yet" in notes.look(DEAF_S, hold, False, 0, heard)
    assert notes.look(DEAF_S + 1, hold, False, 0, heard) == "", "once"
    wrong = "a ground station has the id 254: --operator 254"
    heard.refused[wrong] += 2
    assert "MAVProxy passes none on" in notes.look(7.0, hold, False, 9, heard)
    assert notes.look(7.1, hold, False, 9, heard) == f"waits: {hold.reasons[0]} (not used: {wrong}, 2 times)"
    assert notes.look(9.0, hold, False, 9, heard) == ""
    drive = SafeDecision(SafeAction.DRIVE, STOP, ())
    assert "takes the vehicle" in notes.look(10.0, drive, False, 9, heard)
    assert notes.look(10.5, drive, True, 9, heard) == "", "no more than one in a second"
    assert notes.look(11.0, drive, True, 9, heard) == "drives"
    assert notes.look(12.0, hold, True, 9, heard) == f"hold: {hold.reasons[0]}"


def test_ids_that_are_others_are_named():
    """A vehicle and a ground station that are there, but are not the ones that were typed."""
    intake = Intake(link_config(), (0.0, 0.0, 0.0), 0.0)
    intake.take("HEARTBEAT", 3, 1, {"type": 12, "autopilot": 3, "base_mode": 0, "custom_mode": 0}, 1.0)
    intake.take("HEARTBEAT", 254, 190, {"type": 6, "autopilot": 8, "base_mode": 0, "custom_mode": 0}, 1.0)
    assert set(intake.heard.refused) == {
        "a submarine has the id 3: --system 3", "a ground station has the id 254: --operator 254",
    }  # fmt: skip
    assert math.isinf(intake.heard.vehicle_s) and math.isinf(intake.heard.operator_s)


def served(**given):
    """An instance as the notes look at it."""
    counts = {"step": 0, "reset": 0, "again": 0, "ignore": 0, "bad": 0} | given.pop("counts", {})
    blank = {"is_held": True, "outcome": "", "driven_s": 0.0, "joined_late": False}
    return SimpleNamespace(counts=counts, **(blank | given))


def test_what_the_water_says():
    notes = ServingNotes(0, 9002, 0.0)
    assert notes.look(served(), 9.0) == []
    assert "nothing of ArduSub's has come to UDP port 9002" in notes.look(served(), 10.0)[0]
    assert notes.look(served(), 30.0) == [], "once"
    first = {"step": 1, "reset": 1}
    assert notes.look(served(counts=first), 31.0) == ["instance 0: ArduSub speaks"]
    assert notes.look(served(counts=first), 40.0) == []
    assert "silent" in notes.look(served(counts=first), 41.0)[0]
    again = {"step": 9, "reset": 2}
    assert notes.look(served(counts=again), 42.0) == [
        "instance 0: ArduSub speaks", "instance 0: ArduSub has begun anew, so has the episode",
    ]  # fmt: skip
    assert "the episode begins" in notes.look(served(counts=again, is_held=False), 43.0)[0]
    ended = served(counts=again | {"bad": 2}, is_held=False, outcome="success", driven_s=12.3)
    said = notes.look(ended, 44.0)
    assert said[0] == "instance 0: success after 12.3 s" and "no packet of ArduSub's" in said[1]
    assert notes.look(ended, 45.0) == []


def test_the_water_says_that_ardusub_comes_from_another_water():
    said = ServingNotes(1, 9012, 0.0).look(served(counts={"reset": 1}, joined_late=True), 1.0)
    assert len(said) == 2 and "restart it, and the pilot" in said[1]
