"""The reward: every term against the equation, its sums, its ends, and progress that no replan can fake."""

import numpy as np
import pytest
import torch

from tests.bundles import Stage, put
from tests.oracles import reward as reference
from uuvtai.config import EpisodeConfig, RewardConfig, VehicleConfig
from uuvtai.kernels.task import reward
from uuvtai.kernels.task.episode import OUTCOMES
from uuvtai.kernels.task.io import RewardIO

N = 64
TOL = 2e-5
"""float32; acos near upright amplifies rounding to sqrt(eps)"""
CFG = RewardConfig(overspeed=0.3, tilt=0.04)
VEHICLE, RULES = VehicleConfig(), EpisodeConfig()


class Bench(Stage):
    sizes = {"n_env": N, "n_term": reward.N_TERM}
    other = 2

    def __init__(self):
        super().__init__()
        self.out = torch.zeros(N), torch.zeros(N, dtype=torch.int32), torch.zeros(N, dtype=torch.int32)
        self.target = {
            "quat": (self.vehicle, "quat_wb"), "vel": (self.vehicle, "vel_b"), "pos": (self.vehicle, "pos_w"),
            "command": (self.actuation, "command"), "lookahead": (self.route, "lookahead_w"),
            "cross_track": (self.route, "cross_track_m"), "heading_error": (self.route, "heading_error"),
            "clearance": (self.termination, "clearance_m"), "ttc": (self.termination, "ttc_s"),
            "n_way": (self.route, "n_way"), "outcome": (self.termination, "outcome"),
            "remaining": (self.route, "remaining_m"), "plan_step": (self.route, "plan_step"),
            "step": (self.clock, "step"),
        }  # fmt: skip

    def begin(self):
        """Every row upright at 10 m, driving ahead at 0.5 m/s on a route of old, one step in."""
        self.clock.active.fill(1)
        reward.reset_reward(self.io(RewardIO))
        rest = {
            "quat": (1, 0, 0, 0), "vel": (0.5, 0, 0), "pos": (10, 3, -0.8), "command": (0.5, 0, 0, 0),
            "lookahead": (11, 3, -0.8), "cross_track": 0, "heading_error": 0, "clearance": 5, "ttc": 1e6,
            "n_way": 4, "outcome": 0, "remaining": 5, "plan_step": 0, "step": 1,
        }  # fmt: skip
        for name, value in rest.items():
            self.set(name, value)
        return self

    def set(self, name, values):
        struct, field = self.target[name]
        put(struct, **{field: values})

    def compute(self):
        reward.compute_reward(self.io(RewardIO, CFG, VEHICLE, RULES), *self.out)
        return dict(zip(reward.TERMS, self.reward.term.to_numpy().T.astype(float), strict=True))


bench = Bench.begun()


def test_terms_are_config_keys_of_the_equation():
    """The paper's come first, others are off by default; other keys are bounds, with a unit."""
    papers = [name for name in reward.TERMS if name in reference.TERMS]
    assert reward.TERMS[:13] == tuple(papers) == reference.TERMS
    assert all(getattr(RewardConfig(), name) == 0 for name in reward.TERMS[13:])
    assert set(reward.TERMS) <= set(RewardConfig.model_fields)
    for name in set(RewardConfig.model_fields) - set(reward.TERMS):
        assert name.endswith(("_m", "_s", "_m_s", "_rad", "_rad_s")), f"{name}: a weight without a term?"


def random_rows(seed):
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=(N, 4)) * [2, 0.3, 0.3, 1]
    return {
        "quat": quat / np.linalg.norm(quat, axis=1, keepdims=True),
        "vel": rng.uniform(-0.6, 0.6, (N, 3)),
        "pos": rng.uniform(0, 6, (N, 3)),
        "command": rng.uniform(-1, 1, (N, 4)) * [0.6, 0.6, 0.4, 1.0],
        "lookahead": rng.uniform(0, 6, (N, 3)),
        "cross_track": rng.uniform(-1, 1, N),
        "heading_error": rng.uniform(-np.pi, np.pi, N),
        "clearance": rng.uniform(-0.2, 0.8, N),
        "ttc": rng.uniform(0, 4, N),
        "n_way": rng.integers(0, 4, N),
        "outcome": rng.integers(0, len(OUTCOMES), N),
    }


def test_every_term_equals_the_equation(bench):
    rows = random_rows(0)
    for name, values in rows.items():
        bench.set(name, values)
    terms = bench.compute()
    for env in range(N):
        step = {name: values[env] for name, values in rows.items()}
        step["outcome"] = OUTCOMES[step["outcome"]]
        step["progress"] = terms["progress"][env] / CFG.progress  # has tests of its own
        expected = reference.terms(CFG, VEHICLE, step)
        for name in reference.TERMS:
            assert terms[name][env] == pytest.approx(expected[name], abs=TOL), (name, env)


