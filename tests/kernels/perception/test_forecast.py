"""Forecasts of tracks set by hand against closed forms in float64."""

import numpy as np
import pytest

from tests.bundles import Stage, clear, put
from tests.oracles import forecast as oracle
from tests.oracles import turn_history as habit_oracle
from uuvtai.config import EpisodeConfig, ForecastConfig, TankConfig, TrackingConfig
from uuvtai.kernels.core.simd import LANES
from uuvtai.kernels.perception import prediction
from uuvtai.kernels.perception.io import TrackingIO

N_ENV, N_TRACK = 6, 5
TRACKING, RULES, TANK = TrackingConfig(), EpisodeConfig(), TankConfig()
SIZES = {
    "n_env": N_ENV, "n_ray": 16, "n_track": N_TRACK, "n_cluster": 1, "n_pixel_row": 1, "n_pixel_col": LANES,
    "n_height": LANES, "n_turn_row": 7, "n_turn": 16,
    "n_forecast": round(TRACKING.horizon_s / TRACKING.forecast_dt_s) + 1,
}  # fmt: skip
AHEAD = TRACKING.forecast_dt_s * np.arange(SIZES["n_forecast"])

POSITION_TOLERANCE = 1e-4
"""[m] 26 steps of at most 0.3 m at positions up to 20 m in float32 (1e-6 m each), and a series of the chord
good to 2e-6 of 7.5 m."""

WALK_TOLERANCE = 2e-3
"""[m] six turns: each place is good to 1e-5 m in float32, and a course that meets a wall at a small angle
makes up to a hundred of that."""

GROWTH_TOLERANCE = 2e-4
"""[m] a square root of a variance that float32 forms from terms up to 100 times as large."""


class Rig(Stage):
    sizes = SIZES

    def begin(self, cfg=None):
        self.cfg = cfg or ForecastConfig()
        clear(self.tracks, self.clock)
        self.clock.active.fill(1)
        self.clusters.fresh.fill(1)
        self.image.fresh.fill(0)
        prediction.reset_forecast(self.io(TrackingIO))
        return self

    def predict(self):
        prediction.forecast_tracks(self.io(TrackingIO, self.cfg, TRACKING, TANK, RULES))
        return self.forecast.pos_w.to_numpy().astype(float), self.forecast.radius_m.to_numpy().astype(float)


stage = Rig.fixture()


def random_tracks(seed):
    """Moving tracks in every slot, with turn rates up to 4 rad/s (some 0) and their variances."""
    rng = np.random.default_rng(seed)
    size = (N_ENV, N_TRACK)
    course, speed = rng.uniform(-np.pi, np.pi, size), rng.uniform(0.1, 3.0, size)
    pos = rng.uniform([2, 1], [18, 5], (*size, 2))
    state = np.concatenate(
        [pos, speed[..., None] * np.stack([np.cos(course), np.sin(course)], -1)], -1
    ).astype(np.float32)
    root = rng.normal(0, 0.1, (*size, 4, 4))
    cov = (root @ np.swapaxes(root, -1, -2)).astype(np.float32)
    rate = np.where(rng.random(size) < 0.3, 0.0, rng.uniform(-4, 4, size)).astype(np.float32)
    sigma = rng.uniform(0.02, 4, size)
    return state, cov, rng.uniform(0.1, 0.4, size).astype(np.float32), rate, sigma


def lay_out(stage, state, cov, radius, rate, sigma):
    row, col = np.triu_indices(4)
    ones = np.ones((N_ENV, N_TRACK))
    turn_cov = np.zeros((N_ENV, N_TRACK, 5))
    turn_cov[..., 4] = sigma**2
    put(
        stage.tracks,
        alive=ones, moving=ones, state=state, cov=cov[..., row, col], radius_m=radius, turn_rate=rate,
        turn_cov=turn_cov,
    )  # fmt: skip


def test_forecast_equals_the_arc(stage):
    """The scan is two steps old: sample k lies 0.04 + 0.1 k seconds along the arc (along the tangent where
    the turn rate does not stand out of its noise)."""
    stage.begin(ForecastConfig(use_reflection=False))
    state, cov, radius, rate, sigma = random_tracks(1)
    lay_out(stage, state, cov, radius, rate, sigma)
    stage.clock.step.fill(2)
    pos, size = stage.predict()
    arcs = 0
    for env, track in np.ndindex(N_ENV, N_TRACK):
        x = state[env, track].astype(float)
        turn = habit_oracle.expected_turn_rate(
            float(rate[env, track]), float(sigma[env, track]) ** 2, stage.cfg, TRACKING
        )
        arcs += turn != 0
        for k, t in enumerate(AHEAD + 2 * RULES.control_dt_s):
            np.testing.assert_allclose(
                pos[env, track, k], oracle.arc(x[:2], x[2:], turn, t), atol=POSITION_TOLERANCE
            )
            grown = radius[env, track] + oracle.growth(cov[env, track].astype(float), t, TRACKING)
            np.testing.assert_allclose(size[env, track, k], grown, atol=GROWTH_TOLERANCE)
    assert 5 < arcs < N_ENV * N_TRACK - 5


