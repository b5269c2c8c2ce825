"""Unseen obstacles that may turn back: moments against a population and a float64 oracle, and rates."""

from functools import cache

import numpy as np
import pytest
import taichi as ti

from tests.bundles import Stage, clear, put
from tests.oracles import turn_history as habit_oracle
from uuvtai.config import Config
from uuvtai.kernels.core.simd import LANES
from uuvtai.kernels.core.stage import AnyTensor, Bundle
from uuvtai.kernels.perception.io import TrackingIO
from uuvtai.kernels.perception.prediction import STRAIGHT_ODDS
from uuvtai.kernels.perception.track_filter import turn_back_rate, turned_back
from uuvtai.kernels.perception.tracking import predict_tracks

N = 64
SIZES = {
    "n_env": N, "n_ray": 256, "n_track": 1, "n_cluster": 1, "n_height": LANES, "n_turn_row": 7, "n_turn": 48,
}  # fmt: skip
CFG = Config.model_validate({"traffic": {"leg_m": [2.0, 6.0]}, "forecast": {"use_turning_back": True}})
TRIANGLE = np.triu_indices(4)
SPEED = 1.5
ROUNDING = 2e-5
"""Of values up to 10, carried from step to step in float32; the noise's closed form is a difference of terms
seven digits long."""


@ti.kernel
def _turned(mean: AnyTensor, cov: AnyTensor, link: AnyTensor, rate: AnyTensor, dt: ti.f32):
    for i in range(N):
        m, p, c = ti.Vector([0.0] * 4), ti.Vector([0.0] * 10), ti.Vector([0.0] * 5)
        for k in ti.static(range(4)):
            m[k] = mean[i, k]
        for k in ti.static(range(10)):
            p[k] = cov[i, k]
        for k in ti.static(range(5)):
            c[k] = link[i, k]
        m, p, c = turned_back(m, p, c, rate[i], dt)
        for k in ti.static(range(4)):
            mean[i, k] = m[k]
        for k in ti.static(range(10)):
            cov[i, k] = p[k]
        for k in ti.static(range(5)):
            link[i, k] = c[k]


@ti.kernel
def _rates(dt: ti.f32, out: AnyTensor, io: Bundle[TrackingIO]):
    for env in range(N):
        out[env] = turn_back_rate(env, 0, dt, io)


@ti.kernel
def _predict(io: Bundle[TrackingIO]):
    for env in range(N):
        predict_tracks(env, io)


def full(cov):
    """(n, 4, 4) symmetric matrices of stored triangles (n, 10)."""
    out = np.zeros((len(cov), 4, 4))
    out[:, TRIANGLE[0], TRIANGLE[1]] = cov
    out[:, TRIANGLE[1], TRIANGLE[0]] = cov
    return out


def oracle(mean, cov, link, rate, dt):
    """One body, whole matrices; the noise is the velocity's kernel integrated over dt by Simpson's rule."""
    second = np.outer(mean[2:], mean[2:]) + cov[2:, 2:]
    square, axes = np.linalg.eigh(second)
    way = np.outer(axes[:, 1], axes[:, 1])
    lag = 2 * rate
    A = np.eye(4)
    A[2:, 2:] -= (1 - np.exp(-lag * dt)) * way
    A[:2, 2:] -= (dt - (1 - np.exp(-lag * dt)) / lag) * way
    t = np.linspace(0, dt, 2001)
    g = np.stack([(1 - np.exp(-lag * t)) / lag, np.exp(-lag * t)])
    weights = np.r_[1, np.tile([4, 2], 1000)[:-1], 1] * dt / 6000
    q = 2 * lag * square[1] * np.einsum("it,jt,t->ij", g, g, weights)
    return A @ mean, A @ cov @ A.T + np.kron(q, way), np.r_[A @ link[:4], link[4]]


def drawn(seed=1):
    rng = np.random.default_rng(seed)
    mean = np.concatenate([rng.uniform(0, 20, (N, 2)), rng.uniform(-1.5, 1.5, (N, 2))], 1)
    root = rng.normal(size=(N, 4, 4)) * [0.1, 0.1, 0.3, 0.3]
    cov = root.swapaxes(1, 2) @ root
    return mean, cov, rng.normal(size=(N, 5)) * 0.1, rng.uniform(0.01, 4.0, N)


@pytest.mark.parametrize("dt", [0.06, 0.3])
def test_moments_are_those_of_the_oracle(dt):
    mean, cov, link, rate = drawn()
    m, p, c, r = (
        np.ascontiguousarray(a, np.float32) for a in (mean, cov[:, TRIANGLE[0], TRIANGLE[1]], link, rate)
    )
    _turned(m, p, c, r, dt)
    for i in range(0, N, 4):
        em, ep, ec = oracle(mean[i], cov[i], link[i], rate[i], dt)
        np.testing.assert_allclose(m[i], em, atol=ROUNDING)
        np.testing.assert_allclose(p[i], ep[TRIANGLE], atol=ROUNDING)
        np.testing.assert_allclose(c[i], ec, atol=ROUNDING)


