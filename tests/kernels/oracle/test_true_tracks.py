"""Privileged tracks equal the truth, whoever reads tracks follows them, only an evaluation sets them."""

import numpy as np
import pytest
import taichi as ti

from tests.bundles import Stage, put
from tests.repository.test_architecture import PACKAGE
from uuvtai.config import Config, TrackingConfig, WorldConfig
from uuvtai.config.loader import load_config
from uuvtai.kernels.core.geometry import NONE, SPHERE
from uuvtai.kernels.oracle import true_state
from uuvtai.kernels.oracle.io import TrueTracksIO
from uuvtai.sim.setup import array_sizes

HEIGHT_STEP_M = 1.6 / 15
"""Between two hypotheses of an obstacle's height in a tank 1.6 m deep."""


@pytest.fixture(scope="module")
def known(small):
    """The small simulator after two seconds with the truth for tracks: (sim, arrays of its structs)."""
    small.sim.use_tree(small.trees["bt"])
    small.sim.privileged = True
    small.begin(range(8), seed=4)
    for _ in range(100):
        small.sim.step()
    small.sim.privileged = False
    return small.arrays("tracks", "world", "path", "scan", "forecast", "clock", "ego", "termination")


def test_tracks_are_the_moving_obstacles(known):
    n_lane = known["path.n_way"].shape[1]
    kind, pos, vel, size = (
        known[f"world.{name}"][:, -n_lane:] for name in ("kind", "pos_w", "vel_w", "size")
    )
    there = kind != NONE
    assert there.sum() == 8 * 6
    alive = known["tracks.alive"]
    assert np.array_equal(alive[:, :n_lane] == 1, there) and not alive[:, n_lane:].any()
    assert np.array_equal(known["tracks.moving"], alive)
    assert np.array_equal(
        known["tracks.state"][:, :n_lane][there], np.concatenate([pos[..., :2], vel[..., :2]], -1)[there]
    )
    assert np.array_equal(known["tracks.radius_m"][:, :n_lane][there], size[there][:, 0])
    assert np.array_equal(known["tracks.z_m"][:, :n_lane][there], pos[there][:, 2])
    assert known["tracks.cov"].max() <= 1e-6
    assert np.array_equal(known["tracks.scan_step"], known["clock.step"])


def test_turn_rates_are_those_of_the_paths(known):
    n_lane = known["path.n_way"].shape[1]
    there = known["world.kind"][:, -n_lane:] != NONE
    circle = there & (known["path.n_way"] == 0)
    assert 0 < circle.sum() < there.sum()
    rate = known["tracks.turn_rate"][:, :n_lane]
    assert rate[circle] == pytest.approx(
        (known["path.speed_m_s"] / np.where(circle, known["path.radius_m"], 1.0))[circle]
    )
    assert not rate[~circle].any()


def test_forecasts_begin_at_the_obstacles_and_heights_cover_them(known):
    n_lane = known["path.n_way"].shape[1]
    there = known["world.kind"][:, -n_lane:] != NONE
    pos, size = known["world.pos_w"][:, -n_lane:], known["world.size"][:, -n_lane:]
    assert known["forecast.pos_w"][:, :n_lane, 0][there] == pytest.approx(pos[there][:, :2], abs=1e-5)
    own_z = known["ego.pos_w"][:, None, 2]
    low, high = pos[..., 2] - size[..., 2], pos[..., 2] + size[..., 2]
    above, below = known["forecast.above_w"][:, :n_lane], known["forecast.below_w"][:, :n_lane]
    over, under = there & (low > own_z), there & (high < own_z)
    assert over.any() and under.any()
    slack = 2 * HEIGHT_STEP_M + 0.05
    assert np.all(above[over] <= low[over] + 1e-5)
    assert np.all(above[over] >= np.minimum(low - slack, own_z)[over])
    assert np.all(below[under] >= high[under] - 1e-5)


def test_returns_are_named_after_the_obstacles_they_come_from(known):
    """Returns near an outline are that obstacle's; 1.2 cm a step leave the newest scan right."""
    ray = np.arange(known["scan.range_m"].shape[1])
    named = 0
    for env in np.flatnonzero(known["termination.outcome"] == 0):
        bearing = known["scan.ping_yaw"][env] + 2 * np.pi * ray / len(ray)
        hit = known["scan.ping_pos_w"][env, :2] + known["scan.range_m"][env][:, None] * np.column_stack(
            [np.cos(bearing), np.sin(bearing)]
        )
        gap = (
            np.linalg.norm(hit[:, None] - known["tracks.state"][env, :, :2], axis=-1)
            - known["tracks.radius_m"][env]
        )
        gap = np.where(known["tracks.alive"][env] == 1, gap, np.inf)
        returned, name = known["scan.hit"][env] == 1, known["tracks.beam_track"][env]
        near, far = returned & (gap.min(1) < 0.1), ~returned | (gap.min(1) > 0.25)
        assert np.array_equal(name[near], gap.argmin(1)[near]) and np.all(name[far] == -1)
        named += near.sum()
    assert named > 20


def test_where_tracks_are_too_few_the_nearest_obstacles_get_them():
    config = Config(world=WorldConfig(n_dynamic=5), tracking=TrackingConfig(n_track=3))
    stage = Stage(**array_sizes(config, 1, "cpu"))
    tracks, world, path = stage.tracks, stage.world, stage.path
    put(stage.clock, active=1)
    first = world.kind.shape[1] - 5
    for lane, x in enumerate((9.0, 2.0, 7.0, 1.0, 3.0)):
        world.kind[0, first + lane] = SPHERE if lane != 3 else NONE
        world.pos_w[0, first + lane] = (x, 0.0, 0.0)
        world.size[0, first + lane] = (0.2, 0.2, 0.2)
        world.vel_w[0, first + lane] = (0.5, 0.0, 0.0)
        path.n_way[0, lane] = 2
    true_state.know_obstacles(stage.io(TrueTracksIO, config))
    ti.sync()
    assert tracks.state.to_numpy()[0, :, 0].tolist() == [2.0, 3.0, 7.0]
    assert tracks.alive.to_numpy()[0].tolist() == [1, 1, 1]


def test_only_an_evaluation_that_is_asked_to_switches_it_on(small):
    assert small.sim.privileged is False
    setters = {path.name for path in PACKAGE.rglob("*.py") if ".privileged = " in path.read_text()}
    assert setters == {"sim.py", "evaluate.py", "simulate.py"}
    assert "privileged" not in load_config("pool", "paper").model_dump_json()
