"""A sonar that is a fan ahead: where beams look, what they meet, nothing made of what lies behind."""

from functools import cache

import numpy as np
import pytest
import taichi as ti

from tests.bundles import Stage, put
from tests.oracles import scenes
from uuvtai.common.errors import UserError
from uuvtai.config import EpisodeConfig, ObservationConfig, SonarConfig, TankConfig
from uuvtai.config.loader import load_config
from uuvtai.kernels.core.beams import beam_bearing, beam_there, beam_towards
from uuvtai.kernels.core.stage import AnyTensor, Const
from uuvtai.kernels.planning.io import ObservationIO
from uuvtai.kernels.planning.observation import sense_sectors
from uuvtai.kernels.sensors import sonar
from uuvtai.kernels.sensors.io import SonarIO

N_ENV, N_OBSTACLE = 24, 14
TANK, RULES = TankConfig(), EpisodeConfig()
SIZES = {
    "n_env": N_ENV, "n_obstacle": N_OBSTACLE, "n_ray": 256, "n_latency": 2, "n_cloud": 1, "n_thruster": 6,
}  # fmt: skip
TOLERANCE_M = 2e-3
GRAZING_SHARE = 2e-4
"""Beams that pass an edge closer than float32 can tell, of those of all scenes here."""
SONAR = load_config("pool", "multibeam").sensors.sonar
CLEAN = {"range_sigma_m": 0.0, "doppler_sigma_m_s": 0.0}
FLAT = SONAR.model_copy(update={"vertical_half_aperture_deg": 0.0, **CLEAN})
"""aperture 0: a beam is a line in space, which MuJoCo casts at the obstacles themselves"""
FINE = SonarConfig(n_ray=512, horizontal_aperture_deg=120.0)


def bearings(config):
    """[rad] of all beams from ahead: the middles of n equal parts of the aperture, from right to left."""
    share = (np.arange(config.n_ray) + 0.5) / config.n_ray - 0.5
    return np.radians(config.horizontal_aperture_deg) * share


def aim(scene, env, config):
    """(n, 2) horizontal unit vectors of the beams of one env."""
    R = scenes.rotation(scene["quat"][env])
    world = np.arctan2(R[1, 0], R[0, 0]) + bearings(config)
    return np.stack([np.cos(world), np.sin(world)], 1)


@pytest.fixture(scope="module")
def scene():
    return scenes.random_scenes(np.random.default_rng(7), N_ENV, N_OBSTACLE, TANK)


def cast(scene, config):
    """What a sonar reports of a scene: ranges, returns and Doppler (N_ENV, n_ray)."""
    stage = Stage(**SIZES)
    stage.start(scene)
    io = stage.io(SonarIO, config, TANK, RULES)
    sonar.reset_sonar(io)
    sonar.cast_sonar(io)
    scan = stage.scan
    return [array.to_numpy()[:, : config.n_ray] for array in (scan.range_m, scan.hit, scan.doppler_m_s)]


def test_a_fan_lies_ahead_and_a_ring_begins_there():
    ring = SonarConfig()
    assert ring.is_ring and ring.first_beam_rad == 0.0 and ring.circle_beams == 256
    assert ring.beam_step_rad == pytest.approx(2 * np.pi / 256, abs=1e-15)
    assert not SONAR.is_ring and not SONAR.doppler
    assert SONAR.n_ray == 256 and SONAR.horizontal_aperture_deg == 130.0
    for fan in (SONAR, FINE):
        told = fan.first_beam_rad + fan.beam_step_rad * np.arange(fan.n_ray)
        np.testing.assert_allclose(told, bearings(fan), atol=1e-12)
        assert fan.circle_beams * fan.beam_step_rad == pytest.approx(2 * np.pi, abs=fan.beam_step_rad)


