"""Sector features against a NumPy oracle, and by hand."""

import numpy as np
import pytest
import torch

from tests.bundles import Stage, put
from tests.oracles import observation as oracle
from uuvtai.common import tree_codes as codes
from uuvtai.config import (
    EpisodeConfig,
    ForecastConfig,
    ObservationConfig,
    SonarConfig,
    TankConfig,
    TrackingConfig,
)
from uuvtai.config.behavior import TUNED
from uuvtai.kernels.core.geometry import FAR_M
from uuvtai.kernels.planning.io import ObservationIO
from uuvtai.kernels.planning.observation import (
    COLUMNS,
    columns,
    observation_width,
    placed_columns,
    sense_sectors,
    write_advice,
    write_observation,
    write_obstacles,
)

N_ENV, N_RAY, N_SECTOR, N_TRACK, N_FORECAST = 20, 256, 12, 5, 8
FEATURES, SONAR = ObservationConfig(), SonarConfig()

ROUNDING = 1e-5
"""Single precision of one division."""


class Rig(Stage):
    """The stage's structs and one call."""

    sizes = {
        "n_env": N_ENV, "n_ray": N_RAY, "n_sector": N_SECTOR, "n_track": N_TRACK, "n_way": 2, "n_ahead": 2,
        "n_trigger": 4, "n_planner": 3, "n_reason": 4, "n_forecast": N_FORECAST, "n_height": 16, "n_node": 8,
        "n_candidate": 16, "n_tuned": len(TUNED),
    }  # fmt: skip

    def run(self, range_m, doppler, hit, yaw, ping_yaw, active=1):
        """(4, n_env, n_sector): range, ttc, closing, valid."""
        put(self.scan, range_m=range_m, doppler_m_s=doppler, hit=hit, ping_yaw=ping_yaw)
        put(self.ego, rpy=np.stack([0 * yaw, 0 * yaw, yaw], axis=1))
        put(self.clock, active=active)
        sense_sectors(self.io(ObservationIO, FEATURES, SONAR))
        f = self.observation
        return np.array(
            [x.to_numpy() for x in (f.sector_range_m, f.sector_ttc_s, f.sector_closing_m_s, f.sector_valid)]
        )


stage = Rig.fixture()


def random_scan(seed):
    rng = np.random.default_rng(seed)
    hit = rng.uniform(size=(N_ENV, N_RAY)) < rng.choice([0.02, 0.3, 1.0], size=(N_ENV, 1))
    return (
        np.where(hit, rng.uniform(0.2, 12, hit.shape), 12.0),
        np.where(hit, rng.normal(0, 0.6, hit.shape), 0.0),
        hit,
    )


@pytest.mark.parametrize("turn", [0.0, 1.0])
def test_sectors_equal_the_oracle(stage, turn):
    for seed in range(2):
        range_m, doppler, hit = (np.float32(a) for a in random_scan(seed))
        rng = np.random.default_rng(seed + 50)
        ping_yaw = rng.uniform(-3.1, 3.1, N_ENV).astype(np.float32)
        yaw = (ping_yaw + turn * rng.uniform(-0.2, 0.2, N_ENV)).astype(np.float32)
        got = stage.run(range_m, doppler, hit, yaw, ping_yaw)
        for env in range(N_ENV):
            turned = float(yaw[env] - ping_yaw[env])
            want = oracle.sectors(
                range_m[env], doppler[env], hit[env], turned, N_SECTOR, SONAR.max_range_m, FEATURES.ttc_cap_s
            )
            assert np.allclose(got[:, env], want, rtol=ROUNDING, atol=ROUNDING)


def test_a_turn_across_pi_is_no_turn_of_the_beams(stage):
    """Yaw wraps from pi to -pi between ping and now: the features must not notice."""
    range_m, doppler, hit = random_scan(1)
    near = stage.run(range_m, doppler, hit, np.full(N_ENV, 0.1), np.full(N_ENV, 0.0))
    wrapped = stage.run(range_m, doppler, hit, np.full(N_ENV, -np.pi + 0.05), np.full(N_ENV, np.pi - 0.05))
    assert np.allclose(near, wrapped, atol=ROUNDING)


def test_one_approaching_obstacle_by_hand(stage):
    range_m, doppler, hit = np.full((N_ENV, N_RAY), 12.0), np.zeros((N_ENV, N_RAY)), np.zeros((N_ENV, N_RAY))
    range_m[:, 64:67], doppler[:, 64:67], hit[:, 64:67] = (
        [2.0, 1.9, 2.1],
        [-0.5, -0.4, 0.3],
        1,
    )  # 90 degrees to the left
    got = stage.run(range_m, doppler, hit, np.zeros(N_ENV), np.zeros(N_ENV))
    assert np.allclose(got[:, :, 3].T, [1.9, 4.0, 0.5, 1])
    others = np.delete(got, 3, axis=2)
    assert np.allclose(others[0], 12) and np.allclose(others[1], FEATURES.ttc_cap_s) and not others[2:].any()


