"""``uuv pilot --calibrate``: a vehicle that somebody drives by hand from rest to rest, in a known tank."""

import json
import math
import re

import numpy as np
import pytest
from rich.console import Console

from tests.command import uuv
from tests.mavlink_vehicle import free_port
from tests.vehicle.test_link import BASE
from tests.vehicle.test_preflight import RestingPilot
from uuvtai.config.loader import load_config
from uuvtai.console.screen import Screen
from uuvtai.console.vehicle_views import show_calibration
from uuvtai.vehicle import control_loop
from uuvtai.vehicle.calibrate import WAYS, Calibration, Place, solved
from uuvtai.vehicle.messages import DvlReading, ImuReading, SonarPing
from uuvtai.vehicle.start_fix import StartFound, expected

DT, Z = 0.1, -0.8


class Diver:
    """A vehicle with a Ping360 and a DVL, and who drives it as ``Calibration.says``."""

    def __init__(self, seed, yaw_deg=0.0, off=(0.0, 0.0), turn_deg=0.0, scale=1.0, tank=None):
        self.config = load_config("pool", "ping360")
        self.rng, self.place, self.yaw = np.random.default_rng(seed), np.array([2.5, 2.0]), 0.2
        self.dvl_yaw, self.turn, self.scale = math.radians(yaw_deg), math.radians(turn_deg), scale
        known = self.config
        if tank:
            tank = self.config.world.tank.model_copy(update=tank)
            known = self.config.model_copy(
                update={"world": self.config.world.model_copy(update={"tank": tank})}
            )
        self.calibration = Calibration(known, (*(self.place + off), Z))
        self.time_s, self.beam, self.left_m, self.way, self.said = 0.0, 0, 0.0, np.zeros(2), ""
        self.speed, self.is_silent = np.zeros(2), False

    def turned(self, vector, angle):
        c, s = math.cos(angle), math.sin(angle)
        return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])

    def step(self):
        made = self.calibration
        if made.says != self.said:
            self.said = made.says
            if told := re.search(r"drive (\d) m ([a-z ]+) by hand", made.says):
                angle = WAYS.index(told[2]) * math.tau / 8
                self.way = 0.35 * np.array([math.cos(angle), math.sin(angle)])
                self.left_m = int(told[1]) + 0.2 * self.rng.standard_normal()
        self.time_s += DT
        self.speed += ((self.way if self.left_m > 0 else 0.0) - self.speed) * DT / 0.5
        self.left_m -= DT * math.hypot(*self.speed)
        drifting = self.speed + 0.01 * self.rng.standard_normal(2)
        self.place = self.place + DT * self.turned(drifting, self.yaw)
        rate = 0.25 if "turn the vehicle" in made.says else 0.0
        self.yaw += DT * rate
        told = np.array([0.0, 0.0, math.remainder(self.yaw - self.turn, math.tau)])
        made.feed(ImuReading(self.time_s, told, np.array([0.0, 0.0, rate]), np.array([0.0, 0.0, 9.81])))
        if not self.is_silent:
            velocity = self.turned(drifting, -self.dvl_yaw) / self.scale
            noise = 0.005 * self.rng.standard_normal(3)
            made.feed(DvlReading(self.time_s, np.array([*velocity, 0.0]) + noise))
        self.look()

    def look(self):
        sonar = self.config.sensors.sonar
        beams = self.beam + np.arange(3)
        self.beam = (self.beam + 3) % (sonar.n_ray - 3)
        bearing = self.yaw + sonar.first_beam_rad + sonar.beam_step_rad * beams
        range_m = expected(self.config.world.tank, np.tile(self.place, (3, 1)), bearing)[0]
        hit = (range_m < sonar.max_range_m) & (self.rng.random(3) > 0.05)
        range_m = range_m + sonar.range_sigma_m * self.rng.standard_normal(3)
        ping = SonarPing(self.time_s, range_m, hit.astype(int), np.zeros(0), int(beams[0]))
        self.calibration.feed(ping)

    def drive(self, seconds=250.0):
        """Twice as long as it takes to find what there is to find."""
        until_s = self.time_s + seconds
        while self.time_s < until_s and not (self.calibration.found or self.calibration.refusal):
            self.step()
        return self.calibration


