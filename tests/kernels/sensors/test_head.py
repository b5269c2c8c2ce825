"""A mechanical beam: where it looks when, what it hears, and what is refused."""

import numpy as np
import pytest
import taichi as ti

from tests.bundles import Stage
from tests.oracles import scenes
from tests.oracles.sonar import obstacle_hits, wall_hits
from uuvtai.common.errors import UserError
from uuvtai.config import EpisodeConfig, SonarConfig, TankConfig
from uuvtai.config.loader import load_config
from uuvtai.kernels.core.stage import AnyTensor, Const
from uuvtai.kernels.sensors import mechanical_sonar, sonar
from uuvtai.kernels.sensors.io import SonarIO

N_ENV, N_OBSTACLE, STEPS = 24, 14, 60
TANK, RULES = TankConfig(), EpisodeConfig()
SECTOR = load_config("pool", "ping360").sensors.sonar
TURN = SECTOR.model_copy(update={"n_ray": 400, "horizontal_aperture_deg": 360.0, "max_range_m": 12.0})
SIZES = {
    "n_env": N_ENV, "n_obstacle": N_OBSTACLE, "n_ray": 400, "n_latency": 2, "n_cloud": 1, "n_thruster": 6,
}  # fmt: skip
TOLERANCE_M = 2e-3
GRAZING_SHARE = 2e-3
"""Sixteen rays a beam pass sixteen times as many edges as one."""


# ------------------------------------------------------------------------------------------------------- time


@pytest.mark.parametrize(("range_m", "turn_s"), [(2.0, 9.0), (50.0, 35.0)])
def test_a_turn_lasts_as_long_as_the_data_sheet_says(range_m, turn_s):
    told = TURN.model_copy(update={"max_range_m": range_m})
    assert told.sweep_s == pytest.approx(turn_s, rel=0.02)
    assert SonarConfig().sweep_s == 0.0, "all beams at once"


def looked_along(config, steps):
    """(n_ray indices) of the beams taken in each control step, by the head's own clock in microseconds."""
    out, taken = [], 0
    for step in range(steps):
        new = []
        while taken * config.step_us <= step * 20_000:
            there = taken % (config.n_ray if config.is_ring else 2 * config.n_ray - 2)
            new.append(min(there, (2 * config.n_ray - 2) - there) if not config.is_ring else there)
            taken += 1
        out.append(new)
    return out


@ti.kernel
def ask(begin: AnyTensor, out: AnyTensor, n_ray: Const[int], is_ring: Const[bool]):
    for i in range(begin.shape[0]):
        first, count = mechanical_sonar.new_beams(ti.i64(begin[i, 0]), ti.i64(begin[i, 1]), n_ray, is_ring)
        out[i, 0], out[i, 1] = first, count


@pytest.mark.parametrize("is_ring", [True, False])
def test_beams_of_one_control_step_are_neighbours(is_ring):
    """Also where the head turns back or begins anew, and where a step is so short that it comes by twice."""
    asked = np.array([(a, a + n) for a in range(40) for n in (0, 1, 2, 7, 31, 90)], np.int32)
    found = np.zeros_like(asked)
    ask(asked, found, 16, is_ring)
    for (begin, end), (first, count) in zip(asked, found, strict=True):
        k = np.arange(begin, end + 1)
        wanted = set(k % 16) if is_ring else set(np.minimum(k % 30, 30 - k % 30))
        assert {(first + i) % 16 for i in range(count)} == wanted and count == len(wanted)


# --------------------------------------------------------------------------------------------------- geometry


@pytest.fixture(scope="module")
def scene():
    return scenes.random_scenes(np.random.default_rng(11), N_ENV, N_OBSTACLE, TANK)


def nearest(scene, env, config, beam):
    """[m] the oracle's: nearest of sixteen rays over the beam's width."""
    R = scenes.rotation(scene["quat"][env])
    middle = np.arctan2(R[1, 0], R[0, 0]) + config.first_beam_rad + config.beam_step_rad * beam
    world = middle + np.radians(config.beam_width_deg) * ((np.arange(16) + 0.5) / 16 - 0.5)
    u = np.stack([np.cos(world), np.sin(world)], 1)
    best = wall_hits(scene["pos"][env][:2], u, TANK)[0]
    for body in np.flatnonzero(scene["kind"][env]):
        slope = np.tan(np.radians(config.vertical_half_aperture_deg))
        best = np.minimum(best, obstacle_hits(scene, env, body, scene["pos"][env], u, slope)[0])
    return best.min()


def test_beams_come_in_turn_and_hear_what_is_nearest_within_them(scene):
    config = SECTOR.model_copy(update={"range_sigma_m": 0.0, "range_quantum_m": 0.0})
    stage = Stage(**SIZES)
    stage.start(scene)
    scan, io = stage.scan, stage.io(SonarIO, config, TANK, RULES)
    sonar.reset_sonar(io)
    wrong = heard = 0
    for step, beams in enumerate(looked_along(config, STEPS)):
        stage.clock.step.fill(step)
        mechanical_sonar.turn_head(io)
        assert (scan.fresh.to_numpy() == bool(beams)).all()
        if not beams:
            continue
        first, count = scan.new_from.to_numpy(), scan.new_count.to_numpy()
        assert (count == len(beams)).all() and (first == beams[0]).all()
        assert (scan.ping_step.to_numpy() == step).all()
        found, hit = scan.range_m.to_numpy()[:, beams[0]], scan.hit.to_numpy()[:, beams[0]]
        truth = np.array([nearest(scene, env, config, beams[0]) for env in range(N_ENV)])
        wrong += (np.abs(found - np.minimum(truth, config.max_range_m)) > TOLERANCE_M).sum()
        assert ((hit == 1) == (found < config.max_range_m)).all()
        heard += N_ENV
    assert wrong < GRAZING_SHARE * heard and heard > 700
    assert not scan.doppler_m_s.to_numpy().any()


# ---------------------------------------------------------------------------------------------------- refused


@pytest.mark.parametrize(
    ("preset", "changes", "typed"),
    [
        ("paper", {"mechanical": True}, "--set sensors.sonar.doppler=false"),
        ("nominal", {"mechanical": True, "doppler": False}, "--set sensors.sonar.latency_steps=0"),
        ("ping360", {"period_steps": 5}, "--set sensors.sonar.period_steps=1"),
    ],
)
def test_what_one_beam_cannot_do_is_refused_with_what_to_type(preset, changes, typed):
    overrides = {f"sensors.sonar.{name}": value for name, value in changes.items()}
    with pytest.raises(UserError, match=typed):
        load_config("pool", preset, overrides=overrides)


@pytest.mark.parametrize("width", ["-1", "31", "nan"])
def test_a_beam_width_that_cannot_be_is_refused(width):
    with pytest.raises(UserError, match=r"sonar\.beam_width_deg"):
        load_config("pool", "ping360", overrides={"sensors.sonar.beam_width_deg": width})
