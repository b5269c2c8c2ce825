"""What is learnt from tracks that turn: against a float64 oracle, on lines, loops and circles."""

import numpy as np
import pytest
import taichi as ti

from tests.bundles import Stage, clear, put
from tests.oracles import turn_history as oracle
from uuvtai.config import EpisodeConfig, ForecastConfig, TankConfig
from uuvtai.kernels.core.simd import LANES
from uuvtai.kernels.core.stage import Bundle
from uuvtai.kernels.perception import prediction
from uuvtai.kernels.perception.io import TrackingIO

N_ENV, N_TRACK, PERIOD = 6, 5, 3
CONFIG, RULES = ForecastConfig(n_turn=16), EpisodeConfig()
SIZES = {
    "n_env": N_ENV, "n_ray": 16, "n_track": N_TRACK, "n_cluster": 4, "n_height": LANES,
    "n_turn_row": 7, "n_turn": CONFIG.n_turn, "n_forecast": 3,
}  # fmt: skip
PERIOD_S = PERIOD * RULES.control_dt_s

TURN_TOLERANCE = 2e-4
"""[m], and of unit courses: positions of up to 20 m in float32 (1e-6 m), divided by 1 - cos of a turn of at
least 26 deg (0.1)."""

SETTLED_COV = 0.01 * np.eye(4)[np.triu_indices(4)]


class Rig(Stage):
    sizes = SIZES

    def begin(self):
        clear(self.tracks, self.clock, self.clusters)
        put(self.clock, active=1)
        put(self.clusters, fresh=1)
        put(self.tracks, moving=1, alive=1)
        self.step = 0
        prediction.reset_forecast(self.io(TrackingIO))
        return self

    def watch(self, state, cov=SETTLED_COV, rate=0.0, rate_var=0.01, **fields):
        """One scan later: every track's state (N_ENV, N_TRACK, 4) and what the filter says of it."""
        self.step += PERIOD
        turn_cov = np.zeros((N_ENV, N_TRACK, 5))
        turn_cov[..., 4] = rate_var
        put(
            self.tracks, state=state, cov=cov, turn_rate=rate, turn_cov=turn_cov, scan_step=self.step,
            **{"age": self.step, **fields},
        )  # fmt: skip
        prediction.learn_turns(self.io(TrackingIO, CONFIG, RULES))

    def read(self):
        """Every array of the turn history; the packed ones as (N_ENV, n_turn)."""
        out = {name: field.to_numpy() for name, field in vars(self.turn_history).items()}
        return out | oracle.turn_rows(out.pop("turn"))

    def turns(self, env):
        """Remembered turns of one env: rows of (x, y, in x, in y, out x, out y, weight)."""
        table = self.read()
        rows = np.stack([table[name][env] for name in oracle.TURN_ROWS], -1)
        return rows[rows[:, 6] > 0]


stage = Rig.fixture()


def oracle_turns(table, env):
    columns = [table[n][env].astype(float) for n in oracle.TURN_ROWS]
    return [
        oracle.Turn(np.array(c[0:2]), np.array(c[2:4]), np.array(c[4:6]), c[6])
        for c in zip(*columns, strict=True)
    ]


class Loops:
    """Obstacles on closed polylines with as many corners as asked for (2 = a line), all at one speed."""

    def __init__(self, rng, n_corner, speed, low=(1, 1), high=(19, 5)):
        self.way = rng.uniform(low, high, (N_ENV, N_TRACK, n_corner, 2))
        self.speed = speed
        self.measure()

    def measure(self):
        self.leg = np.roll(self.way, -1, 2) - self.way
        self.length = np.maximum(np.linalg.norm(self.leg, axis=-1), 1e-9)

    def at(self, t):
        state = np.zeros((N_ENV, N_TRACK, 4))
        for env, track in np.ndindex(N_ENV, N_TRACK):
            rest = (self.speed * t) % self.length[env, track].sum()
            for j, length in enumerate(self.length[env, track]):
                if rest <= length:
                    u = self.leg[env, track, j] / length
                    state[env, track] = *(self.way[env, track, j] + rest * u), *(self.speed * u)
                    break
                rest -= length
        return state


