"""Losses of a policy over a set, by pieces on threads: gradients of the whole, for any number of threads."""

import pytest
import torch

from uuvtai.config.learning import LearningConfig
from uuvtai.learning import surrogate_trainer as pieces
from uuvtai.learning.networks import log_prob
from uuvtai.learning.ppo import surrogate_loss
from uuvtai.learning.set_networks import MaxAndSum, SetActor, SetCritic
from uuvtai.learning.surrogate_trainer import CACHE_ROWS, SetLosses, by_part, side_by_side

ROWS, LANES, N_OBSTACLE, N_OWN, N_TRUTH = CACHE_ROWS + 77, 3, 5, 7, 4


@pytest.fixture
def nets():
    config = LearningConfig.model_validate(
        {"surrogate": {"obstacle_hidden": 8, "head_hidden": 8}, "policy": {}}
    )
    generator = torch.Generator().manual_seed(0)
    actor = SetActor(N_OBSTACLE, N_OWN, config, generator)
    return config, actor, SetCritic(N_OBSTACLE, N_OWN, N_TRUTH, config, generator)


@pytest.fixture(scope="module")
def batch():
    generator = torch.Generator().manual_seed(1)

    def drawn(*shape):
        return torch.randn(ROWS, *shape, generator=generator)

    obstacles = drawn(LANES, N_OBSTACLE)
    obstacles[..., 0] = (obstacles[..., 0] > 0).float()
    return [obstacles, drawn(N_OWN), drawn(LANES, N_TRUTH), drawn(3), drawn() - 3.0, drawn(), drawn()]


def gradients(config, actor, critic, batch):
    for parameter in (*actor.parameters(), *critic.parameters()):
        parameter.grad = None
    sums = SetLosses(config, actor, critic).backward(batch, torch.arange(len(batch[0])))
    return [p.grad for p in actor.parameters()], [p.grad for p in critic.parameters()], sums


def test_pieces_add_up_to_the_gradient_of_the_whole(nets, batch):
    config, actor, critic = nets
    of_actor, of_critic, sums = gradients(config, actor, critic, batch)
    obstacles, own, truth, action, before, advantage, target = batch
    mean, value = actor(obstacles, own), critic(obstacles, own, truth)
    surrogate = surrogate_loss(
        log_prob(action, mean, actor.log_std) - before, advantage, config.ppo.clip
    ).mean()
    error = (value - target).square().mean()
    wanted = torch.autograd.grad(surrogate, list(actor.parameters()), retain_graph=True)
    for found, asked in zip(of_actor, wanted, strict=True):
        torch.testing.assert_close(found, asked, rtol=1e-3, atol=1e-5)
    wanted = torch.autograd.grad(config.ppo.value_weight * error, list(critic.parameters()))
    for found, asked in zip(of_critic, wanted, strict=True):
        torch.testing.assert_close(found, asked, rtol=1e-3, atol=1e-5)
    torch.testing.assert_close(sums[:2], torch.stack([surrogate, error]).detach(), rtol=1e-4, atol=1e-5)


def test_a_minibatch_is_the_rows_that_were_chosen(nets, batch):
    chosen = torch.randperm(ROWS, generator=torch.Generator().manual_seed(3))[:500]
    of_actor, of_critic, _ = gradients(*nets, [part[chosen] for part in batch])
    SetLosses(*nets).backward(batch, chosen)
    for net, wanted in zip(nets[1:], (of_actor, of_critic), strict=True):
        assert all(torch.equal(p.grad, grad) for p, grad in zip(net.parameters(), wanted, strict=True))


@pytest.mark.parametrize("kind", [torch.float32, torch.bfloat16])
def test_maximum_and_sum_have_the_gradient_of_torch(kind):
    generator = torch.Generator().manual_seed(4)
    said = torch.randn(5, 64, 8, generator=generator).to(kind)
    said[1, :9] = said[3, :9]  # equally high obstacles share
    said.requires_grad_()
    mask = (torch.rand(5, 64, generator=generator) < 0.6).float()
    mask[:, 20:25] = 0.0  # rows without an obstacle
    back = [torch.randn(64, 8, generator=generator).to(kind) for _ in range(2)]
    each = torch.relu(said) * mask.to(kind).unsqueeze(-1)
    wanted = each.amax(dim=0), each.sum(dim=0)
    found = MaxAndSum.apply(said, mask)
    assert all(torch.equal(a, b) for a, b in zip(found, wanted, strict=True))
    (asked,) = torch.autograd.grad(wanted, said, back)
    (grad,) = torch.autograd.grad(found, said, back)
    torch.testing.assert_close(grad, asked)
    assert bool((grad[(each == 0).detach()] == 0).all())


def test_the_number_of_threads_changes_no_bit(nets, batch, monkeypatch):
    def found(threads):
        monkeypatch.setattr(pieces.torch, "get_num_threads", lambda: threads)
        of_actor, of_critic, sums = gradients(*nets, batch)
        return [*of_actor, *of_critic, sums, by_part(nets[1], *batch[:2])]

    one = found(1)
    assert all(tensor.abs().sum() > 0 for tensor in one)
    for threads in (2, 3):
        assert all(torch.equal(a, b) for a, b in zip(one, found(threads), strict=True))


def test_what_goes_wrong_in_a_piece_is_told(monkeypatch):
    monkeypatch.setattr(pieces.torch, "get_num_threads", lambda: 2)
    with pytest.raises(ZeroDivisionError):
        side_by_side(lambda: 1, lambda: 1 // 0)
    assert side_by_side(lambda: 1, lambda: 2) == [1, 2]
