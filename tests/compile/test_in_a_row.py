"""Launches in a row do what they do one by one, and are looked at anew where anything is another."""

import sys
import threading

import numpy as np
import pytest
import torch

from tests.conftest import configure, launch_one_by_one
from uuvtai.compile.launch import NativeLaunch, Rows, noted
from uuvtai.kernels.planning import observation as features

STEPS = 40
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="own machine code is for Linux")


@pytest.fixture
def small(small, monkeypatch):
    """With rows that no other test has made."""
    monkeypatch.setattr(small.sim, "_rows", Rows())
    return small


def driven(small, each=lambda step: None):
    """Every byte that a run leaves, resets in between."""
    small.forget()
    small.sim.observe()
    small.begin(range(small.N), seed=31)
    shown = []
    for step in range(STEPS):
        each(step)
        if step % 15 == 9:
            small.begin([50, 51], seed=31, rows=[1, 6])
        small.sim.step()
        shown.append((small.sim.observation.clone(), small.sim.action.clone(), small.sim.reward.clone()))
    memory = small.sim.memory()
    return shown, {name: view.copy() for name, view in memory.views(memory.read()).items()}


def assert_same(one, other):
    for seen, wanted in zip(one[0], other[0], strict=True):
        assert all(torch.equal(a, b) for a, b in zip(seen, wanted, strict=True))
    for name, values in one[1].items():
        assert values.tobytes() == other[1][name].tobytes(), name


def rows_of(sim):
    return {name: row._count for name, row in sim._rows._known.items()}


def test_every_bit_is_as_one_by_one(small, monkeypatch):
    in_a_row = driven(small)
    names = {"_begin_anew", "_look", "_act_and_wake", "_move", "_act"}
    assert rows_of(small.sim).keys() == names and sum(rows_of(small.sim).values()) > 20
    assert np.ptp([float(action.sum()) for _, action, _ in in_a_row[0]]) > 0.1, "there is something to do"
    launch_one_by_one(monkeypatch, small.sim)
    assert_same(in_a_row, driven(small))


class Straight:
    """A planner of somebody's own."""

    def plan(self, asked):
        return np.array([asked.start, asked.goal])

    def reset(self, mask):
        pass


def changed(small, patch, change):
    sim, config = small.sim, small.sim.config
    if change == "tree":
        sim.use_tree(small.trees["straight"])
    elif change == "privileged":
        patch.setattr(sim, "privileged", True)
    elif change == "planner":
        patch.setattr(sim, "planner", Straight())
    elif change == "observation":
        width = features.observation_width(config.observation)
        patch.setattr(sim, "observation", torch.full((small.N, width), 7.0))
    else:
        camera = config.height.model_copy(update={"use_camera": not config.height.use_camera})
        configure(patch, sim, config.model_copy(update={"height": camera}))


@pytest.mark.parametrize("change", ["tree", "privileged", "planner", "observation", "config"])
def test_what_is_changed_between_two_steps_counts_from_the_next_one_on(small, monkeypatch, change):
    def run():
        with monkeypatch.context() as patch:
            patch.setattr(small.sim, "observation", None)  # that of before comes back
            return driven(small, lambda step: step == STEPS // 2 and changed(small, patch, change))

    undisturbed = driven(small)
    in_a_row = run()
    small.sim.use_tree(small.trees["bt"])
    launch_one_by_one(monkeypatch, small.sim)
    assert_same(in_a_row, run())
    if change != "observation":
        kept = undisturbed[1].items()
        assert any(in_a_row[1][name].tobytes() != values.tobytes() for name, values in kept), (
            "nothing of it is seen"
        )


def test_only_what_was_made_by_machine_code_becomes_a_row(small):
    """A kernel that Taichi launches, or one that is seen for the first time, would be left out."""
    rows, sim = Rows(), small.sim
    small.begin(range(small.N))

    def nothing():
        """Launches no kernel."""

    rows.play(nothing, ())
    assert not rows._known
    rows.play(sim._act, ("what decides",))
    assert rows_of(small.sim).keys() >= {"_act_and_wake"} and rows._known["_act"]._on == ("what decides",)


def test_no_kernel_of_theirs_is_left_out(small, monkeypatch):
    """One without ``quick_launch`` would not be noted."""
    launched, sim = [], small.sim
    small.begin(range(small.N))
    sim.observe()
    sim.step()

    def told(kernel):
        def tell(*arguments):
            launched.append(kernel.__name__)
            kernel(*arguments)

        return tell

    for module in [module for name, module in sys.modules.items() if name.startswith("uuvtai.kernels.")]:
        for name, kernel in list(vars(module).items()):
            if hasattr(kernel, "_primal"):
                monkeypatch.setattr(module, name, told(kernel))
    for privileged in (False, True):
        monkeypatch.setattr(sim, "privileged", privileged)
        for work in (sim._move, sim._look, sim._act):
            launched.clear()
            assert len(noted(work)) == len(launched) > 3, work.__name__


def test_tensors_may_lie_elsewhere_the_next_time(small):
    """Torch may give a tensor new memory under its old name."""
    sim = small.sim
    observation = sim.observe()
    small.begin(range(small.N))
    for _ in range(3):
        sim.step()
    before = observation.data_ptr()
    observation.set_(torch.full_like(observation, -5.0))
    assert observation.data_ptr() != before and sim._rows._known["_act"]
    sim.step()
    assert (observation != -5.0).any(dim=1).all()


def test_another_threads_launches_are_not_noted(small):
    small.begin(range(small.N))
    small.sim.step()

    def beside():
        thread = threading.Thread(target=small.sim._act)
        thread.start()
        thread.join()

    assert noted(beside) == []
    assert all(isinstance(launch, NativeLaunch) for launch in noted(small.sim._act))


def test_timed_stages_are_not_launched_in_a_row(small, monkeypatch):
    monkeypatch.setattr(small.sim, "stage_s", {})
    small.begin(range(small.N))
    small.sim.step()
    assert small.sim.stage_s.keys() >= {"dynamics", "tracking", "behavior"} and not rows_of(small.sim)
