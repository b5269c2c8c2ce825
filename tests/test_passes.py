"""Hand-written back-propagation against autograd: for every activation, blocks of any size, both precisions,
and in a whole minibatch of PPO."""

import pytest
import torch

from benchmarks.backward import PpoByHand, filled_rollout
from benchmarks.peers.passes import Passes
from uuvtai.config.learning import PolicyConfig, PpoConfig
from uuvtai.learn.mlp import mlp
from uuvtai.learn.policy import ActorCritic
from uuvtai.learn.ppo import CACHE_ROWS, Ppo

FLOAT32 = 1e-5
"""relative to the norm; sums of a few hundred products in another order"""
BFLOAT16 = 0.05
"""relative to the norm; eight bits of mantissa through three layers, and a relu near its kink switches"""


def gradients(net):
    return [p.grad.clone() for p in net.parameters()]


def by_autograd(net, x, by_output):
    net.zero_grad(set_to_none=True)
    out = net(x)
    out.backward(by_output)
    return out.detach(), gradients(net)


def assert_close(found, expected, tolerance):
    for a, b in zip(found, expected, strict=True):
        assert a.dtype == torch.float32
        assert float((a - b).norm()) <= tolerance * float(b.norm())


@pytest.mark.parametrize("activation", ["elu", "tanh", "relu"])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, FLOAT32), (torch.bfloat16, BFLOAT16)])
def test_outputs_and_gradients_are_those_of_autograd(activation, dtype, tolerance):
    generator = torch.Generator().manual_seed(0)
    net = mlp((9, 32, 24, 4), activation, generator)
    x, by_output = torch.randn(100, 9, generator=generator), torch.randn(100, 4, generator=generator)
    out, expected = by_autograd(net, x, by_output)
    passes, found = Passes(net, 30, dtype), []
    passes.begin()
    for first in range(0, 100, 30):
        rows = slice(first, first + 30)
        found.append(passes.forward(x[rows]).clone())
        passes.backward(x[rows], by_output[rows])
    assert_close([torch.cat(found)], [out], tolerance)
    assert_close(gradients(net), expected, tolerance)


def test_a_new_beginning_forgets_gradients_and_sees_new_weights():
    generator = torch.Generator().manual_seed(0)
    net = mlp((3, 8, 1), "elu", generator)
    passes = Passes(net, 16, torch.bfloat16)
    x, ones = torch.randn(16, 3, generator=generator), torch.ones(16, 1)
    for _ in range(2):
        passes.begin()
        passes.forward(x)
        passes.backward(x, ones)
        assert_close(gradients(net), by_autograd(net, x, ones)[1], BFLOAT16)
        with torch.no_grad():
            for parameter in net.parameters():
                parameter.mul_(-1.5)


def test_one_layer_is_a_network_too():
    net = mlp((3, 2), "relu", torch.Generator().manual_seed(0))
    x, by_output = torch.randn(5, 3, generator=torch.Generator().manual_seed(1)), torch.ones(5, 2)
    out, expected = by_autograd(net, x, by_output)
    passes = Passes(net, 5)
    passes.begin()
    assert_close([passes.forward(x)], [out], FLOAT32)
    passes.backward(x, by_output)
    assert_close(gradients(net), expected, FLOAT32)


@pytest.mark.parametrize("surrogate", [True, False])
@pytest.mark.parametrize(("bfloat16", "tolerance"), [(False, FLOAT32), (True, BFLOAT16)])
def test_a_minibatch_of_ppo_has_the_gradients_of_the_hand_written_passes(bfloat16, tolerance, surrogate):
    """Two blocks, the second one shorter; without the surrogate and distillation the actor has none."""
    found = {}
    for kind in (Ppo, PpoByHand):
        policy = ActorCritic(9, PolicyConfig(hidden=(32, 24)), None, torch.Generator().manual_seed(0))
        config = PpoConfig(epochs=1, minibatches=1, bfloat16=bfloat16)
        kind(policy, config).update(filled_rollout(16, CACHE_ROWS // 16 + 9, 9), surrogate=surrogate)
        found[kind] = {name: p.grad for name, p in policy.named_parameters() if p.grad is not None}
    assert found[Ppo].keys() == found[PpoByHand].keys()
    assert any(name.startswith("actor") for name in found[Ppo]) == surrogate
    assert_close(found[Ppo].values(), found[PpoByHand].values(), tolerance)
