"""What is told of the time: no compiling, no recording, and no guess before it is worth one."""

import numpy as np
import pytest

from tests import report_samples as samples
from uuvtai.compile.taichi_frontend import kernels_made
from uuvtai.console import screen as module
from uuvtai.console.screen import Pace, Progress, time_left, training_rows
from uuvtai.evaluation.episodes import StepClock, env_steps_left, jobs_of, run_episodes


class Time:
    """A clock that stands still until it is moved."""

    def __init__(self):
        self.s, self.kernels = 0.0, 0

    def __call__(self):
        return self.s


def test_the_first_pass_and_every_pass_that_compiles_are_no_working_time():
    time = Time()
    clock = StepClock(time, lambda: time.kernels)

    def passes(kind, seconds, steps, kernels=0):
        with clock.counting(kind, steps):
            time.s += seconds
            time.kernels += kernels

    passes("reset", 30.0, 0, 200)
    passes("step", 20.0, 64, 50)
    assert clock.env_steps_per_s is None
    passes("step", 1.0, 64)
    time.s += 100.0  # somebody records, draws or prints
    passes("step", 9.0, 64, 1)
    passes("reset", 1.0, 0)
    assert (clock.seconds, clock.env_steps, clock.env_steps_per_s) == (2.0, 64, 32.0)


def test_steps_of_real_episodes_are_counted_without_what_watches_them(small):
    """Equal results with and without a clock; a recorder that dawdles does not slow the steps down."""
    time = Time()
    clock = StepClock(time)
    small.sim.use_tree(small.trees["straight"])

    class Dawdler:
        def begin(self, *_):
            time.s += 10.0

        def step(self, _sim):
            time.s += 10.0

        def end(self, *_):
            time.s += 10.0

    answer = []
    jobs = jobs_of([77], 10)
    watched, steps = run_episodes(small.sim, jobs, Dawdler(), lambda *a: answer.append(a), clock=clock)
    plain, again = run_episodes(small.sim, jobs)
    small.sim.use_tree(small.trees["bt"])
    assert steps == again
    assert [(r.outcome, r.time_s) for r in watched] == [(r.outcome, r.time_s) for r in plain]
    assert clock.seconds == 0.0 and 0 < clock.env_steps < steps
    assert answer[0] == (0, 10, 0, None) and answer[1][0] == 0 and answer[1][2] == small.N
    assert answer[-1][0] == 10 and answer[-1][3] == 0
    assert all(
        0 <= left <= 10 * small.config.episode.horizon_steps for *_, left in answer if left is not None
    )


def test_steps_that_are_left_are_guessed_from_episodes_that_are_over():
    assert env_steps_left([], [10] * 5, 3) is None
    assert env_steps_left([100], [10] * 20, 0) is None, "one of 21 says too little"
    assert env_steps_left([100] * 4, [60] * 2, 10) == 100 * 10 + 2 * 40
    assert env_steps_left([100] * 4, [400], 0) == 25, "a straggler may end at any time"
    assert env_steps_left([100] * 4, [], 0) == 0


def test_no_time_left_is_told_before_it_is_worth_one():
    time = Time()
    pace = Pace(100, 0, time)
    time.s = 5.0
    assert pace.left_s(9) is None
    assert pace.left_s(10) == pytest.approx(45.0)
    time.s = 20.0
    assert pace.left_s(0) is None and pace.left_s(1) == pytest.approx(1980.0)
    resumed = Pace(100, 90, time)
    time.s += 4.0
    assert resumed.left_s(92) == pytest.approx(16.0), "what was done before took none of this time"
    assert time_left(None) == "" and time_left(34.2) == "ETA 34 s" and time_left(600.0) == "ETA 10 min"


@pytest.fixture
def lines(monkeypatch):
    """Every line that progress would print without a terminal, and the clock."""
    time, found = Time(), []
    monkeypatch.setattr(module.time, "perf_counter", time)
    monkeypatch.setattr(module, "_PERIOD_S", 0.0)
    monkeypatch.setattr(module, "say", found.append)
    monkeypatch.setattr(module, "Pace", lambda total, done=0.0: Pace(total, done, time))
    return time, found


def test_compiling_is_a_phase_outside_the_eta(lines):
    time, found = lines
    shown = Progress()
    shown.start("bt", 64)
    shown.update(0, 64, 0, None)
    assert found == ["bt: 0/64 episodes, compiling"]
    time.s = 60.0
    shown.update(0, 64, 64, None)
    assert found[-1] == "bt: 0/64 episodes"
    time.s = 62.0
    shown.update(3, 64, 64 + 2000, None)
    assert found[-1] == "bt: 3/64 episodes, 1,000 env-steps/s"
    time.s = 70.0
    shown.update(32, 64, 64 + 10_000, 5_000)
    assert found[-1] == "bt: 32/64 episodes, 1,000 env-steps/s, ETA 5 s"


def test_things_that_are_counted_need_no_steps(lines):
    time, found = lines
    shown = Progress("frames")
    shown.start("my.mp4", 100)
    time.s = 1.0
    shown.update(5, 100)
    time.s = 2.0
    shown.update(20, 100)
    assert found == ["my.mp4: 5/100 frames", "my.mp4: 20/100 frames, ETA 8 s"]


def test_a_sweep_that_goes_on_counts_its_own_cells_only(lines):
    time, found = lines
    shown = Progress("cells")
    shown.start("10 cells", 10, 8)
    time.s = 30.0
    shown.update(9, 10, 0)
    assert found == ["10 cells: 9/10 cells, ETA 30 s"]


def test_the_first_iteration_of_a_training_has_no_speed():
    metrics = samples.metrics(1)[0]
    assert training_rows(metrics, None, None, True)["env-steps"] == "1,000"
    rows = training_rows(
        metrics | {"time/decisions": 200, "time/decisions_per_s": 180}, (0.1, 0.3), 150.0, False
    )
    assert rows["decisions"].startswith("200, 180/s (simulate") and rows["ETA"] == "2 min"
    assert "[10, 30]" in rows["success"]
    assert "ETA" not in training_rows(metrics, None, None, False)


def test_made_kernels_are_counted():
    import taichi as ti

    @ti.kernel
    def fill(x: ti.types.ndarray(dtype=ti.f32, ndim=1), value: ti.f32):  # pyright: ignore
        for i in x:
            x[i] = value

    x = np.zeros(4, np.float32)
    before = kernels_made()
    fill(x, 1.0)
    assert kernels_made() == before + 1
    fill(x, 2.0)
    assert kernels_made() == before + 1 and x.tolist() == [2.0] * 4