def test_total_is_the_sum_and_goes_out(bench):
    total = sum(bench.compute().values())
    assert bench.out[0].numpy() == pytest.approx(total, abs=TOL)
    assert bench.reward.total.to_numpy() == pytest.approx(total, abs=TOL)
    bench.compute()
    # the second step earns other progress
    assert bench.reward.episode_return.to_numpy() == pytest.approx(2 * total, abs=0.02)
    assert bench.reward.episode_sum.to_numpy().sum(axis=1) == pytest.approx(
        bench.reward.episode_return.to_numpy(), abs=TOL
    )
    reward.reset_reward(bench.io(RewardIO))
    assert not bench.reward.episode_sum.to_numpy().any()
    assert not bench.reward.episode_return.to_numpy().any()


def test_ends_of_episodes(bench):
    bench.set("outcome", np.arange(N) % len(OUTCOMES))
    bench.compute()
    names = [OUTCOMES[i % len(OUTCOMES)] for i in range(N)]
    assert bench.out[1].tolist() == [
        int(name in ("success", "collision", "ttc", "out_of_tank")) for name in names
    ]
    assert bench.out[2].tolist() == [int(name == "timeout") for name in names]


def test_bytes_and_booleans_hold_the_ends_too(bench):
    bench.set("outcome", np.full(N, OUTCOMES.index("timeout")))
    for dtype in (torch.uint8, torch.bool):
        ends = torch.ones(N, dtype=dtype), torch.zeros(N, dtype=dtype)
        reward.compute_reward(bench.io(RewardIO, CFG, VEHICLE, RULES), bench.out[0], *ends)
        assert not ends[0].any()
        assert ends[1].all()


def test_sleeping_rows_earn_nothing_and_keep_their_end(bench):
    bench.set("outcome", np.full(N, OUTCOMES.index("success")))
    bench.compute()
    bench.clock.active.fill(0)
    before = bench.reward.episode_return.to_numpy()
    bench.compute()
    assert not bench.out[0].any()
    assert bench.out[1].all()
    assert np.array_equal(bench.reward.episode_return.to_numpy(), before)


# --------------------------------------------------------------------------------------------------- progress


def progress(bench, remaining, plan_step=0, step=2):
    bench.set("remaining", np.full(N, remaining))
    bench.set("plan_step", np.full(N, plan_step))
    bench.set("step", np.full(N, step))
    return bench.compute()["progress"][0] / CFG.progress


@pytest.mark.parametrize(("left", "paid"), [((4.992, 4.997), (0.008, -0.005)), ((3.0, 4.0), (0.01, -0.01))])
def test_progress_is_route_length_gained_and_no_jump_pays_more_than_the_movement(bench, left, paid):
    """At 0.5 m/s a step is 0.01 m."""
    progress(bench, 5.0)
    assert [progress(bench, remaining) for remaining in left] == pytest.approx(paid, abs=1e-6)


@pytest.mark.parametrize("jump", [-3.0, 3.0])
def test_a_replan_pays_movement_towards_the_new_route_whatever_its_length(bench, jump):
    progress(bench, 5.0)
    bench.set("lookahead", np.tile((10.6, 3.8, -0.2), (N, 1)))  # 53 degrees to the left
    assert progress(bench, 5.0 + jump, plan_step=2, step=2) == pytest.approx(0.01 * 0.6, abs=1e-6)
    # the step after compares lengths of the new route
    assert progress(bench, 5.0 + jump - 0.004, plan_step=2, step=3) == pytest.approx(0.004, abs=1e-6)


def test_replanning_in_every_step_while_standing_still_pays_nothing(bench):
    bench.set("vel", np.zeros((N, 3)))
    for step in range(1, 20):
        assert progress(bench, 5.0 + (-1) ** step, plan_step=step, step=step) == 0.0


def test_the_first_step_and_steps_without_a_route(bench):
    # nothing known before: movement towards the look-ahead
    assert progress(bench, 7.0, step=1) == pytest.approx(0.01, abs=1e-6)
    bench.set("n_way", np.zeros(N))
    assert progress(bench, 3.0) == 0.0
    bench.set("n_way", np.full(N, 4))
    assert progress(bench, 2.0) == pytest.approx(0.01, abs=1e-6)


def test_progress_sums_to_the_way_driven(bench):
    """Along a straight route with replans thrown in, the sum is the way driven."""
    total, x = 0.0, 0.0
    for step in range(1, 101):
        x += 0.01
        replanned = step % 8 == 0
        total += progress(
            bench,
            50.0 - x + (0.7 if step >= 8 else 0.0),
            plan_step=step if replanned else step - step % 8,
            step=step,
        )
    assert total == pytest.approx(x, abs=1e-3)  # float32 differences of 50 m: 4e-6 each
