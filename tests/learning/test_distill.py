"""Distillation by hand-computed numbers; batches teach by their strength and skip what is not finite."""

import math

import pytest
import torch
from torch import nn

from uuvtai.config.learning import DistillationConfig
from uuvtai.learning import distillation

FLOAT32 = 1e-6
"""a handful of float32 operations on numbers near one"""


class LinearPolicy(nn.Module):
    """Four actions linear in two inputs, and a critic that distillation must not touch."""

    def __init__(self):
        super().__init__()
        self.actor, self.critic = nn.Linear(2, 4), nn.Linear(2, 1)
        for layer in (self.actor, self.critic):
            nn.init.constant_(layer.weight, 0.1)
            nn.init.zeros_(layer.bias)

    def distribution(self, x):
        return self.actor(x), torch.zeros(4)


@pytest.fixture
def lesson():
    generator = torch.Generator().manual_seed(3)
    x = torch.randn(500, 2, generator=generator)
    return x, x @ torch.tensor([[0.5, -0.5, 0.2, 0.0], [0.1, 0.3, -0.4, 0.6]]), torch.ones(500), generator


def test_the_error_is_the_squared_norm_over_the_four_actions():
    mean = torch.tensor([[1.0, 2.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.5]])
    behavior = torch.tensor([[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, -0.5]])
    assert distillation.imitation_error(mean, behavior).tolist() == [5.0, 1.0]
    assert float(distillation.distillation_loss(mean, behavior, torch.tensor([0.5, 1.5]))) == pytest.approx(
        (0.5 * 5 + 1.5 * 1) / 2
    )


def test_weights_have_mean_one_and_bounds():
    signal = torch.tensor([1.0, 2.0, 3.0])
    assert torch.allclose(distillation.sample_weight(signal), torch.tensor([0.5, 1.0, 1.5]), atol=FLOAT32)
    weight = distillation.sample_weight(torch.cat([torch.full((999,), 1e-3), torch.tensor([1e9])]))
    assert float(weight.mean()) == pytest.approx(1.0, abs=1e-5)
    assert float(weight.max() / weight.min()) == pytest.approx(distillation.MAX_WEIGHT_RATIO**2)


def test_weights_survive_zeros_and_what_is_not_finite():
    assert distillation.sample_weight(torch.zeros(4)).tolist() == [1.0] * 4
    weight = distillation.sample_weight(torch.tensor([1.0, math.nan, 3.0, math.inf]))
    assert torch.isfinite(weight).all()
    assert weight[1] == weight[3] and weight[0] < weight[1] < weight[2]


def test_weighting_by_name():
    uncertainty = torch.tensor([1.0, 3.0])
    assert distillation.weights_of("none", uncertainty).tolist() == [1.0, 1.0]
    assert distillation.weights_of("uncertainty", uncertainty).tolist() == [0.5, 1.5]


def test_a_weighting_needs_its_signal():
    distillation.check_weighting("none", False)
    distillation.check_weighting("uncertainty", True)
    with pytest.raises(ValueError, match=r"world_model\.enabled=true"):
        distillation.check_weighting("uncertainty", False)


def test_teacher_batches_teach_the_mean_and_leave_the_critic(lesson):
    x, behavior, weight, generator = lesson
    policy = LinearPolicy()
    critic = policy.critic.weight.clone()
    policy.critic(x).sum().backward()  # a gradient that PPO left behind
    batches = distillation.TeacherBatches(policy, DistillationConfig(batch=64, steps=300, learning_rate=1e-2))
    before = distillation.imitation_error(policy.distribution(x)[0], behavior).mean()
    batches.update(x, behavior, weight, 1.0, generator)
    after = distillation.imitation_error(policy.distribution(x)[0], behavior).mean()
    assert after < 0.01 * before
    assert torch.equal(policy.critic.weight, critic)


def test_strength_scales_the_step_and_zero_draws_nothing(lesson):
    x, behavior, weight, generator = lesson

    def moved(strength):
        policy = LinearPolicy()
        distillation.TeacherBatches(policy, DistillationConfig(batch=64, steps=1)).update(
            x, behavior, weight, strength, torch.Generator().manual_seed(0)
        )
        return (policy.actor.weight - 0.1).detach()

    # the weight is kept near 0.1: a step of 3e-5 is known to one part in a thousand
    assert torch.allclose(moved(0.2), 0.2 * moved(1.0), rtol=1e-2, atol=1e-9)
    state = generator.get_state()
    policy = LinearPolicy()
    distillation.TeacherBatches(policy, DistillationConfig()).update(x, behavior, weight, 0.0, generator)
    assert torch.equal(generator.get_state(), state)
    assert torch.equal(policy.actor.weight, torch.full((4, 2), 0.1))


def test_a_batch_that_is_not_finite_changes_nothing_and_is_counted(lesson):
    x, _teacher, weight, generator = lesson
    policy = LinearPolicy()
    batches = distillation.TeacherBatches(policy, DistillationConfig(batch=64, steps=2))
    batches.update(x, torch.full((500, 4), math.nan), weight, 1.0, generator)
    assert batches.skipped == 2
    assert torch.equal(policy.actor.weight, torch.full((4, 2), 0.1))


def test_teacher_batches_go_on_from_their_state(lesson):
    x, behavior, weight, _generator = lesson

    def run(parts):
        policy, generator = LinearPolicy(), torch.Generator().manual_seed(7)
        state = None
        for _ in range(parts):
            batches = distillation.TeacherBatches(policy, DistillationConfig(batch=32, steps=4 // parts))
            if state is not None:
                batches.load_state_dict(state)
            batches.update(x, behavior, weight, 0.7, generator)
            state = batches.state_dict()
        return policy.actor.weight

    assert torch.equal(run(1), run(2))


def test_errors_by_leaf():
    errors = distillation.LeafErrors(("Root", "Evade", "Follow", "Evade"), torch.device("cpu"))
    errors.add(torch.tensor([1.0, 2.0, 3.0, 6.0]), torch.tensor([1, 2, 3, -1], dtype=torch.int32))
    errors.add(torch.tensor([4.0, math.nan]), torch.tensor([2, 2], dtype=torch.int32))
    found = errors.take()
    assert found == {
        "distillation/leaf/Evade": 2.0,
        "distillation/leaf/Follow": 3.0,
        "distillation/loss": 16.0 / 5,
    }
    assert errors.take() == {}