@pytest.mark.parametrize("degrees", ["0", "9", "361", "nan", "wide"])
def test_an_aperture_that_cannot_be_is_refused(degrees):
    with pytest.raises(UserError, match=r"sonar\.horizontal_aperture_deg"):
        load_config("pool", "multibeam", overrides={"sensors.sonar.horizontal_aperture_deg": degrees})


@ti.kernel
def ask(bearing: AnyTensor, beam: AnyTensor, back: AnyTensor, sonar_cfg: Const[SonarConfig]):
    for i in range(bearing.shape[0]):
        beam[i] = beam_there(beam_towards(bearing[i], sonar_cfg), sonar_cfg)
        back[i] = beam_bearing(ti.max(beam[i], 0), sonar_cfg)


@pytest.mark.parametrize("config", [SONAR, SonarConfig(n_ray=96)], ids=["fan", "ring"])
def test_beams_are_found_by_their_bearing(config):
    asked = np.random.default_rng(1).uniform(-2 * np.pi, 2 * np.pi, 4000).astype(np.float32)
    beam, back = np.zeros(4000, np.int32), np.zeros(4000, np.float32)
    ask(asked, beam, back, config)
    off = np.angle(np.exp(1j * (asked - back)))
    step = config.beam_step_rad
    assert np.abs(off[beam >= 0]).max() < 0.5 * step + 1e-5
    wrapped = np.abs(np.angle(np.exp(1j * asked.astype(float))))
    edge = np.pi if config.is_ring else np.radians(65.0)
    np.testing.assert_array_equal(
        (beam < 0)[np.abs(wrapped - edge) > 1e-4], (wrapped > edge)[np.abs(wrapped - edge) > 1e-4]
    )


def test_a_fans_ranges_are_mujocos(scene):
    range_m, hit, doppler = cast(scene, FLAT)
    truth = []
    for env in range(N_ENV):
        beams = np.column_stack([aim(scene, env, FLAT), np.zeros(FLAT.n_ray)])
        truth.append(scenes.Caster(scene, env, TANK).distances(scene["pos"][env], beams))
    truth = np.array(truth)
    wrong = np.abs(range_m - np.minimum(truth, 12.0)) > TOLERANCE_M
    assert wrong.mean() < GRAZING_SHARE
    assert ((hit == 1) == (truth <= 12.0)).mean() > 1 - GRAZING_SHARE
    assert not doppler.any(), "this sonar measures none"


# ------------------------------------------------------------------------------------- what is made of a scan


@cache
def looking():
    return Stage(n_env=1, n_ray=256, n_sector=12, n_track=4)


@pytest.mark.parametrize("turned", [0.0, 0.3, np.pi])
def test_sectors_beside_the_fan_have_no_return(turned):
    """Every beam returns from 3 m; the vehicle has turned since."""
    n_sector, observation, config = 12, ObservationConfig(), SONAR.model_copy(update={"doppler": True})
    stage = looking()
    put(stage.scan, range_m=3.0, hit=1, doppler_m_s=-0.5)
    put(stage.ego, rpy=[[0.0, 0.0, turned]])
    stage.clock.active.fill(1)
    sense_sectors(stage.io(ObservationIO, observation, config))
    state = stage.observation
    middle = np.arange(n_sector) * 2 * np.pi / n_sector + turned
    away = np.degrees(np.abs(np.angle(np.exp(1j * middle)))) - 15.0
    sees = away < 64.0
    assert np.all(np.abs(away - 65.0) > 1.0), "no sector ends at the fan's edge"
    np.testing.assert_array_equal(state.sector_valid.to_numpy()[0] == 1, sees)
    np.testing.assert_allclose(state.sector_range_m.to_numpy()[0], np.where(sees, 3.0, 12.0))
    np.testing.assert_allclose(state.sector_closing_m_s.to_numpy()[0], np.where(sees, 0.5, 0.0))
    np.testing.assert_allclose(
        state.sector_ttc_s.to_numpy()[0],
        np.where(sees, min(6.0, observation.ttc_cap_s), observation.ttc_cap_s),
    )
