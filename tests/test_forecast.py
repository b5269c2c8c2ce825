"""Forecasts of tracks set by hand against closed forms in float64."""

import numpy as np
import pytest

from tests.reference import forecast as oracle
from uuvtai.config import EpisodeConfig, ForecastConfig, TrackingConfig
from uuvtai.kernels import forecast
from uuvtai.kernels.lanes import LANES
from uuvtai.state import ClockState, ForecastState, TrackState, allocate

N_ENV, N_TRACK = 6, 5
TRACKING, RULES = TrackingConfig(), EpisodeConfig()
SIZES = {
    "n_env": N_ENV,
    "n_ray": 16,
    "n_track": N_TRACK,
    "n_height": LANES,
    "n_forecast": round(TRACKING.horizon_s / TRACKING.forecast_dt_s) + 1,
}
AHEAD = TRACKING.forecast_dt_s * np.arange(SIZES["n_forecast"])

POSITION_TOLERANCE = 1e-4
"""[m] 26 steps of at most 0.3 m at positions up to 20 m in float32 (1e-6 m each), and a series of the chord good to 2e-6 of 7.5 m."""

GROWTH_TOLERANCE = 2e-4
"""[m] a square root of a variance that float32 forms from terms up to 100 times as large."""


class Stage:
    def __init__(self):
        self.tracks, self.clock, self.forecast = allocate(TrackState, SIZES), allocate(ClockState, SIZES), allocate(ForecastState, SIZES)

    def begin(self, cfg=None):
        self.cfg = cfg or ForecastConfig()
        for struct in (self.tracks, self.clock):
            for field in vars(struct).values():
                field.fill(0)
        self.clock.awake.fill(1)
        forecast.reset_forecast(self.forecast, self.clock)
        return self

    def put(self, **fields):
        for name, value in fields.items():
            field = getattr(self.tracks, name)
            field.from_numpy(np.asarray(value).astype(field.to_numpy().dtype))

    def predict(self):
        forecast.forecast_tracks(self.forecast, self.tracks, self.clock, self.cfg, TRACKING, RULES)
        return self.forecast.pos_w.to_numpy().astype(float), self.forecast.radius_m.to_numpy().astype(float)


@pytest.fixture(scope="module")
def stage():
    return Stage()


def random_tracks(seed):
    """Moving tracks in every slot: states, covariances (4 x 4), radii, turn rates up to 4 rad/s (and some 0) with their variances."""
    rng = np.random.default_rng(seed)
    size = (N_ENV, N_TRACK)
    course, speed = rng.uniform(-np.pi, np.pi, size), rng.uniform(0.1, 3.0, size)
    pos = rng.uniform([2, 1], [18, 5], (*size, 2))
    state = np.concatenate([pos, speed[..., None] * np.stack([np.cos(course), np.sin(course)], -1)], -1).astype(np.float32)
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
    stage.put(alive=ones, moving=ones, state=state, cov=cov[..., row, col], radius_m=radius, turn_rate=rate, turn_cov=turn_cov)


@pytest.mark.parametrize("use_turn_rate", [True, False])
def test_forecast_equals_the_arc(stage, use_turn_rate):
    """The scan is two steps old: sample k lies 0.04 + 0.1 k seconds along the arc (along the tangent where the switch is off, and where
    the turn rate does not stand out of its noise)."""
    stage.begin(ForecastConfig(use_turn_rate=use_turn_rate))
    state, cov, radius, rate, sigma = random_tracks(1)
    lay_out(stage, state, cov, radius, rate, sigma)
    stage.clock.step.fill(2)
    pos, size = stage.predict()
    assert 5 < (np.abs(rate) > sigma).sum() < N_ENV * N_TRACK - 5
    for env, track in np.ndindex(N_ENV, N_TRACK):
        x = state[env, track].astype(float)
        clear = use_turn_rate and abs(rate[env, track]) > stage.cfg.straight_sigmas * sigma[env, track]
        turn = float(rate[env, track]) if clear else 0.0
        for k, t in enumerate(AHEAD + 2 * RULES.control_dt_s):
            np.testing.assert_allclose(pos[env, track, k], oracle.arc(x[:2], x[2:], turn, t), atol=POSITION_TOLERANCE)
            grown = radius[env, track] + oracle.growth(cov[env, track].astype(float), t, TRACKING)
            np.testing.assert_allclose(size[env, track, k], grown, atol=GROWTH_TOLERANCE)


def test_only_moving_tracks_of_awake_rows_are_forecast(stage):
    """A track that came to rest or ended loses its forecast; rows asleep keep theirs."""
    stage.begin()
    lay_out(stage, *random_tracks(2))
    _, first = stage.predict()
    assert (first > 0).all()
    moving = np.ones((N_ENV, N_TRACK))
    moving[:, 1] = 0
    alive = np.ones((N_ENV, N_TRACK))
    alive[:, 2] = 0
    stage.put(moving=moving, alive=alive)
    awake = np.arange(N_ENV) % 2
    stage.clock.awake.from_numpy(awake.astype(np.int32))
    _, then = stage.predict()
    assert (then[awake == 1][:, [1, 2]] < 0).all()
    assert (then[awake == 1][:, [0, 3, 4]] > 0).all()
    np.testing.assert_array_equal(then[awake == 0], first[awake == 0])
    stage.clock.awake.fill(1)
    forecast.reset_forecast(stage.forecast, stage.clock)
    assert (stage.forecast.radius_m.to_numpy() < 0).all()
    assert (stage.forecast.pos_w.to_numpy() == 0).all()
