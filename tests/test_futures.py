"""Futures of bodies that may turn back: probabilities against a drawn population of ways, places against
closed forms."""

import numpy as np
import pytest

from tests.bundles import io_for
from tests.reference import habits as habit_oracle
from uuvtai.config import Config
from uuvtai.kernels.core.lanes import LANES
from uuvtai.kernels.perception import forecast, futures
from uuvtai.kernels.perception.bundles import ForecastIO, FuturesIO
from uuvtai.state import (
    ClockState,
    ForecastState,
    FutureState,
    HabitState,
    Proprioception,
    TrackState,
    allocate,
)

CFG = Config.model_validate(
    {"traffic": {"leg_m": [2.0, 6.0], "corner_share": 0.0}, "forecast": {"turn_back_s": [0.5, 1.2, 2.2]}}
)
N_ENV, N_TRACK = 3, 4
N_SAMPLE = round(CFG.tracking.horizon_s / CFG.tracking.forecast_dt_s) + 1
AHEAD = CFG.tracking.forecast_dt_s * np.arange(N_SAMPLE)
SIZES = {
    "n_env": N_ENV, "n_ray": 16, "n_track": N_TRACK, "n_height": LANES, "n_turn_row": 7, "n_turn": 48,
    "n_forecast": N_SAMPLE, "n_future": 6,
}  # fmt: skip
ODD = 0.05
"""Share of ways with an exponential length of mean 6 m, as futures.py says."""
SPEED = 1.5
RADIUS = 0.2


class Stage:
    """Bodies at (10, 3) that swim along +x at 1.5 m/s, known to go straight; what is left to say is how far
    they have come."""

    def __init__(self):
        self.tracks, self.habits = allocate(TrackState, SIZES), allocate(HabitState, SIZES)
        self.forecast, self.futures = allocate(ForecastState, SIZES), allocate(FutureState, SIZES)
        self.clock, self.ego = allocate(ClockState, SIZES), allocate(Proprioception, SIZES)

    def begin(self):
        for struct in (self.tracks, self.futures, self.clock, self.ego):
            for field in vars(struct).values():
                field.fill(0)
        self.clock.awake.fill(1)
        forecast.reset_forecast(io_for(ForecastIO, self.forecast, self.habits, self.clock))
        self.tracks.alive.fill(1)
        self.tracks.moving.fill(1)
        self.tracks.radius_m.fill(RADIUS)
        self.swim((10.0, 3.0), (SPEED, 0.0))
        return self

    def swim(self, pos, vel):
        where = np.asarray(pos) + np.outer(AHEAD, vel)
        shape = (N_ENV, N_TRACK, N_SAMPLE)
        self.forecast.pos_w.from_numpy(np.broadcast_to(where, (*shape, 2)).astype(np.float32).copy())
        self.forecast.radius_m.fill(RADIUS)

    def run(self, kind, way_m):
        begin = np.broadcast_to(np.array([10.0 - way_m, 3.0], np.float32), (N_ENV, N_TRACK, 2))
        self.habits.run_kind.fill(kind)
        self.habits.run_from_w.from_numpy(begin.copy())

    def weigh(self, cfg=CFG):
        futures.weigh_futures(
            io_for(
                FuturesIO, self.futures, self.clock, self.ego, self.forecast, self.habits, self.tracks,
                cfg.forecast, cfg.world.tank, cfg.teacher, cfg.tracking, cfg.traffic,
            )
        )  # fmt: skip
        return self.futures.share.to_numpy().astype(float), self.futures.pos_w.to_numpy().astype(float)


@pytest.fixture(scope="module")
def made():
    return Stage()


@pytest.fixture
def stage(made):
    return made.begin()


def drawn_shares(kind, way_m, wall_m):
    """Shares of a drawn population that turn in each of the three spans, of those that have gone straight for
    ``way_m`` and turn before the wall."""
    rng, n = np.random.default_rng(3), 4_000_000
    length = rng.uniform(2, 6, n)
    met = np.ones(n, bool)
    if kind != 2:  # long ways are met more often, and each at any place
        met = rng.random(n) < length / 6
        length *= rng.random(n)
    length = np.where(rng.random(n) < ODD, rng.exponential(6.0, n), length)[met]
    alive = (length > way_m) & (length < way_m + wall_m)
    edges = way_m + np.minimum(SPEED * np.array([0.0, *CFG.forecast.turn_back_s]), wall_m)
    counts = np.histogram(length[alive], edges)[0]
    return counts / alive.sum()