def test_learning_equals_the_oracle(stage):
    """Noisy tracks on loops and lines, now and then unsettled or unseen: every scan, in half of the envs."""
    stage.begin()
    rng = np.random.default_rng(1)
    paths = Loops(rng, 3, 1.5)
    paths.way[:, ::2, 2] = paths.way[:, ::2, 0]  # every other obstacle goes back and forth
    paths.measure()
    learnt = merged = dropped = 0
    for k in range(260):
        state = (paths.at(k * PERIOD_S) + rng.normal(0, 0.02, (N_ENV, N_TRACK, 4))).astype(np.float32)
        cov = np.where(rng.random((N_ENV, N_TRACK, 1)) < 0.2, 0.2, 0.01) * np.eye(4)[np.triu_indices(4)]
        rate = rng.normal(0, 0.08, (N_ENV, N_TRACK)).astype(np.float32)
        rate_var = rng.choice([0.0, 0.01, 0.01, 0.25], (N_ENV, N_TRACK)).astype(np.float32)
        flags = {
            "misses": rng.random((N_ENV, N_TRACK)) < 0.1,
            "moving": rng.random((N_ENV, N_TRACK)) < 0.95,
            "age": np.where(rng.random((N_ENV, N_TRACK)) < 0.01, 0, k + 1),
        }
        if k == 200:
            longer = paths.leg[:, ::2, 0] / paths.length[:, ::2, 0, None]
            paths.way[:, ::2, 1] += 1.5 * longer  # obstacles on lines now go on past the ends they had
            paths.measure()
        before = stage.read()
        stage.watch(state, cov, rate, rate_var, **flags)
        after = stage.read()
        for env in range(k % 2, N_ENV, 2):
            turns, slot = oracle_turns(before, env), int(before["next_slot"][env])
            for track in range(N_TRACK):
                leg_step = before["leg_step"][env, track]
                if flags["age"][env, track] == 0:
                    assert after["leg_step"][env, track] == -1
                    continue
                full = np.diag(cov[env, track][[0, 4, 7, 9]])
                x = state[env, track].astype(float)
                seen = flags["moving"][env, track] and not flags["misses"][env, track]
                if not (seen and oracle.is_straight(x, full, rate[env, track], rate_var[env, track])):
                    assert after["leg_step"][env, track] == leg_step
                    continue
                leg = before["leg"][env, track].astype(float) if leg_step >= 0 else None
                slot = oracle.learn(
                    turns, slot, leg, leg_step * RULES.control_dt_s, x, stage.step * RULES.control_dt_s,
                )  # fmt: skip
                np.testing.assert_array_equal(after["leg"][env, track], state[env, track])
                assert after["leg_step"][env, track] == stage.step
            assert after["next_slot"][env] == slot
            for s, turn in enumerate(turns):
                assert after["weight"][env, s] == turn.weight
                if turn.weight > 0:
                    got = [after[n][env, s] for n in ("turn_x", "turn_y", "in_x", "in_y", "out_x", "out_y")]
                    np.testing.assert_allclose(got, [*turn.pos, *turn.came, *turn.went], atol=TURN_TOLERANCE)
            learnt += slot != before["next_slot"][env]
            merged += (after["weight"][env] > np.maximum(before["weight"][env], 1)).sum()
            dropped += (after["weight"][env] < before["weight"][env]).sum()
    assert learnt > 10, learnt
    assert merged > 10, merged
    assert dropped > 2, dropped


def one_obstacle(state):
    """The same obstacle in the first slot of every env, nothing in the others."""
    out = np.zeros((N_ENV, N_TRACK, 4))
    out[:, 0] = state
    alive = np.zeros((N_ENV, N_TRACK))
    alive[:, 0] = 1
    return out, alive


def shuttle(t, speed=1.2, length=3.0, begin=(5.0, 2.0), course=0.6):
    """Back and forth on a line: (x, y, vx, vy)."""
    s = (speed * t) % (2 * length)
    u = np.array([np.cos(course), np.sin(course)])
    along, way = (s, speed) if s < length else (2 * length - s, -speed)
    return np.append(np.array(begin) + along * u, way * u)


