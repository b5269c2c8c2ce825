"""``ppo.bfloat16``: only where the device multiplies in it, and said where it does not."""

import pytest
import torch

from tests.command import uuv
from uuvtai.config.learning import PpoConfig
from uuvtai.config.loader import load_training
from uuvtai.learning import networks
from uuvtai.learning.networks import (
    ActorCritic,
    fast_products,
    fastest_precision,
    in_bfloat16,
    multiplies_bfloat16,
)
from uuvtai.learning.ppo import Ppo

QUICK = load_training("quick")


def product(a):
    """As a policy that learns multiplies."""
    with Ppo(ActorCritic(3, QUICK.policy, torch.Generator()), QUICK.ppo).policy.coarse():
        return a @ a


@pytest.fixture
def cpu(monkeypatch):
    """Function: another CPU, as torch tells of it."""

    def other(**capabilities):
        monkeypatch.setattr(networks.torch.cpu, "get_capabilities", lambda: capabilities, raising=False)
        multiplies_bfloat16.cache_clear()

    yield other
    multiplies_bfloat16.cache_clear()


@pytest.mark.parametrize("name", networks.INSTRUCTIONS)
def test_a_cpu_that_has_the_instructions_uses_them(cpu, name):
    cpu(avx2=True, **{name: True})
    assert in_bfloat16(PpoConfig(bfloat16=True), "cpu")
    assert not in_bfloat16(PpoConfig(bfloat16=False), "cpu")


def test_a_cpu_without_them_multiplies_in_float32(cpu):
    cpu(avx2=True, avx512_f=True, avx512_bf16=False)
    assert QUICK.ppo.bfloat16 and not in_bfloat16(QUICK.ppo, "cpu")
    assert in_bfloat16(QUICK.ppo, "cuda")
    a = torch.full((2, 2), 1.001)
    assert product(a).dtype == torch.float32
    cpu(avx512_bf16=True)
    assert product(a).dtype == torch.bfloat16


def test_a_torch_that_cannot_tell_counts_as_without(cpu, monkeypatch):
    cpu(avx512_bf16=True)
    monkeypatch.delattr(networks.torch.cpu, "get_capabilities")
    assert not multiplies_bfloat16("cpu")


@pytest.mark.parametrize("has", [False, True])
def test_a_training_says_so(cpu, has, tmp_path, capfd):
    cpu(avx512_bf16=has)
    small = ["train.num_envs=8", "ppo.minibatches=1", "surrogate.scenarios=8", "train.evaluate_episodes=8"]
    words = [word for change in small for word in ("--set", change)]
    code, _, told = uuv(capfd, "train", "quick", "--iterations", "1", "--run-dir", tmp_path / "run", *words)
    assert code == 0, told
    assert ("float32" in told) == (not has)


def test_the_other_library_multiplies_only_where_it_is_as_exact(monkeypatch):
    with pytest.raises(ZeroDivisionError), fast_products():
        assert torch.get_float32_matmul_precision() == fastest_precision()
        a, b = torch.randn(300, 200), torch.randn(200, 100)
        torch.testing.assert_close(a @ b, (a.double() @ b.double()).float(), atol=2e-4, rtol=0)
        _ = 1 / 0
    assert torch.get_float32_matmul_precision() == "highest"
    monkeypatch.setattr(networks, "LARGEST_ERROR", 0.0)
    fastest_precision.cache_clear()
    assert fastest_precision() == "highest"
    fastest_precision.cache_clear()