@pytest.mark.parametrize(("kind", "way_m"), [(2, 0.5), (2, 2.5), (2, 4.5), (1, 0.0), (1, 1.5), (1, 3.5)])
def test_shares_are_those_of_a_drawn_population(stage, kind, way_m):
    """A way's begin was seen (2), or the body was met anywhere on it (1)."""
    stage.run(kind, way_m)
    share, _ = stage.weigh()
    wall_m = CFG.world.tank.x_m[1] - RADIUS - 10.0
    expected = drawn_shares(kind, way_m, wall_m)
    np.testing.assert_allclose(share[..., :3], np.broadcast_to(expected, (N_ENV, N_TRACK, 3)), atol=4e-3)
    assert not share[..., 3:].any()
    assert 0.05 < expected.sum() < 1 or (kind, way_m) == (2, 0.5)


def test_no_body_turns_beyond_the_wall(stage):
    """1 m before the wall every turn comes before it: within 0.67 s, so in the first two spans."""
    stage.swim((20.0 - RADIUS - 1.0, 3.0), (SPEED, 0.0))
    stage.habits.run_kind.fill(1)
    stage.habits.run_from_w.from_numpy(np.full((N_ENV, N_TRACK, 2), (17.0, 3.0), np.float32))
    share, _ = stage.weigh()
    np.testing.assert_allclose(share[..., :2].sum(-1), 1.0, atol=1e-4)
    np.testing.assert_allclose(share[..., 2], 0.0, atol=1e-5)


def test_a_future_turns_back_in_the_middle_of_its_span(stage):
    stage.run(1, 0.0)
    _, pos = stage.weigh()
    for future, turns_s in enumerate((0.25, 0.85, 1.7)):
        along = 10 + SPEED * np.where(turns_s > AHEAD, AHEAD, 2 * turns_s - AHEAD)
        np.testing.assert_allclose(pos[0, 0, future], np.stack([along, 0 * along + 3], -1), atol=1e-4)


def test_circles_known_turns_and_resting_tracks_have_no_futures(stage):
    """One track of each kind beside one that goes straight."""
    stage.run(1, 0.0)
    rate, var = np.zeros((N_ENV, N_TRACK), np.float32), np.zeros((N_ENV, N_TRACK, 5), np.float32)
    rate[:, 1], var[:, 1, 4] = 1.0, 1e-3
    stage.tracks.turn_rate.from_numpy(rate)
    stage.tracks.turn_cov.from_numpy(var)
    radius = stage.forecast.radius_m.to_numpy()
    radius[:, 2] = -1.0
    stage.forecast.radius_m.from_numpy(radius)
    places = stage.forecast.pos_w.to_numpy()
    places[:, 3] = places[:, 3, :1]
    stage.forecast.pos_w.from_numpy(places)
    share, _ = stage.weigh()
    assert (share[:, 0, :3] > 0).all()
    assert not share[:, 1:].any()


def test_a_turn_seen_before_leaves_no_doubt(stage):
    stage.run(2, 3.0)
    rows = habit_oracle.turn_rows(stage.habits.turn.to_numpy())
    for name, value in (("turn_x", 13.0), ("turn_y", 3.0), ("in_x", 1.0), ("out_x", -1.0), ("weight", 1.0)):
        rows[name][:, 0] = value
    stage.habits.turn.from_numpy(habit_oracle.packed_turns(rows))
    share, _ = stage.weigh()
    assert not share.any()


# --------------------------------------------------------------------------------------------------- corners

TANK = CFG.world.tank
CORNERS = CFG.model_copy(update={"traffic": CFG.traffic.model_copy(update={"corner_share": 1.0})})
EITHER = CFG.model_copy(update={"traffic": CFG.traffic.model_copy(update={"corner_share": 0.5})})


