"""A sonar without Doppler: speeds come from scan to scan, and "none measured" is never "at rest"."""

import json

import numpy as np
import pytest
import taichi as ti

from tests.bundles import Stage, put
from tests.conftest import configure
from tests.kernels.perception.test_tracking import (
    CONFIG,
    N_ENV,
    PAPER,
    PERIOD_S,
    Drive,
    Lab,
    no_obstacles,
    resting,
    with_movers,
)
from uuvtai.config import Config, SensorsConfig, SonarConfig
from uuvtai.kernels.core.beams import range_rate
from uuvtai.kernels.core.stage import AnyTensor, Const, In
from uuvtai.logs.encode import EpisodeHeader, Moment
from uuvtai.logs.topics.sensors import SONAR_ROWS
from uuvtai.plugins.adapters import Readings
from uuvtai.state import SonarScan, TrackState
from uuvtai.vehicle.onboard import Mission, OnboardPilot, SonarPing

DEAF = PAPER.model_copy(update={"doppler": False})
NOT_MEASURED = np.nan


class Deaf(Lab):
    """Whose scans hold no number where the Doppler would stand."""

    def feed(self, step, pos, yaw, vel_w, range_m, doppler, hit, late=0, valid=1):
        nothing = np.full_like(np.asarray(doppler, float), NOT_MEASURED)
        super().feed(step, pos, yaw, vel_w, range_m, nothing, hit, late, valid)


@pytest.fixture(scope="module")
def deaf():
    return Deaf(DEAF)


def finite(lab):
    return all(np.isfinite(value).all() for value in lab.everything().values())


def test_what_rests_is_not_called_moving(deaf):
    rng = np.random.default_rng(6)
    lab, drive, still = deaf.begin(3), Drive(rng, yaw_rate=0.8), resting(rng, 12)
    called = 0
    for k in range(50):
        lab.sense(k * CONFIG.period_steps, drive.pos, drive.yaw, drive.vel, still)
        called += lab.read("moving").sum()
        drive.advance(PERIOD_S)
    assert called <= 0.01 * 12 * 50 * N_ENV, "of 12 obstacles"
    assert finite(lab)


def test_a_mover_is_told_within_two_seconds_by_its_displacement(deaf):
    """0.6 m/s at 3 m in sixteen directions, seen from a vehicle under way; which way it goes is found too."""
    lab, drive = deaf.begin(4), Drive(np.random.default_rng(7), speed=0.3)
    drive.pos, course = np.tile([8.0, 3.0], (N_ENV, 1)), 2 * np.pi * np.arange(N_ENV) / N_ENV
    vel = 0.6 * np.stack([np.cos(course), np.sin(course)], -1)[:, None]
    for k in range(int(2.0 / PERIOD_S)):
        centre = np.array([11.0, 3.0]) + vel * k * PERIOD_S
        obstacles = with_movers(no_obstacles(), centre, vel, np.full((N_ENV, 1), 0.2))
        body = lab.sense(k * CONFIG.period_steps, drive.pos, drive.yaw, drive.vel, obstacles)
        drive.advance(PERIOD_S)
    owner = np.array([lab.read("beam_track")[env][body[env] == 0][0] for env in range(N_ENV)])
    rows = np.arange(N_ENV)
    assert lab.read("moving")[rows, owner].all() and finite(lab)
    assert np.abs(lab.read("state")[rows, owner][:, 2:] - vel[:, 0]).max() < 0.2


def test_a_first_scan_alone_shows_no_motion_and_no_speed(deaf):
    lab = deaf.begin(1)
    centre = np.tile([[[13.0, 3.0]]], (N_ENV, 1, 1))
    vel = np.tile([[[-2.0, 0.0]]], (N_ENV, 1, 1))
    pos, yaw = np.tile([10.0, 3.0], (N_ENV, 1)), np.zeros(N_ENV)
    lab.sense(
        0, pos, yaw, np.zeros((N_ENV, 2)), with_movers(no_obstacles(), centre, vel, np.full((N_ENV, 1), 0.2))
    )
    alive = lab.read("alive") == 1
    assert alive.any() and not lab.read("moving").any()
    cov = lab.read("cov")[alive]
    assert cov[:, [7, 9]].min() == pytest.approx(CONFIG.birth_speed_sigma_m_s**2, rel=1e-3), "unknown, not 0"


# ------------------------------------------------------------------------------------------- rate of a range


@ti.kernel
def rates(scan: In[SonarScan], tracks: In[TrackState], out: AnyTensor, sonar_cfg: Const[SonarConfig]):
    for beam in range(out.shape[0]):
        out[beam] = range_rate(0, beam, scan, tracks, sonar_cfg)