def test_sleeping_rows_keep_their_features(stage):
    quiet = np.zeros(N_ENV)
    first = stage.run(*random_scan(2), quiet, quiet)
    active = np.arange(N_ENV) % 3 == 0
    second = stage.run(*random_scan(3), quiet, quiet, active=active)
    assert np.array_equal(second[:, ~active], first[:, ~active])
    assert (second[:, active] != first[:, active]).any(axis=(0, 2)).all()


# ------------------------------------------------------------------------------------------------ observation

OBSERVATION_ROUNDING = 1e-5
"""Single precision of a rotation of positions of about 10 m."""


@pytest.fixture(scope="module")
def observed(stage):
    """(observation (n_env, n_obs), arrays it was made of, rows active) for random states; -7 was there
    before."""
    rng, arrays = np.random.default_rng(0), {}
    for struct, names in {
        stage.route: ("lookahead_w", "heading_error", "cross_track_m", "remaining_m", "path_risk"),
        stage.mission: ("goal_w",),
        stage.ego: ("pos_w", "rpy", "vel_b", "rate_b", "depth_m"),
        stage.observation: ("sector_range_m", "sector_ttc_s", "sector_closing_m_s"),
    }.items():
        for name in names:
            field = getattr(struct, name)
            arrays[name] = rng.uniform(-3, 3, field.to_numpy().shape).astype(np.float32)
            field.from_numpy(arrays[name])
    active = np.arange(N_ENV) % 4 != 1
    put(stage.clock, active=active)
    obs = torch.full((N_ENV, observation_width(FEATURES)), -7.0)
    write_observation(stage.io(ObservationIO, FEATURES), obs)
    return obs.numpy(), arrays, active


def test_observation_equals_the_oracle_in_every_column(observed):
    obs, arrays, active = observed
    for env in np.flatnonzero(active):
        want = oracle.observation({name: np.float64(a[env]) for name, a in arrays.items()})
        assert list(want) == [c.name for c in COLUMNS]
        for column, first, width in placed_columns(FEATURES):
            got = obs[env, first : first + width]
            np.testing.assert_allclose(
                got, np.broadcast_to(want[column.name], width), atol=OBSERVATION_ROUNDING, err_msg=column.name
            )


def test_sleeping_rows_keep_their_observation(observed):
    obs, _arrays, active = observed
    assert (obs[~active] == -7).all()


def test_first_columns_are_the_papers_targets_of_the_world_model():
    """3 goal errors, sine and cosine of the heading error, 3 velocities, yaw rate, depth, roll and pitch, 12
    ranges: 24."""
    names = [column.name for column, _first, width in placed_columns(FEATURES) for _ in range(width)]
    paper = {"goal": 3, "heading_error": 2, "velocity": 3, "yaw_rate": 1, "depth": 1, "tilt": 2}
    paper["sector_range"] = 12
    assert names[:24] == [name for name, width in paper.items() for _ in range(width)]


# ------------------------------------------------------------------------------------------ obstacles and
# advice

MORE = ObservationConfig(n_track=3, behavior=True)
FORECAST, TRACKING, TANK, RULES = ForecastConfig(), TrackingConfig(), TankConfig(), EpisodeConfig()

OBSTACLE_ROUNDING = 2e-5
"""Single precision of positions of about 10 m that are rotated."""


def span(name):
    """Columns of a group with obstacles and advice."""
    first, width = next(
        (first, width) for column, first, width in placed_columns(MORE) if column.name == name
    )
    return slice(first, first + width)


def run_obstacles(stage, values, active=1):
    """Observation (n_env, n_obs) of what is remembered of moving obstacles, -7 where nothing is written;
    ``values`` by 'struct.array'."""
    for name, array in values.items():
        struct, field = name.split(".")
        put(getattr(stage, struct), **{field: array})
    put(stage.clock, active=active)
    obs = torch.full((N_ENV, observation_width(MORE)), -7.0)
    write_obstacles(stage.io(ObservationIO, MORE, FORECAST, TRACKING, TANK, RULES), obs)
    return obs.numpy()