@pytest.mark.parametrize(
    ("seed", "yaw_deg", "off", "turn_deg"), [(0, 12.0, (0.3, -0.2), -10.0), (1, -7.0, (-0.4, 0.3), 11.0)]
)
def test_it_finds_how_the_dvl_looks_and_where_the_vehicle_is(seed, yaw_deg, off, turn_deg):
    diver = Diver(seed, yaw_deg, off, turn_deg)
    found = diver.drive().found
    assert found is not None and diver.calibration.says.endswith("nothing more to drive")
    assert math.degrees(found.dvl_yaw_rad) == pytest.approx(yaw_deg, abs=1.0)
    assert math.degrees(found.turn_rad) == pytest.approx(turn_deg, abs=1.0)
    assert math.dist(found.start, diver.place) < 0.1 and found.dvl_scale == pytest.approx(1.0, abs=0.02)
    document = diver.calibration.document(math.radians(355.0))
    assert document["rig"]["sensors"]["dvl"]["yaw_deg"] == pytest.approx(yaw_deg, abs=1.0)
    heading_deg = document["rig"]["world"]["tank"]["heading_deg"]
    assert abs(math.remainder(heading_deg - 355.0 - turn_deg, 360.0)) < 1.0 and 0 <= heading_deg < 360


@pytest.mark.parametrize(
    ("given", "words", "seconds"),
    [
        ({"scale": 1.2}, "less than the walls", 250.0),
        ({"tank": {"x_m": (-2.0, 20.0)}}, "beams see through the wall at x", 60.0),
    ],
)
def test_what_does_not_agree_is_refused_or_said(given, words, seconds):
    calibration = Diver(2, **given).drive(seconds)
    assert calibration.found is None and words in (calibration.refusal or calibration.says)
    assert calibration.document(0.0)["rig"] is None and not calibration.document(0.0)["ready"]


def test_a_way_that_nobody_measured_is_no_leg():
    """Pushed by a metre while the DVL is silent: what was found before counts, the way across does not."""
    diver = Diver(3)
    while len({place.number for place in diver.calibration.places}) < 3:
        diver.step()
    diver.is_silent, kept = True, [*diver.calibration.places]
    for _ in range(40):
        diver.place += np.array([0.025, 0.0])
        diver.step()
    assert diver.calibration.places == kept and "does not count" in diver.calibration.says
    diver.is_silent = False
    found = diver.drive().found
    assert found is not None and found.places == 8, "a leg was lost"
    assert math.degrees(found.dvl_yaw_rad) == pytest.approx(0.0, abs=1.0) and found.residual_m < 0.1


def ends_of(told, place, yaw):
    """Where somebody ends who drives as told."""
    metres, way = re.search(r"(\d) m ([a-z ]+?)( by hand|$)", told).group(1, 2)
    angle = yaw + WAYS.index(way) * math.tau / 8
    return place + int(metres) * np.array([math.cos(angle), math.sin(angle)])


def test_no_way_that_is_told_ends_at_a_wall():
    rng, diver = np.random.default_rng(6), Diver(6)
    made = diver.calibration
    tank = diver.config.world.tank
    low, high = np.array([tank.x_m, tank.y_m]).T
    for _ in range(200):
        first, made._at = rng.uniform(low + 1.0, high - 1.0), rng.uniform(low, high)
        made.places, made._number = [Place(1, first, np.zeros(2), 0.0)], int(rng.integers(1, 8))
        made._track.rpy = np.array([0.0, 0.0, rng.uniform(-4.0, 4.0)])
        end = ends_of(made._next_way(), made._at, made._track.rpy[2])
        assert (end > low + 0.97).all() and (end < high - 0.97).all(), (made._at, end)


def test_where_the_walls_do_not_fit_it_leads_away_from_them():
    diver = Diver(7)
    while len(diver.calibration.places) < 3:
        diver.step()
    made = diver.calibration
    made._at = np.array([15.87, 5.99])
    made._take(StartFound(refusal="the start cannot be checked (x 0 to 20 m): 3 of 9 see through; measure"))
    assert re.match(r"place 1: 3 of 9 see through: drive \d m [a-z ]+ by hand, then let it rest", made.says)
    assert 2.0 < ends_of(made.says, made._at, made._track.rpy[2] + made._turn)[1] < 5.0


def test_a_way_too_short_is_said():
    diver = Diver(4)
    while "is known" not in diver.calibration.says:
        diver.step()
    diver.step()
    diver.left_m = 1.0
    while "drive on" not in diver.calibration.says:
        diver.step()
        assert diver.time_s < 60
    assert "m of 1.5 at least" in diver.calibration.says


