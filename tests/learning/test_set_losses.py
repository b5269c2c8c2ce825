"""Losses of a policy over a set, by pieces on threads: gradients of the whole, for any number of threads."""

import time

import pytest
import torch

from uuvtai.common.enums import EGO_COLUMNS, OBSTACLE_WIDTH
from uuvtai.config.learning import LearningConfig
from uuvtai.learning import networks
from uuvtai.learning.networks import CACHE_ROWS, by_part, log_prob, side_by_side
from uuvtai.learning.ppo import Ppo, surrogate_loss
from uuvtai.learning.set_networks import MaxAndSum, SetPolicy

ROWS, LANES, N_TRUTH = CACHE_ROWS + 77, 3, 4


@pytest.fixture
def ppo(monkeypatch):
    """One that takes no step."""
    config = LearningConfig.model_validate(
        {"surrogate": {"obstacle_hidden": 8, "head_hidden": 8}, "ppo": {"entropy_weight": 0.0}}
    )
    widths = {"obstacles": OBSTACLE_WIDTH, "own": EGO_COLUMNS, "truth": N_TRUTH}
    view = {name: torch.zeros(1, width) for name, width in widths.items()}
    made = Ppo(SetPolicy(view, config, torch.Generator().manual_seed(0)), config.ppo)
    monkeypatch.setattr(made, "step", lambda **_options: False)
    return made


@pytest.fixture(scope="module")
def batch():
    generator = torch.Generator().manual_seed(1)

    def drawn(*shape):
        return torch.randn(ROWS, *shape, generator=generator)

    obstacles = drawn(LANES, OBSTACLE_WIDTH)
    obstacles[..., 0] = (obstacles[..., 0] > 0).float()
    return {
        "obstacles": obstacles, "own": drawn(EGO_COLUMNS), "truth": drawn(LANES, N_TRUTH), "action": drawn(3),
        "log_prob": drawn() - 3.0, "advantage": drawn(), "target": drawn(), "valid": torch.ones(ROWS),
    }  # fmt: skip


def gradients(ppo, batch, index=None):
    """Of every parameter, and the sums; ``index``: of the rows, None = all."""
    every = torch.arange(len(batch["valid"]))
    sums = ppo._learn(batch, every if index is None else index, 0.0)
    return [p.grad for net in ppo._nets for p in net], sums


def test_pieces_add_up_to_the_gradient_of_the_whole(ppo, batch):
    found, sums = gradients(ppo, batch)
    policy, config = ppo.policy, ppo.config
    ratio = log_prob(batch["action"], policy.mean_of(batch), policy.log_std) - batch["log_prob"]
    surrogate = surrogate_loss(ratio, batch["advantage"], config.clip).mean()
    error = (policy.value_of(batch) - batch["target"]).square().mean()
    wanted = [
        *torch.autograd.grad(surrogate, ppo._nets[0]),
        *torch.autograd.grad(config.value_weight * error, ppo._nets[1]),
    ]
    for one, asked in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, asked, rtol=1e-3, atol=1e-5)
    means = (sums[:2] / sums[-1]).float()
    torch.testing.assert_close(means, torch.stack([surrogate, error]).detach(), rtol=1e-4, atol=1e-5)


def test_a_minibatch_is_the_rows_that_were_chosen(ppo, batch):
    chosen = torch.randperm(ROWS, generator=torch.Generator().manual_seed(3))[:500]
    alone, _ = gradients(ppo, {name: part[chosen] for name, part in batch.items()})
    found, _ = gradients(ppo, batch, chosen)
    assert all(torch.equal(a, b) for a, b in zip(alone, found, strict=True))


def test_the_critics_gradient_is_cut_by_itself(ppo, batch):
    """Its rate is its own, too."""
    gradients(ppo, batch)
    for parameter in ppo._nets[1]:
        parameter.grad *= 1e4
    actor = [p.grad.clone() for p in ppo._nets[0]]
    Ppo.step(ppo, most=ppo.config.max_grad_norm)
    assert [group["lr"] for group in ppo.optimiser.param_groups[1:]] == [SetPolicy.critic_rate]
    norm = torch.linalg.vector_norm(torch.stack([grad.norm() for grad in actor]))
    factor = min(1.0, ppo.config.max_grad_norm / float(norm))
    for parameter, before in zip(ppo._nets[0], actor, strict=True):
        torch.testing.assert_close(parameter.grad, factor * before, rtol=1e-4, atol=1e-7)


def test_maximum_and_sum_have_the_gradient_of_torch():
    generator = torch.Generator().manual_seed(4)
    said = torch.randn(5, 64, 8, generator=generator)
    said[1, :9] = said[3, :9]  # equally high obstacles share
    said.requires_grad_()
    mask = (torch.rand(5, 64, generator=generator) < 0.6).float()
    mask[:, 20:25] = 0.0  # rows without an obstacle
    back = [torch.randn(64, 8, generator=generator) for _ in range(2)]
    each = torch.relu(said) * mask.unsqueeze(-1)
    wanted = each.amax(dim=0), each.sum(dim=0)
    found = MaxAndSum.apply(said, mask)
    assert all(torch.equal(a, b) for a, b in zip(found, wanted, strict=True))
    (asked,) = torch.autograd.grad(wanted, said, back)
    (grad,) = torch.autograd.grad(found, said, back)
    torch.testing.assert_close(grad, asked)
    assert bool((grad[(each == 0).detach()] == 0).all())


def test_the_number_of_threads_changes_no_bit(ppo, batch):
    """As in a training, where torch's own threads rest: their number changes bits on some processors."""

    def found(threads):
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        try:
            with networks.torch_threads_rest():
                grads, sums = gradients(ppo, batch)
                return [*grads, sums, by_part(ppo.policy.mean_of, batch)]
        finally:
            torch.set_num_threads(before)

    one = found(1)
    assert all(tensor.abs().sum() > 0 for tensor in one)
    for threads in (2, 3):
        assert all(torch.equal(a, b) for a, b in zip(one, found(threads), strict=True))


def test_what_goes_wrong_in_a_piece_is_told(monkeypatch):
    monkeypatch.setattr(networks.torch, "get_num_threads", lambda: 2)
    with pytest.raises(ZeroDivisionError):
        side_by_side(lambda: 1, lambda: 1 // 0)
    assert side_by_side(lambda: 1, lambda: 2) == [1, 2]


def test_a_piece_has_one_thread_whatever_is_set_after_its_own_began():
    before = torch.get_num_threads()
    networks._pool.cache_clear()
    try:
        torch.set_num_threads(2)
        side_by_side(*[lambda: time.sleep(0.05)] * 2)  # nothing of torch: it counts its threads at first use
        torch.set_num_threads(2)
        assert side_by_side(*[torch.get_num_threads] * 4) == [1] * 4
    finally:
        torch.set_num_threads(before)
