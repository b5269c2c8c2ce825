"""Policy: densities against torch.distributions, the teacher at birth, values, no hidden state."""

import math

import pytest
import torch
from torch import nn

from uuvtai.config.learning import PolicyConfig
from uuvtai.learning import networks
from uuvtai.learning.networks import ActorCritic, entropy, log_prob, mlp

N_IN = 7
FLOAT32 = 1e-5
"""relative and absolute; a small network in float32, its sums in another order"""


def make(seed=0, **config):
    return ActorCritic(N_IN, PolicyConfig(hidden=(16, 16), **config), torch.Generator().manual_seed(seed))


@pytest.fixture
def x():
    return torch.randn(50, N_IN, generator=torch.Generator().manual_seed(5)) * 3 + 2


def test_densities_are_those_of_torch(x):
    generator = torch.Generator().manual_seed(2)
    mean, action = torch.randn(50, 4, generator=generator), torch.randn(50, 4, generator=generator)
    log_std = torch.tensor([-0.5, 0.0, 0.3, -2.0])
    expected = torch.distributions.Normal(mean, log_std.exp())
    assert torch.allclose(log_prob(action, mean, log_std), expected.log_prob(action).sum(-1), rtol=FLOAT32)
    assert torch.allclose(entropy(log_std), expected.entropy().sum(-1)[0], rtol=FLOAT32)


def test_a_step_is_a_draw_from_the_distribution(x):
    policy = make()
    step = policy.act({"x": x}, torch.Generator().manual_seed(9))
    mean, log_std = policy.mean_of(policy.prepared({"x": x})), policy.log_std
    assert torch.allclose(step.mean, mean, atol=FLOAT32)
    assert torch.allclose(step.value, policy.expected({"x": x}), atol=FLOAT32)
    assert torch.allclose(step.log_prob, log_prob(step.action, mean, log_std), atol=FLOAT32)
    assert not any(tensor.requires_grad for tensor in step)
    many = policy.act({"x": x[:1].expand(40_000, -1)}, torch.Generator().manual_seed(3))
    spread = many.action - many.mean
    # 0.35 % is one standard error of 40,000
    assert torch.allclose(spread.std(0), torch.full((4,), 0.6), rtol=0.02)
    assert float(spread.mean(0).abs().max()) < 0.015  # five standard errors
    again = policy.act({"x": x}, torch.Generator().manual_seed(9))
    assert all(torch.equal(a, b) for a, b in zip(step, again, strict=True))


def test_shapes_follow_the_input(x):
    policy = make()
    assert policy.mean_of(policy.prepared({"x": x.view(5, 10, N_IN)})).shape == (5, 10, 4)
    assert policy.expected({"x": x.view(5, 10, N_IN)}).shape == (5, 10)


def test_the_floor_of_the_deviation():
    with pytest.raises(ValueError, match=r"policy\.min_std"):
        make(initial_std=0.1, min_std=0.2)
    policy = make(min_std=0.2)
    with torch.no_grad():
        policy.log_std.copy_(torch.tensor([-5.0, 0.0, -1.0, -5.0]))
    policy.floor_std()
    assert policy.log_std.exp().tolist() == pytest.approx([0.2, 1.0, math.exp(-1.0), 0.2])


def test_learning_returns_changes_the_statistics_but_no_value(x):
    policy = make()
    policy.observation_norm.update(x)
    before = policy.expected({"x": x})
    for returns in (torch.linspace(-50.0, 300.0, 40)[:, None], torch.linspace(900.0, 1000.0, 400)[:, None]):
        policy.learn_returns(returns)
        # in parts of returns of 1000 in float32
        assert torch.allclose(policy.expected({"x": x}), before, rtol=1e-4, atol=1e-3)
    assert float(policy.value_norm.mean) > 800
    normalised = policy.critic(policy.observation_norm(x)).squeeze(-1)
    assert torch.allclose(policy.value_norm(before), normalised, atol=1e-4)


def test_input_that_is_no_number_does_not_reach_the_action(x):
    policy = make()
    policy.observation_norm.update(x)
    x[0, 1], x[1, 2] = math.nan, math.inf
    step = policy.act({"x": x}, torch.Generator().manual_seed(0))
    assert all(torch.isfinite(tensor).all() for tensor in step)


def test_everything_random_comes_from_the_generator(x):
    torch.manual_seed(1)
    state = torch.get_rng_state()
    policy, same, other = make(seed=4), make(seed=4), make(seed=5)
    policy.act({"x": x}, torch.Generator().manual_seed(0))
    assert torch.equal(torch.get_rng_state(), state)
    assert all(
        torch.equal(a, b)
        for a, b in zip(policy.state_dict().values(), same.state_dict().values(), strict=True)
    )
    assert not torch.equal(policy.actor[0].weight, other.actor[0].weight)


def test_the_state_dict_is_the_whole_policy(x):
    policy, other = make(seed=4), make(seed=5)
    policy.observation_norm.update(x)
    policy.learn_returns(torch.arange(9.0)[:, None])
    other.load_state_dict(policy.state_dict())
    x_of_other, x_of_policy = other.prepared({"x": x}), policy.prepared({"x": x})
    assert torch.equal(other.mean_of(x_of_other), policy.mean_of(x_of_policy))
    assert torch.equal(other.expected({"x": x}), policy.expected({"x": x}))


@pytest.mark.parametrize("activation", ["elu", "tanh", "relu"])
def test_networks_have_the_widths_and_activations_asked_for(activation):
    net = mlp((5, 8, 3, 2), activation, torch.Generator().manual_seed(0), out_gain=0.5)
    linears = [layer for layer in net if isinstance(layer, nn.Linear)]
    assert [tuple(layer.weight.shape) for layer in linears] == [(8, 5), (3, 8), (2, 3)]
    assert [type(layer).__name__.lower() for layer in net if not isinstance(layer, nn.Linear)] == [
        activation
    ] * 2
    first, last = linears[0].weight, linears[-1].weight
    assert torch.allclose(first.T @ first, 2.0 * torch.eye(5), atol=FLOAT32)
    assert torch.allclose(last @ last.T, 0.25 * torch.eye(2), atol=FLOAT32)
    assert all(torch.equal(layer.bias, torch.zeros_like(layer.bias)) for layer in linears)


def test_the_other_library_multiplies_only_where_it_is_as_exact(monkeypatch):
    with pytest.raises(ZeroDivisionError), networks.fast_products():
        assert torch.get_float32_matmul_precision() == networks.fastest_precision()
        a, b = torch.randn(300, 200), torch.randn(200, 100)
        torch.testing.assert_close(a @ b, (a.double() @ b.double()).float(), atol=2e-4, rtol=0)
        _ = 1 / 0
    assert torch.get_float32_matmul_precision() == "highest"
    monkeypatch.setattr(networks, "LARGEST_ERROR", 0.0)
    networks.fastest_precision.cache_clear()
    assert networks.fastest_precision() == "highest"
    networks.fastest_precision.cache_clear()