def test_it_leads_where_the_walls_stay_in_view():
    """The head sees 6 m: from 4 m before the end of the pool to the end, from 2.5 m into it."""
    for x, sides in ((16.0, (16.0, 18.0)), (2.5, (2.5, 4.5))):
        diver = Diver(5)
        diver.place = np.array([x, 2.0])
        diver.calibration = Calibration(diver.config, (*diver.place, Z))
        found = diver.drive(600.0).found
        assert found is not None, (x, diver.calibration.says)
        places = np.array([place.by_walls for place in diver.calibration.places])
        assert sides[0] - 0.6 < places[:, 0].min() and places[:, 0].max() < sides[1] + 0.6
        assert math.degrees(found.dvl_yaw_rad) == pytest.approx(0.0, abs=1.0)


def test_the_turn_is_that_of_least_squares():
    rng = np.random.default_rng(0)
    way, angle = rng.uniform(-2, 2, (6, 2)), 0.3
    c, s = math.cos(angle), math.sin(angle)
    walls = 1.02 * way @ np.array([[c, s], [-s, c]]) + [4.0, 3.0]
    found = solved([Place(k, walls[k], way[k], 0.0) for k in range(6)])
    assert found.dvl_yaw_rad == pytest.approx(angle) and found.dvl_scale == pytest.approx(1.02)
    assert found.residual_m == pytest.approx(0.0, abs=1e-9)


# ---- The command.


@pytest.fixture
def flown(monkeypatch):
    """Who flies finds this document."""
    calibration = Diver(0, 12.0).drive().document(math.radians(90.0))
    found = {
        "check": None, "calibration": calibration, "ready": True, "safe": True, "interrupted": False,
        "instruments": {}, "log": "a.mcap", "steps": 3,
    }  # fmt: skip
    monkeypatch.setattr(control_loop, "fly", lambda *_: (found, None))
    return found


def test_what_was_found_is_a_file_for_sensors(capfd, flown, tmp_path):
    out = tmp_path / "mine.yaml"
    code, _, err = uuv(capfd, *BASE, "--sensors", "ping360", "--calibrate", str(out))
    assert code == 0 and f"wrote {out}" in "".join(err.split("\n"))
    config, before = load_config("pool", str(out)), load_config("pool", "ping360")
    assert config.sensors.dvl.yaw_deg == pytest.approx(12.0, abs=1.0)
    assert config.world.tank.heading_deg == pytest.approx(90.0, abs=1.0)
    assert config.sensors.sonar == before.sensors.sonar
    text = out.read_text()
    code, _, err = uuv(capfd, *BASE, "--calibrate", str(out))
    assert code == 2 and "is there already" in err and out.read_text() == text
    console = Console(width=80, record=True)
    show_calibration(Screen(console=console), flown)
    shown = console.export_text()
    assert "sensors.dvl.yaw_deg" in shown and max(map(len, shown.splitlines())) <= 80


@pytest.mark.parametrize(
    ("words", "told"),
    [(("--arm",), "leave out --arm"), (("--check",), "leave out"), ((), "its folder is not there")],
)
def test_it_never_arms_and_writes_where_it_can(capfd, monkeypatch, tmp_path, words, told):
    monkeypatch.setattr(control_loop, "fly", lambda *_: pytest.fail("it flies"))
    out = tmp_path / "mine.yaml" if words else tmp_path / "none" / "mine.yaml"
    code, _, err = uuv(capfd, *BASE, "--calibrate", str(out), *words)
    assert code == 2 and told in " ".join(err.split())


def test_without_a_vehicle_nothing_is_written(capfd, monkeypatch, tmp_path):
    monkeypatch.setattr(control_loop, "warmed", lambda config, tree, mission: RestingPilot())
    out, log = tmp_path / "mine.yaml", tmp_path / "a.mcap"
    more = ["--calibrate", str(out), "--seconds", "0.2", "--log", str(log), "--json"]
    code, said, err = uuv(capfd, *BASE[:1], *BASE[3:], "--mavlink", f"udp:127.0.0.1:{free_port()}", *more)
    assert code == 3 and "calibration: no order that moves the vehicle is sent" in err
    assert json.loads(said)["calibration"]["rig"] is None and not out.exists()
