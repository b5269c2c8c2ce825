"""Sector features against a NumPy oracle, and by hand."""

import numpy as np
import pytest
import torch

from tests.reference import features as oracle
from uuvtai.config import FeaturesConfig, SonarConfig
from uuvtai.kernels.features import COLUMNS, observation_width, placed_columns, sense_sectors, write_observation
from uuvtai.state import ClockState, FeatureState, MissionState, Proprioception, RouteState, SonarScan, allocate

N_ENV, N_RAY, N_SECTOR = 20, 256, 12
FEATURES, SONAR = FeaturesConfig(), SonarConfig()

ROUNDING = 1e-5
"""Single precision of one division."""


class Stage:
    """The stage's structs and one call."""

    def __init__(self):
        sizes = {"n_env": N_ENV, "n_ray": N_RAY, "n_sector": N_SECTOR}
        self.features, self.scan = allocate(FeatureState, sizes), allocate(SonarScan, sizes)
        self.ego, self.clock = allocate(Proprioception, sizes), allocate(ClockState, sizes)

    def run(self, range_m, doppler, hit, yaw, ping_yaw, awake=None):
        """(4, n_env, n_sector): range, ttc, closing, valid."""
        self.scan.range_m.from_numpy(range_m.astype(np.float32))
        self.scan.doppler_m_s.from_numpy(doppler.astype(np.float32))
        self.scan.hit.from_numpy(hit.astype(np.int32))
        self.scan.ping_yaw.from_numpy(ping_yaw.astype(np.float32))
        self.ego.rpy.from_numpy(np.stack([0 * yaw, 0 * yaw, yaw], axis=1).astype(np.float32))
        self.clock.awake.from_numpy(np.ones(N_ENV, np.int32) if awake is None else awake.astype(np.int32))
        sense_sectors(self.features, self.scan, self.ego, self.clock, FEATURES, SONAR)
        f = self.features
        return np.array([x.to_numpy() for x in (f.sector_range_m, f.sector_ttc_s, f.sector_closing_m_s, f.sector_valid)])


@pytest.fixture(scope="module")
def stage():
    return Stage()


def random_scan(seed):
    rng = np.random.default_rng(seed)
    hit = rng.uniform(size=(N_ENV, N_RAY)) < rng.choice([0.02, 0.3, 1.0], size=(N_ENV, 1))
    return np.where(hit, rng.uniform(0.2, 12, hit.shape), 12.0), np.where(hit, rng.normal(0, 0.6, hit.shape), 0.0), hit


@pytest.mark.parametrize("turn", [0.0, 1.0])
def test_sectors_equal_the_oracle(stage, turn):
    for seed in range(5):
        range_m, doppler, hit = (np.float32(a) for a in random_scan(seed))
        rng = np.random.default_rng(seed + 50)
        ping_yaw = rng.uniform(-3.1, 3.1, N_ENV).astype(np.float32)
        yaw = (ping_yaw + turn * rng.uniform(-0.2, 0.2, N_ENV)).astype(np.float32)
        got = stage.run(range_m, doppler, hit, yaw, ping_yaw)
        for env in range(N_ENV):
            turned = float(yaw[env] - ping_yaw[env])
            want = oracle.sectors(range_m[env], doppler[env], hit[env], turned, N_SECTOR, SONAR.max_range_m, FEATURES.ttc_cap_s)
            assert np.allclose(got[:, env], want, rtol=ROUNDING, atol=ROUNDING)


def test_a_turn_across_pi_is_no_turn_of_the_beams(stage):
    """Yaw wraps from pi to -pi between ping and now: the features must not notice."""
    range_m, doppler, hit = random_scan(1)
    near = stage.run(range_m, doppler, hit, np.full(N_ENV, 0.1), np.full(N_ENV, 0.0))
    wrapped = stage.run(range_m, doppler, hit, np.full(N_ENV, -np.pi + 0.05), np.full(N_ENV, np.pi - 0.05))
    assert np.allclose(near, wrapped, atol=ROUNDING)