def test_both_ends_of_a_line_are_learnt_in_one_go_and_back(stage):
    """Seven scans at a reversal are unsettled; the ends come out within 2 cm, with their side."""
    stage.begin()
    for k in range(int(8.0 / PERIOD_S)):
        t = k * PERIOD_S
        fresh = min(t % 2.5, 9) < 7 * PERIOD_S and t > 1
        state, alive = one_obstacle(shuttle(t))
        stage.watch(state, alive=alive, rate_var=1.0 if fresh else 0.01)
    ends = np.array([5.0, 2.0]) + 3.0 * np.outer([0, 1], [np.cos(0.6), np.sin(0.6)])
    for env in range(N_ENV):
        turns = stage.turns(env)
        assert len(turns) == 2
        turns = turns[np.argsort(turns[:, 0])]
        np.testing.assert_allclose(turns[:, :2], ends, atol=0.02)
        u = np.array([np.cos(0.6), np.sin(0.6)])
        np.testing.assert_allclose(turns[:, 2:6], [[*-u, *u], [*u, *-u]], atol=1e-3)


def test_circles_leave_no_turns(stage):
    """On a circle no leg is straight once its turn rate stands out; before, legs bend too little."""
    stage.begin()
    for k in range(120):
        a = 0.8 * k * PERIOD_S
        state, alive = one_obstacle([10 + np.cos(a), 3 + np.sin(a), -0.8 * np.sin(a), 0.8 * np.cos(a)])
        stage.watch(state, alive=alive, rate=0.8 if k > 8 else 0.1, rate_var=0.02 if k > 8 else 0.1)
    assert (stage.read()["weight"] == 0).all()


def test_a_turn_that_does_not_come_is_forgotten(stage):
    """Learnt once, contradicted by another obstacle that goes straight on over the same place."""
    stage.begin()
    for k in range(int(4.0 / PERIOD_S)):
        state, alive = one_obstacle(shuttle(k * PERIOD_S))
        stage.watch(state, alive=alive)
    assert all(len(stage.turns(env)) == 1 for env in range(N_ENV))
    alive = np.zeros((N_ENV, N_TRACK))
    alive[:, 3] = 1
    other = np.zeros((N_ENV, N_TRACK, 4))
    for k in range(int(5.0 / PERIOD_S)):
        other[:, 3] = shuttle(k * PERIOD_S, length=9.0)
        stage.watch(other, alive=alive)
    assert all(len(stage.turns(env)) == 0 for env in range(N_ENV))


def test_the_oldest_turn_goes_when_memory_is_full(stage):
    stage.begin()
    for j in range(CONFIG.n_turn + 3):
        for k in range(int(2.5 / PERIOD_S)):
            t = k * PERIOD_S
            state, alive = one_obstacle(shuttle(t, length=1.5, begin=(1 + 0.9 * j, 1.0), course=0.5 * np.pi))
            stage.watch(state, alive=alive, age=k)
    table = stage.read()
    assert (table["weight"] > 0).all()
    assert table["turn_x"].min() > 1 + 0.9 * 2.5
    assert (table["next_slot"] == 3).all()


def test_only_awake_rows_learn_and_forget(stage):
    stage.begin()
    active = np.arange(N_ENV) % 2
    stage.clock.active.from_numpy(active.astype(np.int32))
    for k in range(int(4.0 / PERIOD_S)):
        state, alive = one_obstacle(shuttle(k * PERIOD_S))
        stage.watch(state, alive=alive)
    assert [len(stage.turns(env)) for env in range(N_ENV)] == list(active)
    stage.clock.active.from_numpy((1 - active).astype(np.int32))
    prediction.reset_forecast(stage.io(TrackingIO))
    assert [len(stage.turns(env)) for env in range(N_ENV)] == list(active)
    stage.clock.active.fill(1)
    prediction.reset_forecast(stage.io(TrackingIO))
    assert (stage.read()["leg_step"] == -1).all()
    for name, value in stage.read().items():
        assert name == "leg_step" or (value == 0).all(), f"{name} keeps a trace of the last episode"


