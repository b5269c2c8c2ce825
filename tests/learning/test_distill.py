"""Distillation, its schedule and its scale by hand-computed numbers; what is not finite is skipped."""

import math

import pytest
import torch
from torch import nn

from uuvtai.config.learning import DistillationConfig, LearningConfig, UncertaintyConfig
from uuvtai.learning import distillation
from uuvtai.learning.distillation import Distillation, Uncertainty, piecewise_linear
from uuvtai.learning.rollout import Rollout

FLOAT32 = 1e-6
"""a handful of float32 operations on numbers near one"""


class LinearPolicy(nn.Module):
    """Four actions linear in two inputs, and a critic that distillation must not touch."""

    inputs = ("x",)

    def __init__(self):
        super().__init__()
        self.actor, self.critic, self.log_std = nn.Linear(2, 4), nn.Linear(2, 1), torch.zeros(4)
        for layer in (self.actor, self.critic):
            nn.init.constant_(layer.weight, 0.1)
            nn.init.zeros_(layer.bias)

    def prepared(self, view):
        return view

    def mean_of(self, view):
        return self.actor(view["x"])


def rollout_of(x, behavior, reward):
    rollout = Rollout(1)
    leaf = torch.zeros(len(x), dtype=torch.int32)
    row = {"x": x, "teacher_action": behavior, "reward": reward, "mean": behavior, "leaf": leaf}
    rollout.note(0, row)
    return rollout


def distillation_of(policy, **config):
    return Distillation(policy, LearningConfig(distillation=DistillationConfig(**config)), ("Root",))


@pytest.fixture
def lesson():
    generator = torch.Generator().manual_seed(3)
    x = torch.randn(500, 2, generator=generator)
    return x, x @ torch.tensor([[0.5, -0.5, 0.2, 0.0], [0.1, 0.3, -0.4, 0.6]]), torch.ones(500), generator


def test_the_error_is_the_squared_norm_over_the_four_actions():
    mean = torch.tensor([[1.0, 2.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.5]])
    behavior = torch.tensor([[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, -0.5]])
    assert distillation.imitation_error(mean, behavior).tolist() == [5.0, 1.0]


def test_teacher_batches_teach_the_mean_and_leave_the_critic(lesson):
    x, behavior, weight, generator = lesson
    policy = LinearPolicy()
    critic = policy.critic.weight.clone()
    policy.critic(x).sum().backward()  # a gradient that PPO left behind
    batches = distillation_of(policy, batch=64, steps=300, learning_rate=1e-2)
    before = distillation.imitation_error(policy.actor(x), behavior).mean()
    batches.update(rollout_of(x, behavior, weight), 1.0, generator)
    after = distillation.imitation_error(policy.actor(x), behavior).mean()
    assert after < 0.01 * before
    assert torch.equal(policy.critic.weight, critic)


def test_strength_scales_the_step_and_zero_draws_nothing(lesson):
    x, behavior, weight, generator = lesson

    def moved(strength):
        policy = LinearPolicy()
        distillation_of(policy, batch=64, steps=1).update(
            rollout_of(x, behavior, weight), strength, torch.Generator().manual_seed(0)
        )
        return (policy.actor.weight - 0.1).detach()

    # the weight is kept near 0.1: a step of 3e-5 is known to one part in a thousand
    assert torch.allclose(moved(0.2), 0.2 * moved(1.0), rtol=1e-2, atol=1e-9)
    state = generator.get_state()
    policy = LinearPolicy()
    distillation_of(policy).update(rollout_of(x, behavior, weight), 0.0, generator)
    assert torch.equal(generator.get_state(), state)
    assert torch.equal(policy.actor.weight, torch.full((4, 2), 0.1))


def test_a_batch_that_is_not_finite_changes_nothing_and_is_counted(lesson):
    x, _teacher, weight, generator = lesson
    policy = LinearPolicy()
    batches = distillation_of(policy, batch=64, steps=2)
    batches.update(rollout_of(x, torch.full((500, 4), math.nan), weight), 1.0, generator)
    assert batches.skipped == 2
    assert torch.equal(policy.actor.weight, torch.full((4, 2), 0.1))


