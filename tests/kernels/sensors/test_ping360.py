"""A vehicle with one mechanical beam: what it does, logs and decides again from its log."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tests.small_sim import sim_with_one_beam
from uuvtai.config import Config, SensorsConfig
from uuvtai.config.loader import load_config
from uuvtai.evaluation.episodes import Job
from uuvtai.logs.drawing import ECHO, load_recording
from uuvtai.logs.encode import EpisodeHeader, Moment
from uuvtai.logs.topics.sensors import SONAR_ROWS
from uuvtai.logs.video import FrameArtist
from uuvtai.logs.writer import EpisodeRecorder
from uuvtai.sim.behavior_tree import read_tree
from uuvtai.vehicle.messages import Inbox
from uuvtai.vehicle.onboard import Mission, OnboardPilot, SonarPing, numbers_of
from uuvtai.vehicle.onboard_core import FedPilot, _shapes
from uuvtai.vehicle.replay import replay

STEPS, SEED, EPISODE = 200, 77001, 3
END = SimpleNamespace(
    outcome="cut", episode_return=0.0, time_s=4.0, min_clearance_m=1.0, replans={}, planned_by={}
)
CONFIG = load_config("pool", "ping360")
SONAR = CONFIG.sensors.sonar


@pytest.fixture(scope="module")
def alone(taichi_runtime):
    """A simulator of one vehicle."""
    return sim_with_one_beam()


@pytest.fixture(scope="module")
def driven(alone, tmp_path_factory):
    """(path of the log, own place (n, 2), asked velocity (n, 2), heard (n,) beams) of an episode's start."""
    job = Job(SEED, EPISODE)
    recorder = EpisodeRecorder(tmp_path_factory.mktemp("ping360"), "pool", "bt", [job], True)
    one = torch.ones(1, dtype=torch.int32)
    alone.reset(one, SEED * one, EPISODE * one)
    recorder.begin(alone, 0, job)
    rows = []
    for _ in range(STEPS):
        alone.step()
        recorder.step(alone)
        fresh, count = alone.rows(alone.s.scan.fresh)[0], alone.rows(alone.s.scan.new_count)[0]
        asked = alone.rows(alone.s.behavior.last_vel_w)[0, :2]
        rows.append((*alone.rows(alone.s.ego.pos_w)[0, :2], *asked, fresh * count))
    recorder.end(alone, 0, END)
    rows = np.array(rows, float)
    return recorder.paths[job], rows[:, :2], rows[:, 2:4], rows[:, 4]


def test_it_waits_for_the_first_sweep_and_then_drives_no_farther_in_one_than_it_may(driven):
    _, place, asked, heard = driven
    first = int(SONAR.sweep_s / 0.02)
    speed = np.linalg.norm(asked, axis=1)
    assert speed[: first - 2].max() < 1e-6 < speed[first + 20 :].max()
    assert speed.max() <= CONFIG.behavior.sweep_way_m / SONAR.sweep_s + 1e-5
    apart = np.linalg.norm(place[first:] - place[:-first], axis=1)
    assert 0.1 < apart.max() <= 1.1 * CONFIG.behavior.sweep_way_m
    assert heard.sum() == pytest.approx(STEPS * 0.02 / (SONAR.step_us / 1e6), abs=1)


def test_its_log_gives_the_same_commands(driven, alone, monkeypatch):
    monkeypatch.setattr(alone, "sensors", alone.sensors)
    found = replay(driven[0], build=lambda feed: OnboardPilot(alone, feed.mission))
    assert found["equal"] and found["steps"] == STEPS + 1
    assert [row["equal_steps"] for row in found["agreement"]] == [STEPS + 1] * 4
    counts = found["messages"]["sonar"]
    assert counts["used"] == counts["fed"] > 100 and counts["bad"] == counts["late"] == 0