def test_moments_are_those_of_a_drawn_population():
    """Along (0.6, 0.8) at 1.5 m/s, turning back 0.4 times a second: 1.2 s in steps of 0.06 s."""
    rate, speed, steps = 0.4, 1.5, 20
    course = np.array([0.6, 0.8])
    rng = np.random.default_rng(4)
    sign, along = np.ones(200_000), np.zeros(200_000)
    for _ in range(240):
        along += 0.005 * speed * sign
        sign = np.where(rng.random(200_000) < rate * 0.005, -sign, sign)
    m = np.tile(np.r_[0.0, 0.0, speed * course], (N, 1)).astype(np.float32)
    p, c, r = np.zeros((N, 10), np.float32), np.zeros((N, 5), np.float32), np.full(N, rate, np.float32)
    straight = np.kron(np.array([[1, 0.06], [0, 1]]), np.eye(2))
    for _ in range(steps):
        m = np.ascontiguousarray(m @ straight.T, np.float32)
        p = np.ascontiguousarray(
            (straight @ full(p.astype(float)) @ straight.T)[:, TRIANGLE[0], TRIANGLE[1]], np.float32
        )
        _turned(m, p, c, r, 0.06)
    np.testing.assert_allclose(m[0, :2], along.mean() * course, atol=5e-3)
    np.testing.assert_allclose(m[0, 2:], speed * sign.mean() * course, atol=8e-3)
    expected = np.kron(np.cov(along, speed * sign), np.outer(course, course))
    np.testing.assert_allclose(full(p.astype(float))[0], expected, atol=0.02)


@cache
def straight_obstacles():
    return Stage(**SIZES)


def rates_of(kind, way, dt, turn_rate=0.0, turn_var=0.0, turned=None):
    """[1/s] along +x at 1.5 m/s, straight for ``way`` [m] since a turn (``kind`` 2) or since met (1)."""
    stage = straight_obstacles()
    tracks, turn_history = stage.tracks, stage.turn_history
    clear(tracks, turn_history)
    state = np.stack([way, 0 * way, 0 * way + SPEED, 0 * way], 1)[:, None]
    put(tracks, state=state, turn_rate=turn_rate)
    cov = np.zeros((N, 1, 5), np.float32)
    cov[..., 4] = turn_var
    tracks.turn_cov.from_numpy(cov)
    turn_history.run_kind.fill(kind)
    if turned is not None:
        turn_history.turn.from_numpy(turned)
    out = np.zeros(N, np.float32)
    _rates(dt, out, stage.io(TrackingIO, CFG.forecast, CFG.tracking, CFG.traffic))
    return out


def test_rate_is_the_share_of_ways_that_end():
    """Of ways of 2 to 6 m, one in twenty of any length, that have lasted so long."""
    way = np.linspace(0.0, 5.9, N)

    def lasting(y):
        return 0.95 * np.clip((6 - y) / 4, 0, 1) + 0.05 * np.exp(-y / 6)

    out = rates_of(2, way, 0.06)
    expected = np.log(lasting(way) / lasting(way + 0.09)) / 0.06
    np.testing.assert_allclose(out, expected, rtol=2e-3, atol=1e-4)
    assert expected.max() > 2 > 0.1 > expected.min()


@pytest.mark.parametrize("kind", [1, 2])
def test_rate_is_that_of_a_drawn_population(kind):
    """A way's begin was seen (2), or the body was met anywhere on it (1)."""
    rng, n, dt, way = np.random.default_rng(3), 1_000_000, 0.5, np.linspace(0.0, 4.5, N)
    length = rng.uniform(2, 6, n)
    met = np.ones(n, bool)
    if kind == 1:  # long ways are met more often, and each at any place
        met = rng.random(n) < length / 6
        length *= rng.random(n)
    length = np.sort(np.where(rng.random(n) < 0.05, rng.exponential(6.0, n), length)[met])
    ended = np.searchsorted(length, [way, way + SPEED * dt]) / len(length)
    expected = (ended[1] - ended[0]) / (1 - ended[0])
    np.testing.assert_allclose(1 - np.exp(-dt * rates_of(kind, way, dt)), expected, atol=4e-3)
    assert expected.max() > 3 * expected.min()


def test_obstacles_that_may_circle_turn_back_less_and_known_turns_leave_no_doubt():
    """Bayes' rule: prior odds against the densities of 0 turn rate in prior and posterior."""
    way = np.full(N, 3.0)
    usual = rates_of(2, way, 0.06)
    for turn_rate, var in ((0.0, 0.01), (0.2, 0.01), (0.5, 0.02)):
        bayes = np.sqrt(var) / CFG.tracking.turn_rate_sigma_rad_s * np.exp(0.5 * turn_rate**2 / var)
        straight = STRAIGHT_ODDS / (STRAIGHT_ODDS + bayes)
        np.testing.assert_allclose(rates_of(2, way, 0.06, turn_rate, var), straight * usual, rtol=1e-4)
    rows = habit_oracle.turn_rows(np.zeros((N, 7, 3, LANES), np.float32))
    for name, value in (("turn_x", 6.0), ("in_x", 1.0), ("out_x", -1.0), ("weight", 1.0)):
        rows[name][:, 0] = value
    assert usual.all() and not rates_of(2, way, 0.06, turned=habit_oracle.packed_turns(rows)).any()


def test_only_obstacles_that_beams_pass_by_may_have_turned():
    """One third each: beams meet nothing, meet something nearer, have just met the body."""
    stage = Stage(**SIZES)
    tracks, kind = stage.tracks, np.arange(N) % 3
    put(tracks, state=[3.0, 0.0, 1.5, 0.0], alive=1, moving=1, radius_m=0.2, misses=(kind < 2)[:, None])
    put(stage.clusters, scan_step=3)
    put(stage.scan, hit=(kind == 1)[:, None], range_m=1.0)
    _predict(stage.io(TrackingIO, CFG))
    mean, cov = tracks.state.to_numpy()[:, 0], tracks.cov.to_numpy()[:, 0]
    np.testing.assert_allclose(mean[kind > 0], np.tile([3.09, 0, 1.5, 0], ((kind > 0).sum(), 1)), atol=1e-6)
    assert (mean[kind == 0, 2] < 1.47).all() and (mean[kind == 0, 2] > 1.4).all()
    assert (cov[kind == 0, 7] > 10 * cov[kind > 0, 7].max()).all()
