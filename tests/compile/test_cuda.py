"""The shape of kernels for a GPU, as far as a CPU can tell: the same bits, sizes, and numbers by the host."""

import os

import pytest
import torch

from tests import shape_bits
from tests.small_sim import SmallSim
from uuvtai.common.enums import RUNNING, TIMEOUT
from uuvtai.common.errors import DeviceError, SettingError
from uuvtai.compile import launch, runtime
from uuvtai.compile.memory import Memory
from uuvtai.config.loader import load_config
from uuvtai.sim.setup import HostCounts, array_sizes


class DevicesMemory(Memory):
    """The simulator's memory as that of a GPU: tensors are all that is seen of it."""

    def __init__(self, sim):
        plain = sim.memory()
        super().__init__(sim.s, sim.s.clock.running, 0, torch.device("cuda"))
        self.address, self._bytes = plain.address, torch.from_numpy(plain.read())

    def _on_device(self):
        return self._bytes


def test_a_gpus_numbers_are_told_at_once(small):
    sim = small.sim
    memory = DevicesMemory(sim)
    for field in (sim.s.route.n_failed, sim.s.termination.outcome, sim.s.route.failed):
        assert memory.tensor(field).numpy().tolist() == sim._memory.live(field).tolist()
    outcome = sim._memory.live(sim.s.termination.outcome)
    kept = sim._memory.live(sim.s.termination.outcome).copy()
    failed = sim._memory.live(sim.s.route.n_failed)
    counts = HostCounts(memory, sim.s.termination.outcome, SmallSim.N)
    try:
        outcome[...], failed[...] = RUNNING, 3
        assert (counts.number(sim.s.route.n_failed), counts.any_ended) == (3, 0)
        outcome[SmallSim.N - 1] = TIMEOUT
        assert (counts.number(sim.s.route.n_failed), counts.any_ended) == (3, 1)
        for where in (memory, sim._memory):
            counts = HostCounts(where, sim.s.termination.outcome, SmallSim.N)
            outcome[...] = 0
            assert not counts.has_any(sim.s.termination.outcome)
            outcome[SmallSim.N - 1] = TIMEOUT
            assert counts.has_any(sim.s.termination.outcome)
    finally:
        outcome[...], failed[...] = kept, 0


def test_sizes_of_a_gpu_grow_with_the_batch(monkeypatch):
    config = load_config("pool", "paper")
    assert array_sizes(config, 65536, "cuda")["n_plan"] == 4096
    assert array_sizes(config, 64, "cuda")["n_plan"] == 16 and array_sizes(config, 8, "cuda")["n_plan"] == 8
    assert array_sizes(config, 4096)["n_plan"] == array_sizes(config, 4096)["n_slot"] == 64
    monkeypatch.setenv(launch.VARIABLE, "gpu")
    assert array_sizes(config, 4096) == array_sizes(config, 4096, "cuda")
    monkeypatch.setenv(launch.VARIABLE, "quantum")
    with pytest.raises(SettingError, match="UUV_KERNELS='quantum': must be cpu or gpu"):
        array_sizes(config, 8)


def test_kernels_in_the_shape_for_a_gpu_give_the_same_bits(small):
    """75 steps with resets; the whole stack, so that no kernel can be forgotten."""
    assert os.environ.get(launch.VARIABLE) in (None, "", "cpu")
    ours = shape_bits.play(small.sim, 75)
    apart = shape_bits.played_apart("gpu", SmallSim.N, "paper", 75)
    assert len(ours) > 200 and shape_bits.differing(ours, apart) == []


def test_a_taichi_that_fell_back_to_the_cpu_is_no_gpu(monkeypatch):
    """Our tensors would lie where its kernels cannot reach."""
    runtime.start_taichi("cpu")
    monkeypatch.setattr(runtime, "_started", [])
    monkeypatch.setattr(runtime, "_resolved", lambda _device: "cuda")
    monkeypatch.setattr(runtime.ti, "init", lambda **_: None)
    monkeypatch.setattr(runtime.ti, "reset", (ended := []).clear)
    with pytest.raises(DeviceError, match=r"fell back to .*--device cpu"):
        runtime.start_taichi("cuda")
    assert not runtime._started and not ended