@pytest.mark.parametrize("shape", ["rectangle", "circle"])
def test_coasting_equals_the_oracle(stage, shape):
    """Unseen obstacles near turns and walls: a step of 0.06 s or 0.5 s ends where the oracle's walk ends."""
    stage.begin()
    tank = TankConfig(shape=shape, y_m=(0.0, 6.0) if shape == "rectangle" else (0.0, 20.0))
    rng = np.random.default_rng(2)
    n = 200
    mean, out, time = ti.Vector.field(4, ti.f32, n), ti.Vector.field(4, ti.f32, n), ti.field(ti.f32, n)
    seconds = rng.choice([0.06, 0.5], n).astype(np.float32)

    @ti.kernel
    def coast(io: Bundle[TrackingIO]):
        for i in range(n):
            out[i] = prediction.coasted(i % N_ENV, 0, mean[i], time[i], io)

    course, speed = rng.uniform(-np.pi, np.pi, n), rng.uniform(0.2, 3, n)
    high = [19, 5] if shape == "rectangle" else [15, 15]
    low = [1, 1] if shape == "rectangle" else [5, 5]
    pos = rng.uniform(low, high, (n, 2))
    rows = {name: np.zeros((N_ENV, CONFIG.n_turn)) for name in oracle.TURN_ROWS}
    for i in range(0, 90):  # a turn just ahead of every other obstacle, or at its side, or behind
        env, slot = i % N_ENV, i // N_ENV
        angle, after = course[i] + rng.normal(0, 0.2), rng.uniform(-np.pi, np.pi)
        place = (
            pos[i] + rng.normal(0.3, 0.3) * np.array([np.cos(angle), np.sin(angle)]) + rng.normal(0, 0.1, 2)
        )
        values = *place, np.cos(angle), np.sin(angle), np.cos(after), np.sin(after), rng.choice([-1, 1, 1, 4])
        for name, value in zip(rows, values, strict=True):
            rows[name][env, slot] = value
    stage.turn_history.turn.from_numpy(oracle.packed_turns(rows))
    x = np.concatenate([pos, speed[:, None] * np.stack([np.cos(course), np.sin(course)], -1)], -1).astype(
        np.float32
    )
    near = slice(90, 130)
    x[near, 0] = rng.uniform(0.4, 0.9, 40) + (0 if shape == "rectangle" else 0.5)
    x[near, 1] = 3.0 if shape == "rectangle" else 10.0
    mean.from_numpy(x)
    time.from_numpy(seconds)
    put(stage.tracks, radius_m=0.25)
    coast(stage.io(TrackingIO, CONFIG, tank))
    got, table, turned = out.to_numpy(), stage.read(), 0
    for i in range(n):
        turns = oracle_turns(table, i % N_ENV)
        where, last = oracle.walk(turns, x[i].astype(float), 0.25, [float(seconds[i])], CONFIG, tank, 1)
        np.testing.assert_allclose(got[i, :2], where[0], atol=TURN_TOLERANCE)
        np.testing.assert_allclose(
            got[i, 2:], last * np.hypot(*x[i, 2:].astype(float)), atol=10 * TURN_TOLERANCE
        )
        turned += last @ oracle.unit(x[i, 2:]) < 0.9
    assert turned > 20, turned


def test_a_way_remembers_what_kind_of_turn_began_it(stage):
    """To and fro, or round corners: 2 = began with a turn back, 3 = a corner."""
    for corners, kind in ((2, prediction.BEGIN_SEEN), (3, prediction.CORNER_SEEN)):
        stage.begin()
        paths = Loops(np.random.default_rng(4), corners, 1.5)
        if corners == 3:  # no corner leads back or straight on
            paths.way[:] = [(5.0, 1.5), (12.0, 2.0), (8.0, 5.0)]
            paths.measure()
        for k in range(160):
            stage.watch(paths.at(k * PERIOD_S))
        begun = stage.read()["run_kind"]
        assert (begun[begun > 1] == kind).all() and (begun > 1).mean() > 0.8