def test_only_moving_tracks_of_awake_rows_are_forecast(stage):
    """A track that came to rest or ended loses its forecast; rows inactive keep theirs."""
    stage.begin()
    lay_out(stage, *random_tracks(2))
    _, first = stage.predict()
    assert (first > 0).all()
    moving = np.ones((N_ENV, N_TRACK))
    moving[:, 1] = 0
    alive = np.ones((N_ENV, N_TRACK))
    alive[:, 2] = 0
    put(stage.tracks, moving=moving, alive=alive)
    active = np.arange(N_ENV) % 2
    stage.clock.active.from_numpy(active.astype(np.int32))
    _, then = stage.predict()
    assert (then[active == 1][:, [1, 2]] < 0).all()
    assert (then[active == 1][:, [0, 3, 4]] > 0).all()
    np.testing.assert_array_equal(then[active == 0], first[active == 0])
    stage.clock.active.fill(1)
    prediction.reset_forecast(stage.io(TrackingIO))
    assert (stage.forecast.radius_m.to_numpy() < 0).all()
    assert (stage.forecast.pos_w.to_numpy() == 0).all()


@pytest.mark.parametrize("switches", [(True, True), (True, False), (False, True)])
def test_forecast_equals_the_walk_from_turn_to_turn(stage, switches):
    """Straight courses with remembered turns: the oracle's walk, in leaps of the samples; without the history
    the turn rate is left out too."""
    stage.begin(
        ForecastConfig(
            n_turn=SIZES["n_turn"], use_turn_history=switches[0], use_reflection=switches[1],
            use_turn_rate=switches[0],
        )
    )  # fmt: skip
    state, cov, radius, rate, sigma = random_tracks(3)
    lay_out(stage, state, cov, radius, 0 * rate if switches[0] else rate, sigma)
    rng = np.random.default_rng(4)
    turns = [
        [habit_oracle.Turn(np.zeros(2), np.ones(2), np.ones(2), 0.0) for _ in range(SIZES["n_turn"])]
        for _ in range(N_ENV)
    ]
    for env, i in np.ndindex(N_ENV, 10):
        x = state[env, i % N_TRACK].astype(float)
        course, after = np.arctan2(x[3], x[2]) + rng.normal(0, 0.1), rng.uniform(-np.pi, np.pi)
        came, went = np.array([np.cos(course), np.sin(course)]), np.array([np.cos(after), np.sin(after)])
        place = (x[:2] + rng.uniform(0.2, 2) * came + rng.normal(0, 0.1, 2)).astype(np.float32)
        turns[env][i] = habit_oracle.Turn(place.astype(float), came, went, 1.0)
    columns = np.array([[[*t.pos, *t.came, *t.went, t.weight] for t in row] for row in turns])
    rows = dict(zip(habit_oracle.TURN_ROWS, np.moveaxis(columns, -1, 0), strict=True))
    stage.turn_history.turn.from_numpy(habit_oracle.packed_turns(rows))
    stage.clock.step.fill(2)
    pos, _ = stage.predict()
    turned = 0
    for env, track in np.ndindex(N_ENV, N_TRACK):
        x = state[env, track].astype(float)
        times = AHEAD + 2 * RULES.control_dt_s
        where, last = habit_oracle.walk(
            turns[env], x, float(radius[env, track]), times, stage.cfg, TANK, prediction.MOST_LEGS
        )
        np.testing.assert_allclose(pos[env, track], where, atol=WALK_TOLERANCE)
        turned += last @ habit_oracle.unit(x[2:]) < 0.9
    assert turned > 10, turned


def test_the_first_turn_is_searched_again_when_a_scan_or_an_image_has_come(stage):
    """It goes east and turns north 0.6 m ahead; between scans nothing is searched, nothing forgotten."""
    for news in ("clusters", "image"):
        stage.begin(ForecastConfig(n_turn=SIZES["n_turn"], use_reflection=False))
        size = (N_ENV, N_TRACK)
        state = np.broadcast_to([5.0, 3.0, 0.5, 0.0], (*size, 4))
        lay_out(
            stage, state, np.broadcast_to(1e-4 * np.eye(4), (*size, 4, 4)), np.full(size, 0.2),
            np.zeros(size), np.ones(size),
        )  # fmt: skip
        rows = {name: np.zeros((N_ENV, SIZES["n_turn"])) for name in habit_oracle.TURN_ROWS}
        for name, value in (("turn_x", 5.6), ("turn_y", 3.0), ("in_x", 1.0), ("out_y", 1.0), ("weight", 1.0)):
            rows[name][:, 0] = value
        stage.turn_history.turn.from_numpy(habit_oracle.packed_turns(rows))
        north = 3.0 + 0.5 * AHEAD[-1] - 0.6
        np.testing.assert_allclose(stage.predict()[0][..., -1, 1], north, atol=WALK_TOLERANCE)
        stage.clusters.fresh.fill(0)
        stage.turn_history.turn.fill(0.0)
        np.testing.assert_allclose(stage.predict()[0][..., -1, 1], north, atol=WALK_TOLERANCE)
        getattr(stage, news).fresh.fill(1)
        np.testing.assert_allclose(stage.predict()[0][..., -1, 1], 3.0, atol=WALK_TOLERANCE)
