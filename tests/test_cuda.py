"""CUDA without a GPU: Taichi compiles the whole reset and step for a stub of the driver, ``ptxas`` assembles
that, and kernels in the shape for a GPU, run on the CPU, give the same bits."""

import ctypes
import os
import shutil
import sys

import pytest
import torch

from benchmarks import rehearsal
from benchmarks.cuda_stub import assembling, counting, emitting, playing
from tests.small_sim import SmallSim
from uuvtai.copying import HostCounts
from uuvtai.errors import SettingError
from uuvtai.loader import load_config
from uuvtai.native import gpu_shape
from uuvtai.native.machine import Machine
from uuvtai.outcomes import RUNNING, TIMEOUT
from uuvtai.sizes import array_sizes
from uuvtai.taichi_patches.memory import Memory

COMPILER = shutil.which("cc") or shutil.which("gcc")
PTXAS = assembling.find_ptxas()
ENVS = 16384
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="needs a C compiler for the stub of the driver")
needs_ptxas = pytest.mark.skipif(PTXAS is None, reason=f"needs ptxas: pip install {assembling.PACKAGE}")


@pytest.fixture(scope="module")
def emitted(tmp_path_factory):
    """PTX of the whole reset and step for sm_80, which every newer GPU can run too."""
    stub, folder = tmp_path_factory.mktemp("stub"), tmp_path_factory.mktemp("ptx")
    emitting.build_stub(COMPILER, stub)
    return emitting.emit(stub, folder, 80, (ENVS, "pool", "paper"))


@needs_compiler
def test_taichi_writes_ptx_of_every_kernel_and_no_loop_is_too_narrow_for_a_gpu(emitted):
    step = {assembling.kernel_of(entry) for entry in emitted.counts["step"]["launches"]}
    assert {"cast_sonar", "update_map", "plan_routes", "plan_evasion", "tick_tree", "move_vehicle"} <= step
    assert len(step) > 25 and "generate_scenarios" not in step
    assert rehearsal.too_narrow(emitted, ENVS) == []
    assert not any(assembling.doubles_in(module) for module in emitted.modules)
    plans = [t for t in emitted.tasks if "plan_routes" in t.entry and t.entry.endswith("range_for")]
    assert {task.blocks * task.threads for task in plans} == {ENVS // 16}
    for kernel in ("update_map", "compute_clearance"):
        wide = [t.blocks * t.threads for t in emitted.tasks if kernel in t.entry and "range_for" in t.entry]
        assert wide.count(32 * ENVS) >= 2, f"{kernel}: no warp for an env"
    waits = {name: len(made["waits"]) for name, made in emitted.counts.items()}
    assert waits["step"] == waits["step of a VectorEnv"] == 1, (
        "to learn of failed plans and of ended episodes"
    )
    assert waits["reset"] == 2, "the same, and to check the new scenarios"


@needs_compiler
@needs_ptxas
def test_ptxas_assembles_all_of_it_and_spills_little(emitted):
    entries = assembling.assemble(PTXAS, emitted.modules, "sm_90", 2)
    assert {task.entry for task in emitted.tasks} <= {entry.entry for entry in entries}
    worst = max(entries, key=lambda entry: entry.spilled)
    assert worst.spilled <= rehearsal.SPILL_LIMIT, worst
    assert all(0 < entry.registers <= 255 for entry in entries)


class DevicesMemory(Memory):
    """The simulator's memory as that of a GPU: tensors are all that is seen of it."""

    def __init__(self, sim):
        plain = sim.memory()
        super().__init__(sim.s, sim.s.clock.active, 0, torch.device("cuda"))
        self.address, self._bytes = plain.address, torch.from_numpy(plain.read())

    def _on_device(self):
        return self._bytes


def test_a_gpus_numbers_are_told_at_once(small):
    sim = small.sim
    memory = DevicesMemory(sim)
    for field in (sim.s.route.n_failed, sim.s.referee.outcome, sim.s.route.failed):
        assert memory.tensor(field).numpy().tolist() == sim._memory.live(field).tolist()
    outcome, kept = sim._memory.live(sim.s.referee.outcome), sim._memory.live(sim.s.referee.outcome).copy()
    failed = sim._memory.live(sim.s.route.n_failed)
    counts = HostCounts(memory, sim.s.referee.outcome, SmallSim.N)
    try:
        outcome[...], failed[...] = RUNNING, 3
        assert (counts.number(sim.s.route.n_failed), counts.any_ended) == (3, 0)
        outcome[SmallSim.N - 1] = TIMEOUT
        assert (counts.number(sim.s.route.n_failed), counts.any_ended) == (3, 1)
        mask = torch.zeros(SmallSim.N, dtype=torch.int32)
        assert not counts.has_any(sim.s.referee.outcome, mask)
        mask[-1] = 1
        assert counts.has_any(sim.s.referee.outcome, mask)
        assert HostCounts(sim._memory, sim.s.referee.outcome, SmallSim.N).has_any(sim.s.referee.outcome, mask)
    finally:
        outcome[...], failed[...] = kept, 0


@needs_ptxas
def test_what_ptxas_refuses_is_told(tmp_path):
    module = tmp_path / "0000.ptx"
    module.write_text(".version 7.0\n.target sm_80\nnonsense\n")
    with pytest.raises(assembling.PtxasError, match="nonsense"):
        assembling.assemble(PTXAS, [module], "sm_80")


def test_what_ptxas_says_is_read():
    """Of a function that an entry calls it tells in the same way: its stack counts with the entry's."""
    text = """
ptxas info    : 0 bytes gmem
ptxas info    : Compiling entry function 'plan_routes_c7_0_kernel_0_range_for' for 'sm_90'
ptxas info    : Function properties for plan_routes_c7_0_kernel_0_range_for
    24 bytes stack frame, 8 bytes spill stores, 12 bytes spill loads
ptxas info    : Function properties for helper
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 96 registers, used 1 barriers, 40 bytes cumulative stack size, 352 bytes cmem[0]
ptxas info    : Compiling entry function 'wake_c8_0_kernel_0_range_for' for 'sm_90'
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 18 registers
"""
    plan, wake = assembling._said("0003", text)
    assert (plan.kernel, plan.registers, plan.stack, plan.spilled) == ("plan_routes", 96, 40, 12)
    assert (wake.kernel, wake.registers, wake.stack, wake.spilled) == ("wake", 18, 0, 0)


def test_doubles_are_seen(tmp_path):
    module = tmp_path / "0000.ptx"
    module.write_text(
        "\tadd.rn.f32 %f1, %f2, %f3;\n\t@%p1 add.f64 %fd1, %fd2, %fd3;\n\tcvt.f32.f64 %f1, %fd1;\n"
    )
    assert assembling.doubles_in(module) == 2


@needs_compiler
def test_a_stub_that_cannot_be_built_says_why(tmp_path, monkeypatch):
    source = tmp_path / "broken.c"
    source.write_text("int cuInit(unsigned flags) { return nothing_of_that_name; }\n")
    monkeypatch.setattr(emitting, "SOURCE", source)
    with pytest.raises(emitting.StubError, match="nothing_of_that_name"):
        emitting.build_stub(COMPILER, tmp_path)


LOOP = """
define void @kernel(float* %at, i32 %count) {
entry:
  br label %next
next:
  %i = phi i32 [ 0, %entry ], [ %j, %next ]
  %place = getelementptr float, float* %at, i32 %i
  %old = load float, float* %place
  %new = fadd float %old, 1.0
  store float %new, float* %place
  %j = add i32 %i, 1
  %more = icmp slt i32 %j, %count
  br i1 %more, label %next, label %done
done:
  ret void
}
"""


@pytest.mark.skipif(sys.platform != "linux", reason="own machine code is for Linux")
def test_instructions_and_accesses_are_counted_as_often_as_they_are_done():
    counts, values = (ctypes.c_int64 * 2)(), (ctypes.c_float * 7)()
    machine = Machine(1)
    machine.symbols[counting.SYMBOL] = ctypes.addressof(counts)
    (place,) = machine.tasks_of(machine.object_of(counting.instrumented(LOOP)), ["kernel"])
    ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int32)(place)(ctypes.addressof(values), 7)
    assert list(values) == [1.0] * 7
    assert list(counts) == [7 * 6, 7 * 2]


