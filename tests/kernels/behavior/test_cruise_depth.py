"""Which depth is cruised at: the prior against a drawn population, the choice in hand-made situations."""

import numpy as np
import pytest
import taichi as ti

from tests.bundles import Stage, io_for, put
from uuvtai.config import Config
from uuvtai.config.behavior import TUNED
from uuvtai.kernels.behavior.io import BehaviorIO
from uuvtai.kernels.behavior.threats import choose_depth, level_share
from uuvtai.kernels.core.simd import LANES
from uuvtai.kernels.core.stage import AnyTensor, Bundle

N_ENV = 6
SIZES = {"n_env": N_ENV, "n_track": 1, "n_node": 1, "n_candidate": LANES, "n_tuned": len(TUNED)}
POOL = {"z_m": [-1.2, -0.4], "height_m": [0.3, 0.5]}
LOW, HIGH = -1.4, -0.2
"""Edges of the band: 0.2 m off the floor at -1.6 m and off the surface."""


def config(column_share=0.0, **behavior):
    numbers = {"edge_gap_m": 0.2, "depth_choices": 7} | behavior
    prior = {"column_share": column_share}
    return Config.model_validate({"traffic": POOL, "height": prior, "behavior": numbers})


@ti.kernel
def _shares(z: AnyTensor, out: AnyTensor, io: Bundle[BehaviorIO]):
    for i in z:
        out[i] = level_share(z[i], io)


@ti.kernel
def _choose(out: AnyTensor, io: Bundle[BehaviorIO]):
    for env in range(N_ENV):
        out[env] = choose_depth(env, io)


class Rig(Stage):
    sizes = SIZES

    def choose(self, goal_z, away_m=10.0, before_z=-0.8, sigma_m=0.0, cfg=None, given_up=0):
        """Depth to steer for of vehicles at -0.8 m whose goals lie so far ahead."""
        cfg = cfg or config()
        n = np.zeros(N_ENV, np.float32)
        put(self.ego, z_var=sigma_m**2, given_up=given_up, pos_w=np.stack([n + 4, n + 3, n - 0.8], 1))
        goal = np.stack([n + 4 + np.float32(away_m), n + 3, n + np.asarray(goal_z, np.float32)], 1)
        put(self.mission, goal_w=goal)
        put(self.behavior, cruise_z_m=before_z)
        out = np.zeros(N_ENV, np.float32)
        _choose(out, self.io(BehaviorIO, cfg))
        return out


stage = Rig.fixture()


@pytest.mark.parametrize("column_share", [0.0, 0.5])
def test_expected_share_is_that_of_a_drawn_population(column_share):
    """Half heights of 0.2 m on average; the band's ends are soft by 0.05 m, no share moves by more."""
    rng, z = np.random.default_rng(7), np.linspace(-1.5, -0.1, 15).astype(np.float32)
    centre, half = rng.uniform(-1.2, -0.4, (200_000, 1)), rng.uniform(0.15, 0.25, (200_000, 1))
    column = rng.random((200_000, 1)) < column_share
    drawn = ((np.abs(centre - z) < half + 0.17 + 0.1) | column).mean(0)
    out, cfg = np.zeros_like(z), config(column_share)
    _shares(z, out, io_for(BehaviorIO, cfg))
    np.testing.assert_allclose(out, drawn, atol=0.07)
    assert out.max() > 0.99 and out.min() < 0.25 + 0.75 * column_share


def test_cruises_at_the_edge_nearer_the_goals_depth(stage):
    goal_z = np.array([-1.2, -1.0, -0.9, -0.7, -0.6, -0.4])
    np.testing.assert_allclose(stage.choose(goal_z), [LOW] * 3 + [HIGH] * 3, atol=1e-6)


def test_the_less_sure_of_its_depth_the_farther_from_the_edges(stage):
    """Three standard deviations, at most to the middle of the water."""
    goal_z = np.array([-1.2] * 3 + [-0.4] * 3)
    expected = np.array([LOW + 0.15] * 3 + [HIGH - 0.15] * 3)
    np.testing.assert_allclose(stage.choose(goal_z, sigma_m=0.05), expected, atol=1e-5)
    np.testing.assert_allclose(stage.choose(goal_z, sigma_m=1.0), -0.8, atol=1e-5)


@pytest.mark.parametrize(("edge_gap_m", "kept_m"), [(0.2, 0.35), (0.4, 0.4)])
def test_with_a_dead_vertical_thruster_it_cruises_at_the_goals_depth_farther_off(stage, edge_gap_m, kept_m):
    goal_z = np.array([-1.5, -1.2, -1.0, -0.6, -0.3, -0.1])
    found = stage.choose(goal_z, cfg=config(edge_gap_m=edge_gap_m), given_up=5)
    np.testing.assert_allclose(found, np.clip(goal_z, -1.6 + kept_m, -kept_m), atol=1e-6)


@pytest.mark.parametrize("share", [0.7, 0.2, 0.0])
def test_comes_back_to_the_goals_depth_in_time(stage, share):
    """That much of the goal's radius may be left at the goal, and 0.3 m more per metre before it."""
    away = np.array([0.5, 1.0, 1.5, 2.0, 2.2, 10.0])
    off = np.minimum(share + 0.3 * np.maximum(away - 1.0, 0), 1.0)
    found = stage.choose(-1.2, away, HIGH, cfg=config(arrival_depth_share=share))
    np.testing.assert_allclose(found, np.full(6, -1.2) + off, atol=1e-5)


def test_keeps_what_it_has_chosen_where_both_edges_are_as_good(stage):
    """The other edge is nearer to the goal by 0.1 m: not worth 1.2 m of diving."""
    np.testing.assert_allclose(stage.choose(-0.85, before_z=HIGH), HIGH, atol=1e-6)
    np.testing.assert_allclose(stage.choose(-0.85, before_z=LOW), LOW, atol=1e-6)


def test_stays_at_the_goals_depth_where_obstacles_fill_the_water(stage):
    full = config(1.0, weight_depth_change=0.0)
    np.testing.assert_allclose(stage.choose(-0.6, cfg=full), -0.6, atol=1e-6)
    np.testing.assert_allclose(stage.choose(-0.4, cfg=config(free_depth=False)), -0.4, atol=1e-6)
