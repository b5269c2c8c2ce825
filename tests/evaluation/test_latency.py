"""The paper's timing table on a simulator that is a list of times: what each row is a mean of."""

import pytest
import torch

from uuvtai.evaluation import profile
from uuvtai.evaluation.profile import SimBatch

PLANNING = [0.010, 0.0, 0.020, 0.0, 0.0, 0.030]
"""[s] of the planning stage, step after step; where it is not 0 a route is planned"""


class Sim:
    """One env: every step takes what the list says, and every eighth step ends an episode."""

    num_envs, device, every = 1, torch.device("cpu"), 8

    def __init__(self):
        self.stage_s, self.steps, self.planned, self.now = None, 0, 0, 0.0
        self.terminated = self.truncated = torch.zeros(1, dtype=torch.bool)
        self.s = type("State", (), {"route": type("Route", (), {"replans": None})})

    def step(self, _action=None):
        takes = PLANNING[self.steps % len(PLANNING)]
        self.steps += 1
        self.planned += takes > 0
        self.now += 0.001 + takes
        self.terminated = torch.tensor([self.steps % self.every == 0])
        if self.stage_s is not None:
            self.stage_s = {"planning": takes, "mapping": 0.0006, "clearance": 0.0004}

    def reset(self, _rows, _seeds, _numbers):
        self.planned = 0
        self.now += 5.0  # drawing a scenario takes long

    def rows(self, _array, rows):
        return torch.tensor([[self.planned, 0]]) if rows == [0] else torch.zeros(1)


@pytest.fixture
def samples(monkeypatch):
    sim = Sim()
    monkeypatch.setattr(profile.time, "perf_counter", lambda: sim.now)

    def network():
        sim.now += 0.1

    return profile._loop_samples(SimBatch(sim), 60.0, [network, network])


def test_the_planner_is_the_mean_over_steps_that_plan(samples):
    every = samples[profile.EVERY_STEP]
    assert samples["Global planner"] == [value for value in every if value > 0] and 0.0 in every
    assert set(samples["Global planner"]) <= {10.0, 20.0, 30.0}
    assert samples["Mapping update"] == pytest.approx([1.0] * len(every)), "mapping and clearance together"


def test_the_full_loop_holds_the_networks_and_no_new_scenario(samples):
    bare, full = samples[profile.NO_NETWORKS], samples["Full loop"]
    assert [b - a for a, b in zip(bare, full, strict=True)] == pytest.approx([200.0] * len(bare)), (
        "two networks of 100 ms"
    )
    assert max(bare) < 100.0, "a step that draws the next episode's scenario takes 5 s"


def test_stages_are_timed_for_longer_where_few_routes_were_planned(monkeypatch):
    sim = Sim()
    sim.every = 1_000_000
    monkeypatch.setattr(profile.time, "perf_counter", lambda: sim.now)
    found = profile._loop_samples(SimBatch(sim), 0.1, [])
    assert len(found[profile.EVERY_STEP]) > len(found["Full loop"]) + 2 and len(found["Global planner"]) > 0


def test_a_row_without_samples_has_no_mean():
    row = profile._latency_row("Global planner", [])
    assert row["mean_ms"] is None and row["paper_mean_ms"] == 5.22
    assert profile._latency_row(profile.NO_NETWORKS, [2.0, 4.0])["mean_ms"] == 3.0
    assert profile._latency_row(profile.NO_NETWORKS, [2.0])["paper_mean_ms"] is None
