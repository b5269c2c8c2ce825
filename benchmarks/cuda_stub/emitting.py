"""Compile a simulator's kernels for CUDA against the stub driver, in a process of its own.

``python -m benchmarks.cuda_stub.emitting NUM_ENVS WORLD SENSORS [KERNEL ...]``: without kernels the whole of
two resets and two steps, as a training makes them, launched; else these kernels of a reset and a step alone.
``LD_LIBRARY_PATH`` must name the folder of the stub. Prints how many launches and waits the last reset and
the last step took.
"""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import taichi as ti
import torch

ROOT = Path(__file__).resolve().parents[2]
SOURCE = Path(__file__).with_name("stub_driver.c")
CALLS = "calls.tsv"
_LONGEST_S = 900


class StubError(RuntimeError):
    """The stub cannot be built, or Taichi did not get through."""


@dataclass(frozen=True)
class Task:
    """One launch of a kernel's part."""

    module: str
    """number of its PTX module"""
    entry: str
    """name in that module"""
    blocks: int
    threads: int
    """of a block"""


@dataclass(frozen=True)
class Emitted:
    """What one process wrote."""

    modules: list[Path]
    """PTX"""
    tasks: list[Task]
    """all launches, in order"""
    counts: dict[str, Any]
    """what the process printed"""


def build_stub(compiler: str, folder: Path) -> None:
    """Build ``libcuda.so`` in a folder. Raises StubError."""
    command = [
        compiler,
        "-shared",
        "-fPIC",
        "-O1",
        "-o",
        str(folder / "libcuda.so.1"),
        str(SOURCE),
        "-lpthread",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise StubError(f"{' '.join(command)}: {done.stderr.strip()}")
    (folder / "libcuda.so").symlink_to("libcuda.so.1")


def emit(stub: Path, folder: Path, capability: int, shape: tuple[int, str, str], *kernels: str) -> Emitted:
    """PTX of a simulator (num_envs, world, sensors) in ``folder``, for a GPU of ``capability`` (90 = sm_90).
    Raises StubError."""
    environment = os.environ | {
        "LD_LIBRARY_PATH": os.pathsep.join(filter(None, (str(stub), os.environ.get("LD_LIBRARY_PATH")))),
        "STUB_FOLDER": str(folder),
        "STUB_CC": str(capability),
        "PYTHONPATH": str(ROOT),
    }
    command = [sys.executable, "-m", __name__, *map(str, shape), *kernels]
    done = subprocess.run(
        command, env=environment, cwd=ROOT, capture_output=True, text=True, check=False, timeout=_LONGEST_S
    )
    if done.returncode:
        raise StubError(f"{' '.join(command)}: exit code {done.returncode}\n{done.stderr[-2000:]}")
    tasks = [Task(m, e, int(b), int(t)) for m, e, b, t in _calls(folder) if m != "wait"]
    return Emitted(sorted(folder.glob("*.ptx")), tasks, json.loads(done.stdout.splitlines()[-1]))


def _calls(folder: Path) -> list[list[str]]:
    path = folder / CALLS
    return [line.split("\t") for line in path.read_text().splitlines()] if path.exists() else []


# ------------------------------------------------------------------------------------- the process of its own


class _HostTorch:
    """torch, but for the device of a simulator's tensors: there is no CUDA in it."""

    def __getattr__(self, name: str) -> Any:
        return getattr(torch, name)

    @staticmethod
    def device(_name: str) -> torch.device:
        return torch.device("cpu")


def _count_torchs_waits() -> None:
    """Have the stub told of what torch would wait for, were its tensors on a GPU."""
    driver = ctypes.CDLL("libcuda.so.1")

    def telling(name: str) -> Any:
        plain = getattr(torch.Tensor, name)

        def told(self: torch.Tensor, *arguments: Any) -> Any:
            driver.cuStreamSynchronize(None)
            return plain(self, *arguments)

        return told

    for name in ("cpu", "item", "tolist", "__bool__", "__int__", "__float__"):
        setattr(torch.Tensor, name, telling(name))


def _simulator(num_envs: int, world: str, sensors: str) -> Any:
    """A simulator that takes itself to be on a GPU; its tensors are the host's."""
    torch.cuda.is_available = lambda: True
    torch.cuda.mem_get_info = lambda *_: (78 << 30, 80 << 30)
    begin = ti.init
    ti.init = lambda **options: begin(**{**options, "offline_cache": False})
    from uuvtai import sim as module
    from uuvtai.copying import copied_rows
    from uuvtai.loader import load_config
    from uuvtai.taichi_patches.memory import Memory
    from uuvtai.tree import read_tree

    class DeviceMemory(Memory):
        def __init__(self, structs: Any, anchor: Any, address: int, _device: torch.device) -> None:
            super().__init__(structs, anchor, address, torch.device("cuda"))

        def tensor(self, field: ti.Field) -> torch.Tensor:
            return torch.zeros(field.shape, dtype=torch.int32)  # no kernel has written anything

    class Rehearsed(module.Sim):
        def rows(self, field: ti.Field, envs: list[int] | None = None) -> np.ndarray:
            chosen = range(self.num_envs) if envs is None else envs
            return copied_rows(field, torch.tensor(chosen, dtype=torch.int32))

    module.torch = _HostTorch()  # type: ignore[assignment]
    module.Memory = DeviceMemory  # type: ignore[misc]
    module.check_scenarios = lambda faults: None  # kernels do nothing: there is no scenario
    config = load_config(world, sensors, overrides={"runtime.native": False})
    return Rehearsed(config, num_envs, read_tree("bt"), "cuda")


def _some(sim: Any, wanted: list[str]) -> dict[str, Any]:
    """Launch the kernels of these names."""
    from uuvtai.native.launch import compiling
    from uuvtai.other_end import calls_of

    found = [(k, a) for k, a in calls_of(sim) if k.func.__name__ in wanted]
    for kernel, arguments in found:
        with compiling(kernel, arguments):
            kernel(*arguments)
    return {"kernels": sorted(k.func.__name__ for k, _ in found)}


def _whole(sim: Any, folder: Path) -> dict[str, Any]:
    """Reset and step twice, and those of a VectorEnv; launches and waits of the second time."""
    from uuvtai.env import VectorEnv

    ones = torch.ones(sim.num_envs, dtype=torch.int32)
    counts: dict[str, Any] = {}
    sim.observe()
    env = VectorEnv(sim, check_actions=False)
    _count_torchs_waits()
    for _ in range(2):
        for name, call in (
            ("reset", lambda: sim.reset(ones, 0 * ones, torch.arange(sim.num_envs, dtype=torch.int32))),
            ("step", sim.step),
            ("first reset of a VectorEnv", env.reset),
            ("step of a VectorEnv", lambda: env.step(sim.action)),
        ):
            ti.sync()
            before = _calls(folder)
            call()
            made = _calls(folder)[len(before) :]
            counts[name] = {
                "launches": [m[1] for m in made if m[0] != "wait"],
                "waits": [m[1] for m in made if m[0] == "wait"],
            }
    return counts


def main() -> None:
    """See the module."""
    num_envs, world, sensors, *wanted = sys.argv[1:]
    sim = _simulator(int(num_envs), world, sensors)
    found = _some(sim, wanted) if wanted else _whole(sim, Path(os.environ["STUB_FOLDER"]))
    ti.sync()
    print(json.dumps(found), flush=True)
    os._exit(0)  # nothing is to be freed on a device that is none


if __name__ == "__main__":
    main()