@pytest.mark.parametrize("aperture", [360.0, 130.0])
def test_the_rate_of_a_range_is_that_of_the_track_and_the_own_motion(aperture):
    config = DEAF.model_copy(update={"n_ray": 64, "horizontal_aperture_deg": aperture})
    stage = Stage(n_env=1, n_ray=64, n_track=3, n_height=16)
    scan, tracks = stage.scan, stage.tracks
    put(scan, doppler_m_s=NOT_MEASURED, ping_yaw=0.7, ping_vel_b=[[0.5, -0.2, 0.1]])
    owner = np.resize([-1, 0, 1], 64)
    put(tracks, beam_track=owner[None], moving=[[1, 0, 1]])
    vel = np.array([[0.0, 0.0, 0.4, -0.9], [0.0, 0.0, 3.0, 3.0], [0.0, 0.0, 3.0, 3.0]], np.float32)
    put(tracks, state=vel)
    found = np.zeros(64, np.float32)
    rates(scan, tracks, found, config)
    away = config.first_beam_rad + config.beam_step_rad * np.arange(64)
    own = 0.5 * np.cos(away) - 0.2 * np.sin(away)
    theirs = np.where(owner == 0, 0.4 * np.cos(away + 0.7) - 0.9 * np.sin(away + 0.7), 0.0)
    np.testing.assert_allclose(found, theirs - own, atol=1e-6)


# --------------------------------------------------------------------------------------- logs, pieces, robots


def told(sonar):
    """(scan, Doppler) of a log's step with three beams."""
    values = {
        "scan.ping_step": np.int32(3),
        "scan.new_from": np.int32(0),
        "scan.new_count": np.int32(0),
        "scan.hit": np.array([1, 0, 1], np.int32),
        "scan.range_m": np.array([1.0, 12.0, 3.0], np.float32),
        "scan.intensity": np.array([0.5, 0.0, 0.2], np.float32),
        "scan.doppler_m_s": np.zeros(3, np.float32),
        "scan.ping_vel_b": np.array([0.5, 0.0, 0.0], np.float32),
    }
    moment = Moment(EpisodeHeader("bt", Config(sensors=SensorsConfig(sonar=sonar)), "", {}), values)
    return [json.loads(row.encode(moment)) for row in SONAR_ROWS[:2]]


def test_a_log_tells_angles_and_no_speed_that_was_not_measured():
    scan, doppler = told(SonarConfig(n_ray=16))
    assert scan["start_angle"] == 0 and doppler["velocity"] == [0, 0, 0]
    scan, doppler = told(SonarConfig(n_ray=16, doppler=False, horizontal_aperture_deg=160.0))
    assert np.degrees([scan["start_angle"], scan["end_angle"]]) == pytest.approx([-75.0, 75.0])
    assert doppler["velocity"] == [] and doppler["own_velocity"] == [0.5, 0, 0]


def test_a_piece_of_ones_own_is_shown_that_none_is_measured(small, monkeypatch):
    sonar = small.config.sensors.sonar.model_copy(update={"doppler": False, "horizontal_aperture_deg": 128.0})
    sensors = small.config.sensors.model_copy(update={"sonar": sonar})
    small.begin([1, 2])
    usual = Readings(small.sim, [0, 1], None).group("scan")
    assert np.isfinite(usual.doppler).all()
    np.testing.assert_allclose(usual.bearing[1], 2 * np.pi * np.arange(256) / 256, atol=1e-6)
    configure(monkeypatch, small.sim, small.config.model_copy(update={"sensors": sensors}))
    scan = Readings(small.sim, [0, 1], None).group("scan")
    assert np.isnan(scan.doppler).all() and scan.doppler.shape == scan.bearing.shape == (2, 256)
    np.testing.assert_allclose(np.degrees(scan.bearing[0, [0, -1]]), [-63.75, 63.75], atol=1e-4)


def test_a_pilot_is_fed_no_speeds_where_none_are_measured(small, monkeypatch):
    sonar = small.config.sensors.sonar.model_copy(update={"doppler": False})
    sensors = small.config.sensors.model_copy(update={"sonar": sonar})
    configure(monkeypatch, small.sim, small.config.model_copy(update={"sensors": sensors}))
    monkeypatch.setattr(small.sim, "sensors", small.sim.sensors)
    pilot = OnboardPilot(small.sim, Mission((2.0, 3.0, -0.8), (18.0, 3.0, -0.8)))
    beams = np.full(256, 3.0), np.ones(256)
    with pytest.raises(ValueError, match=r"sonar: doppler_m_s must have the shape \(0,\)"):
        pilot.feed(SonarPing(0.0, *beams, np.zeros(256)))
    pilot.feed(SonarPing(0.0, *beams, np.zeros(0)))
    assert pilot.tallies["sonar"].bad == 0