def test_a_log_holds_each_beam_once_and_a_video_paints_the_last_sweep(driven):
    recording = load_recording(driven[0])
    scans = recording["/sonar/scan"].values
    assert {len(ranges) for ranges, _, _, _ in scans} == {1}
    told_rad = np.array([away[0] for _, away, _, _ in scans])
    k = np.arange(len(scans))
    beam = np.minimum(k % 62, 62 - k % 62)
    np.testing.assert_allclose(told_rad, SONAR.first_beam_rad + beam * SONAR.beam_step_rad, atol=1e-6)
    newest = list(recording["/sonar/scan"].until(3.0))
    assert newest[0][3] <= 3.0 < newest[0][3] + 0.05 and len(newest) > SONAR.n_ray
    artist = FrameArtist(recording, 1000)
    ink = [(artist.frame(time_s) == np.array(ECHO)).all(-1).sum() for time_s in (0.1, 3.0)]
    assert ink[1] > 2 * ink[0] > 0


def test_a_log_tells_the_beams_of_this_step_alone():
    values = {"scan.new_from": np.int32(31), "scan.new_count": np.int32(1), "scan.ping_step": np.int32(3)}
    values |= {"scan.hit": np.ones(32, np.int32), "scan.range_m": np.linspace(1, 2, 32, dtype=np.float32)}
    values |= {"scan.intensity": np.full(32, 0.5, np.float32), "scan.doppler_m_s": np.zeros(32, np.float32)}
    values |= {"scan.ping_vel_b": np.zeros(3, np.float32)}
    moment = Moment(EpisodeHeader("bt", Config(sensors=SensorsConfig(sonar=SONAR)), "", {}), values)
    scan, doppler = (json.loads(row.encode(moment)) for row in SONAR_ROWS[:2])
    assert scan["ranges"] == [2.0] and scan["intensities"] == [0.5] and doppler["velocity"] == []
    assert scan["start_angle"] == scan["end_angle"] == pytest.approx(np.radians(55.8))


@pytest.mark.parametrize(
    ("ping", "message"),
    [
        (SonarPing(0.0, np.ones(2), np.ones(1), np.zeros(0), 3), "2 ranges and 1 hits from beam 3"),
        (SonarPing(0.0, np.ones(2), np.ones(2), np.zeros(0), 99), "are no beams of 32"),
        (SonarPing(0.0, np.ones(1), np.ones(1), np.zeros(0), -1), "from beam -1"),
        (SonarPing(0.0, np.ones(0), np.ones(0), np.zeros(0), 0), "0 ranges"),
        (SonarPing(0.0, 1.0, 1.0, np.zeros(0)), r"range_m must have the shape"),
        (SonarPing(0.0, np.ones(1), np.ones(1), np.zeros(1), 0), r"doppler_m_s must have the shape \(0,\)"),
    ],
)
def test_a_pilot_refuses_beams_that_the_sonar_does_not_have(alone, monkeypatch, ping, message):
    monkeypatch.setattr(alone, "sensors", alone.sensors)
    pilot = OnboardPilot(alone, Mission((2.0, 3.0, -0.8), (18.0, 3.0, -0.8)))
    with pytest.raises(ValueError, match=message):
        pilot.feed(ping)
    fed = pilot.tallies["sonar"].fed
    for beam in (31, 32, 99, 99.75, 3.25):  # all but the first lie beside the fan, or between its beams
        pilot.feed(SonarPing(0.0, np.ones(1), np.ones(1), np.zeros(0), beam))
    assert pilot.tallies["sonar"].fed == fed + 1 and pilot.tallies["sonar"].bad == 0


@pytest.mark.parametrize("mechanical", [True, False])
def test_a_scan_of_too_many_beams_is_refused(mechanical):
    numbers = replace(numbers_of(CONFIG, read_tree("bt")), mechanical=mechanical)
    pilot = SimpleNamespace(numbers=numbers, _inbox=Inbox(_shapes(numbers)))
    with pytest.raises(ValueError, match="sonar"):
        FedPilot.feed(pilot, SonarPing(0.0, np.ones(33), np.ones(33), np.zeros(0)))