def test_the_model_takes_the_longest_of_work_memory_and_one_thread():
    gpu = counting.Gpu("", 10, 1.0e9, 1.0e12)
    one = {"instructions": 0, "accesses": 0, "of_item": 0.0, "busy_share": 1.0, "launches": 1}

    def seconds(num_envs, **changed):
        return counting.step_seconds(
            gpu, {"num_envs": 64, "steps": 1, "step": {"wake": one | changed}, "reset": {}}, num_envs
        )

    idle = seconds(64)
    assert 0.0 < idle == seconds(64000)
    assert seconds(64000, instructions=10**6) - idle == pytest.approx(10**9 / (10 * 128 * 1e9 * 0.1))
    assert seconds(64, accesses=10**6) - idle == pytest.approx(10**6 * 32 * 0.3 / 1e12)
    assert seconds(64, of_item=1e6) - idle == seconds(64000, of_item=1e6) - idle == pytest.approx(8e-3)


def test_sizes_of_a_gpu_grow_with_the_batch(monkeypatch):
    config = load_config("pool", "paper")
    assert array_sizes(config, 65536, "cuda")["n_plan"] == 4096
    assert array_sizes(config, 64, "cuda")["n_plan"] == 16 and array_sizes(config, 8, "cuda")["n_plan"] == 8
    assert array_sizes(config, 4096)["n_plan"] == array_sizes(config, 4096)["n_slot"] == 64
    monkeypatch.setenv(gpu_shape.VARIABLE, "gpu")
    assert array_sizes(config, 4096) == array_sizes(config, 4096, "cuda")
    monkeypatch.setenv(gpu_shape.VARIABLE, "quantum")
    with pytest.raises(SettingError, match="UUV_KERNELS='quantum': must be cpu or gpu"):
        array_sizes(config, 8)


def test_kernels_in_the_shape_for_a_gpu_give_the_same_bits(small):
    """200 steps with resets; the whole stack, so that no kernel can be forgotten."""
    assert os.environ.get(gpu_shape.VARIABLE) in (None, "", "cpu")
    ours = playing.play(small.sim, 200)
    apart = playing.played_apart("gpu", SmallSim.N, "paper", 200)
    assert len(ours) > 200 and playing.differing(ours, apart) == []