def test_one_approaching_body_by_hand(stage):
    range_m, doppler, hit = np.full((N_ENV, N_RAY), 12.0), np.zeros((N_ENV, N_RAY)), np.zeros((N_ENV, N_RAY))
    range_m[:, 64:67], doppler[:, 64:67], hit[:, 64:67] = [2.0, 1.9, 2.1], [-0.5, -0.4, 0.3], 1  # 90 degrees to the left
    got = stage.run(range_m, doppler, hit, np.zeros(N_ENV), np.zeros(N_ENV))
    assert np.allclose(got[:, :, 3].T, [1.9, 4.0, 0.5, 1])
    others = np.delete(got, 3, axis=2)
    assert np.allclose(others[0], 12) and np.allclose(others[1], FEATURES.ttc_cap_s) and not others[2:].any()


def test_sleeping_rows_keep_their_features(stage):
    quiet = np.zeros(N_ENV)
    first = stage.run(*random_scan(2), quiet, quiet)
    awake = np.arange(N_ENV) % 3 == 0
    second = stage.run(*random_scan(3), quiet, quiet, awake=awake)
    assert np.array_equal(second[:, ~awake], first[:, ~awake])
    assert (second[:, awake] != first[:, awake]).any(axis=(0, 2)).all()


# -------------------------------------------------------------------------------------------------------------- observation

OBSERVATION_ROUNDING = 1e-5
"""Single precision of a rotation of positions of about 10 m."""


@pytest.fixture(scope="module")
def observed(stage):
    """(observation (n_env, n_obs), arrays it was made of, rows awake) for random states; -7 was there before."""
    sizes = {"n_env": N_ENV, "n_way": 2, "n_ahead": 2, "n_trigger": 4, "n_planner": 2, "n_reason": 4}
    route, mission = allocate(RouteState, sizes), allocate(MissionState, sizes)
    rng, arrays = np.random.default_rng(0), {}
    for struct, names in {
        route: ("lookahead_w", "heading_error", "cross_track_m", "remaining_m", "path_risk"),
        mission: ("goal_w",),
        stage.ego: ("pos_w", "rpy", "vel_b", "rate_b", "depth_m"),
        stage.features: ("sector_range_m", "sector_ttc_s", "sector_closing_m_s"),
    }.items():
        for name in names:
            field = getattr(struct, name)
            arrays[name] = rng.uniform(-3, 3, field.to_numpy().shape).astype(np.float32)
            field.from_numpy(arrays[name])
    awake = np.arange(N_ENV) % 4 != 1
    stage.clock.awake.from_numpy(awake.astype(np.int32))
    obs = torch.full((N_ENV, observation_width(N_SECTOR)), -7.0)
    write_observation(obs, stage.features, route, stage.ego, mission, stage.clock)
    return obs.numpy(), arrays, awake


def test_observation_equals_the_oracle_in_every_column(observed):
    obs, arrays, awake = observed
    for env in np.flatnonzero(awake):
        want = oracle.observation({name: np.float64(a[env]) for name, a in arrays.items()})
        assert list(want) == [c.name for c in COLUMNS]
        for column, first, width in placed_columns(N_SECTOR):
            got = obs[env, first : first + width]
            np.testing.assert_allclose(got, np.broadcast_to(want[column.name], width), atol=OBSERVATION_ROUNDING, err_msg=column.name)


def test_sleeping_rows_keep_their_observation(observed):
    obs, _arrays, awake = observed
    assert (obs[~awake] == -7).all()


def test_first_columns_are_the_papers_targets_of_the_world_model():
    """3 goal errors, sine and cosine of the heading error, 3 velocities, yaw rate, depth, roll and pitch, 12 ranges: 24."""
    names = [column.name for column, _first, width in placed_columns(12) for _ in range(width)]
    paper = {"goal": 3, "heading_error": 2, "velocity": 3, "yaw_rate": 1, "depth": 1, "tilt": 2, "sector_range": 12}
    assert names[:24] == [name for name, width in paper.items() for _ in range(width)]