def test_teacher_batches_go_on_from_their_state(lesson):
    x, behavior, weight, _generator = lesson

    def run(parts):
        policy, generator = LinearPolicy(), torch.Generator().manual_seed(7)
        state = None
        for _ in range(parts):
            batches = distillation_of(policy, batch=32, steps=4 // parts)
            if state is not None:
                batches.load_state_dict(state)
            batches.update(rollout_of(x, behavior, weight), 0.7, generator)
            state = batches.state_dict()
        return policy.actor.weight

    assert torch.equal(run(1), run(2))


def test_errors_by_leaf():
    error = torch.tensor([1.0, 2.0, 3.0, 6.0, 4.0, math.nan])
    leaf = torch.tensor([1, 2, 3, -1, 2, 2], dtype=torch.int32)
    names = ("Root", "Evade", "Follow", "Evade")
    assert distillation.leaf_errors(names, error, leaf) == {
        "distillation/leaf/Evade": 2.0,
        "distillation/leaf/Follow": 3.0,
        "distillation/loss": 16.0 / 5,
    }
    assert distillation.leaf_errors(names, error[:0], leaf[:0]) == {}


@pytest.mark.parametrize(
    ("fraction", "value"),
    [(-1.0, 2.0), (0.0, 2.0), (0.25, 3.0), (0.5, 4.0), (0.75, 3.0), (1.0, 2.0), (5.0, 2.0)],
)
def test_linear_in_between_constant_outside(fraction, value):
    assert piecewise_linear([(0.0, 2.0), (0.5, 4.0), (1.0, 2.0)], fraction) == value


def test_two_points_at_one_place_are_a_jump_to_the_later_value():
    points = [(0.0, 1.0), (0.5, 1.0), (0.5, 0.2), (1.0, 0.2)]
    assert [piecewise_linear(points, f) for f in (0.0, 0.499999, 0.5, 0.7, 1.0)] == [1.0, 1.0, 0.2, 0.2, 0.2]
    assert piecewise_linear([(0.0, 1.0), (0.0, 3.0)], 0.0) == 3.0


def test_one_point_is_a_constant():
    assert [piecewise_linear([(0.3, 0.2)], f) for f in (0.0, 0.3, 1.0)] == [0.2] * 3


@pytest.mark.parametrize(
    ("iteration", "value"), [(0, 1.0), (799, 1.0), (800, 0.2), (1200, 0.1), (1600, 0.0), (1700, 0.0)]
)
def test_the_paper_s_schedule(iteration, value):
    """lambda_t: 1 until 800, then 0.2 down to 0 at 1600, which a run of 1200 iterations never reaches."""
    assert piecewise_linear(DistillationConfig().schedule, iteration / 1200) == pytest.approx(
        value, abs=1e-12
    )


def after(config, *batches):
    uncertainty = Uncertainty(config)
    for batch in batches:
        uncertainty.update(torch.tensor(batch))
    return uncertainty


def test_mean_follows_the_papers_recursion_from_the_first_value_on():
    config = UncertaintyConfig(ema=0.25)
    assert float(after(config, [0.2, 0.6]).mean) == pytest.approx(0.4)
    assert float(after(config, [0.2, 0.6], [0.8]).mean) == pytest.approx(0.75 * 0.4 + 0.25 * 0.8)


@pytest.mark.parametrize(("sigma", "scale"), [(0.0, 1.0), (0.5, 1.4), (1.25, 2.0), (40.0, 2.0)])
def test_scale_is_one_plus_gain_times_mean_and_capped(sigma, scale):
    assert after(UncertaintyConfig(gain=0.8, max_scale=2.0), [sigma]).scale == pytest.approx(scale)


def test_no_gain_and_no_batch_leave_the_distillation_alone():
    assert after(UncertaintyConfig(gain=0.0), [3.0]).scale == 1.0
    assert after(UncertaintyConfig()).scale == 1.0


def test_values_that_are_not_finite_do_not_enter():
    assert float(after(UncertaintyConfig(), [0.5, math.nan, math.inf]).mean) == 0.5
    assert float(after(UncertaintyConfig(), [0.5], [math.nan]).mean) == 0.5


def test_state_is_complete():
    config = UncertaintyConfig(ema=0.25)
    first = after(config, [0.3])
    second = Uncertainty(config)
    second.load_state_dict(first.state_dict())
    for uncertainty in (first, second):
        uncertainty.update(torch.tensor([0.9]))
    assert torch.equal(first.mean, second.mean)