def drawn_ways(n=30_000_000):
    """(way behind, way ahead) of drawn ways between two places in the tank that pass (10, 3) along +x."""
    rng, behind, ahead = np.random.default_rng(5), [], []
    for _ in range(10):
        one, other = (
            np.stack([rng.uniform(RADIUS, 20 - RADIUS, n // 10), rng.uniform(RADIUS, 6 - RADIUS, n // 10)])
            for _ in range(2)
        )
        course = (other - one) / np.linalg.norm(other - one, axis=0)
        off = np.array([[10.0], [3.0]]) - one
        along, aside = (off * course).sum(0), off[0] * course[1] - off[1] * course[0]
        left = np.linalg.norm(other - one, axis=0) - along
        met = (course[0] > np.cos(0.15)) & (abs(aside) < 0.15) & (along > 0) & (left > 0)
        behind.append(along[met])
        ahead.append(left[met])
    return np.concatenate(behind), np.concatenate(ahead)


def test_the_next_corner_is_as_near_as_in_drawn_ways(stage):
    """Of ways between any two places the share with a corner within the horizon's 2.2 s, where the body was
    met on its way (1), and where its way began 4 m behind (3)."""
    behind, ahead = drawn_ways()
    for kind, begun, of in ((1, 0.0, behind > 0), (1, 3.0, behind > 3), (3, 4.0, abs(behind - 4) < 0.5)):
        stage.run(kind, begun)
        stage.weigh(CORNERS)
        within = (ahead[of] < 2.2 * SPEED).mean()
        error = 4 * np.sqrt(within / of.sum()) + 0.01
        np.testing.assert_allclose(stage.futures.corner.to_numpy(), within, atol=error)
        assert of.sum() > 500 and 0.02 < within < 0.9


def test_a_corner_leads_to_the_vehicle_as_often_as_to_any_such_place(stage):
    """Shares of the courses from the corner to places drawn in the tank that pass the vehicle, and paths."""
    drawn = np.random.default_rng(6).uniform((RADIUS, RADIUS), (20 - RADIUS, 6 - RADIUS), (400_000, 2))
    for own in ((10.3, 4.5), (13.0, 3.0), (8.0, 2.0)):
        stage.run(1, 0.0)
        stage.ego.pos_w.from_numpy(np.tile(np.array([*own, -0.8], np.float32), (N_ENV, 1)))
        share, pos = stage.weigh(CORNERS)
        place = np.array([10.0 + 0.25 * SPEED, 3.0])
        off, out = np.array(own) - place, drawn - place
        angle = np.arctan2(off[0] * out[:, 1] - off[1] * out[:, 0], out @ off)
        expected = (abs(angle) < np.arctan2(RADIUS + 0.3, np.linalg.norm(off))).mean()
        first = drawn_share(stage, 0.5)
        np.testing.assert_allclose(share[..., 3] / first, expected, rtol=0.2)  # its middle stands for all
        there = pos[0, 0, 3] - place
        beyond = AHEAD > 0.3
        aside = (there[:, 0] * off[1] - there[:, 1] * off[0]) / np.linalg.norm(off)
        np.testing.assert_allclose(aside[beyond], 0.0, atol=1e-4)
        paces = np.linalg.norm(np.diff(pos[0, 0, 3, 4:], axis=0), axis=1)
        np.testing.assert_allclose(paces, 0.1 * SPEED, atol=1e-4)
        assert (there[beyond] @ off > 0).all()


def drawn_share(stage, span_s):
    """Probability of a corner within the first span, by the formula that the test above checks."""
    d, q, w = SPEED * span_s, 10.0 - RADIUS, 10.0 - RADIUS
    return d * (q + d) / (w * (q + w))


def test_bayes_tells_corners_from_turning_back(stage):
    """Of bodies that do either as often: after a corner nearly none turns back, after a turn back fewer turn
    corners (in the middle of the tank a third of the corners lead back), and who goes straight for longer
    than any way to and fro turns corners."""
    shares = {}
    for kind, begun in ((1, 0.0), (2, 1.0), (3, 1.0), (1, 8.0)):
        stage.run(kind, begun)
        share, _ = stage.weigh(EITHER)
        corner = float(stage.futures.corner.to_numpy()[0, 0])
        stage.run(kind, begun)
        stage.weigh(CORNERS)
        alone = float(stage.futures.corner.to_numpy()[0, 0])
        shares[kind, begun] = corner / alone
        assert 0 <= share[0, 0].sum() <= 1
    assert shares[1, 0.0] == pytest.approx(0.5, abs=0.01)
    assert shares[3, 1.0] > 0.97 and shares[2, 1.0] < 0.3 and shares[1, 8.0] > 0.9