def no_obstacles():
    """Values of envs that rest level at the origin, 1 m deep, and remember nothing."""
    return {
        "forecast.radius_m": np.full((N_ENV, N_TRACK, N_FORECAST), -1, np.float32),
        "forecast.pos_w": np.zeros((N_ENV, N_TRACK, N_FORECAST, 2), np.float32),
        "forecast.above_w": np.full((N_ENV, N_TRACK), -1, np.float32),
        "forecast.below_w": np.full((N_ENV, N_TRACK), -1, np.float32),
        "tracks.state": np.zeros((N_ENV, N_TRACK, 4), np.float32),
        "tracks.turn_rate": np.zeros((N_ENV, N_TRACK), np.float32),
        "tracks.turn_cov": np.zeros((N_ENV, N_TRACK, 5), np.float32),
        "tracks.seen_step": np.zeros((N_ENV, N_TRACK), np.int32),
        "clock.step": np.full(N_ENV, 100, np.int32),
        "ego.pos_w": np.tile(np.float32([0, 0, -1]), (N_ENV, 1)),
        "ego.rpy": np.zeros((N_ENV, 3), np.float32),
        "ego.vel_b": np.zeros((N_ENV, 3), np.float32),
    }


def random_obstacles(seed):
    """Up to all slots moving, curved forecasts, every second obstacle's turn rate well known, heights known
    or not, own motion and tilt."""
    rng, values = np.random.default_rng(seed), no_obstacles()
    moving = rng.uniform(size=(N_ENV, N_TRACK)) < 0.6
    growth = rng.uniform(0, 0.02, (N_ENV, N_TRACK, N_FORECAST)).cumsum(axis=2)
    values["forecast.radius_m"] = np.where(
        moving[..., None], rng.uniform(0.1, 0.5, (N_ENV, N_TRACK, 1)) + growth, -1
    )
    steps = rng.normal(0, 0.1, (N_ENV, N_TRACK, 1, 2)) + rng.normal(0, 0.02, (N_ENV, N_TRACK, N_FORECAST, 2))
    values["forecast.pos_w"] = rng.uniform(-5, 5, (N_ENV, N_TRACK, 1, 2)) + steps.cumsum(axis=2)
    unknown = rng.uniform(size=(N_ENV, N_TRACK)) < 0.3
    values["forecast.above_w"] = np.where(unknown, FAR_M, rng.uniform(-1, 0, (N_ENV, N_TRACK)))
    values["forecast.below_w"] = np.where(unknown, -FAR_M, rng.uniform(-2, -1, (N_ENV, N_TRACK)))
    values["tracks.state"] = rng.uniform(-1, 1, (N_ENV, N_TRACK, 4))
    values["tracks.turn_rate"] = rng.normal(0, 0.5, (N_ENV, N_TRACK))
    values["tracks.turn_cov"][..., 4] = 10.0 ** rng.uniform(-4, 0, (N_ENV, N_TRACK))
    values["tracks.seen_step"] = rng.integers(0, 100, (N_ENV, N_TRACK))
    values["ego.pos_w"] = np.column_stack([rng.uniform(-1, 1, (N_ENV, 2)), np.full(N_ENV, -1.0)])
    values["ego.rpy"] = rng.uniform(-1, 1, (N_ENV, 3)) * [0.2, 0.2, 3]
    values["ego.vel_b"] = rng.normal(0, 0.5, (N_ENV, 3))
    kinds = {"clock.step": np.int32, "tracks.seen_step": np.int32}
    return {name: array.astype(kinds.get(name, np.float32)) for name, array in values.items()}


def test_obstacles_equal_the_oracle_in_every_column(stage):
    seen = 0
    for seed in range(3):
        values = random_obstacles(seed)
        obs = run_obstacles(stage, values)
        for env in range(N_ENV):
            want = oracle.obstacles(
                {name: np.float64(a[env]) for name, a in values.items()},
                MORE.n_track,
                FORECAST,
                TRACKING,
                TANK,
                RULES,
            )
            for name, rows in want.items():
                np.testing.assert_allclose(
                    obs[env, span(name)], rows.ravel(), atol=OBSTACLE_ROUNDING, err_msg=f"{name} in env {env}"
                )
            seen += int(want["obstacle_valid"].sum())
        assert list(want) == [column.name for column in columns(MORE) if column.per == "body"]
    assert 100 < seen < 3 * N_ENV * MORE.n_track


def test_obstacles_by_hand(stage):
    """Heading along y at 0.5 m/s. One body stands 2 m ahead, one comes from the right ahead at 1 m/s and
    passes behind, one recedes."""
    values = no_obstacles()
    values["ego.rpy"][:, 2] = np.pi / 2
    values["ego.vel_b"][:, 0] = 0.5
    values["forecast.radius_m"][:, [0, 2, 4]] = 0.3
    t = 0.1 * np.arange(N_FORECAST)
    values["forecast.pos_w"][:, 0] = [0, 2]
    values["forecast.pos_w"][:, 2] = np.stack([0.5 - t, 0 * t], axis=1)
    values["forecast.pos_w"][:, 4] = np.stack([0 * t, -1 - t], axis=1)
    values["tracks.state"][:, 2] = [0.5, 0, -1, 0]
    values["tracks.state"][:, 4] = [0, -1, 0, -1]
    values["tracks.seen_step"][:] = 75
    values["forecast.above_w"][:, 2], values["forecast.below_w"][:, 2] = -0.4, -FAR_M
    obs = run_obstacles(stage, values)[0]
    np.testing.assert_allclose(obs[span("obstacle_valid")], [1, 1, 1])
    np.testing.assert_allclose(obs[span("obstacle_position")], [0, -0.5, -1, 0, 2, 0], atol=OBSTACLE_ROUNDING)
    np.testing.assert_allclose(
        obs[span("obstacle_velocity")], [-0.5, 1, -1.5, 0, -0.5, 0], atol=OBSTACLE_ROUNDING
    )
    depth = TANK.z_m[1] - TANK.z_m[0]
    np.testing.assert_allclose(
        obs[span("obstacle_free_water")], [0.6, depth, 0, 0, 0, 0], atol=OBSTACLE_ROUNDING
    )
    np.testing.assert_allclose(obs[span("obstacle_age")], [0.5, 0.5, 0.5], atol=OBSTACLE_ROUNDING)
    # the crossing body: relative course (-1, -0.5) from (0.5, 0): closest at t = 0.4 s, where it is at (0.1,
    # -0.2)
    np.testing.assert_allclose(
        obs[span("obstacle_closest")],
        [np.hypot(0.1, 0.2) - 0.3, 0.7, 2 - 0.5 * 0.7 - 0.3],
        atol=OBSTACLE_ROUNDING,
    )
    np.testing.assert_allclose(obs[span("obstacle_closest_time")], [0.4, 0, 0.7], atol=OBSTACLE_ROUNDING)


def test_without_obstacles_their_columns_are_zero(stage):
    obs = run_obstacles(stage, no_obstacles())
    first = min(span(column.name).start for column in columns(MORE) if column.per == "body")
    last = max(span(column.name).stop for column in columns(MORE) if column.per == "body")
    assert not obs[:, first:last].any()
    assert (obs[:, :first] == -7).all() and (obs[:, last:] == -7).all(), "the others' columns are left alone"


def test_sleeping_rows_keep_their_obstacles(stage):
    active = np.arange(N_ENV) % 2 == 0
    obs = run_obstacles(stage, random_obstacles(1), active)
    assert (obs[~active] == -7).all() and (obs[active] != -7).any(axis=1).all()


LEAVES = (codes.BACK_OFF, codes.EVADE, codes.HOLD, codes.UNSTICK, codes.FOLLOW_ROUTE, codes.DRIVE_STRAIGHT)
CLASS_OF_LEAF = (0, 1, 2, 3, 4, 4)


def test_advice_is_what_the_tree_says(stage):
    """A tree of the six action leaves; env i lets leaf i act, the seventh none."""
    put(stage.table, leaf=[*LEAVES, -1, -1])
    acting = np.full(N_ENV, -1, np.int32)
    acting[: len(LEAVES)] = np.arange(len(LEAVES))
    rng = np.random.default_rng(3)
    action = rng.uniform(-1, 1, (N_ENV, 4)).astype(np.float32)
    conflict = np.where(np.arange(N_ENV) % 2 == 0, FAR_M, rng.uniform(0, 2.5, N_ENV)).astype(np.float32)
    cost = rng.uniform(0, 20, N_ENV).astype(np.float32)
    put(stage.behavior, leaf=acting, action=action, conflict_s=conflict, evade_cost=cost)
    active = np.arange(N_ENV) != 9
    put(stage.clock, active=active)
    tensor = torch.full((N_ENV, observation_width(MORE)), -7.0)
    write_advice(stage.io(ObservationIO, MORE), tensor)
    obs = tensor.numpy()
    assert span("behavior_class").stop == obs.shape[1], "the last columns of all"
    assert (obs[9] == -7).all() and (obs[:, : span("teacher_action").start] == -7).all()
    np.testing.assert_array_equal(obs[active, span("teacher_action")], action[active])
    np.testing.assert_array_equal(
        obs[active, span("behavior_conflict")][:, 0], np.minimum(conflict, MORE.ttc_cap_s)[active]
    )
    np.testing.assert_array_equal(
        obs[active, span("behavior_evade_cost")][:, 0], np.where(acting == 1, cost, 0)[active]
    )
    kinds = np.zeros((N_ENV, 5))
    kinds[np.arange(len(LEAVES)), CLASS_OF_LEAF] = 1
    np.testing.assert_array_equal(obs[active, span("behavior_class")], kinds[active])


def test_what_is_added_stands_behind_the_papers_columns():
    plain, more = placed_columns(FEATURES), placed_columns(MORE)
    assert more[: len(plain)] == plain and len(more) > len(plain)
    assert placed_columns(ObservationConfig(n_track=3))[-1][0].per == "body"
    assert placed_columns(ObservationConfig(behavior=True))[-1][0].name == "behavior_class"
