"""MODEL of the speed on a GPU: what the kernels in their shape for a GPU do is counted instruction by
instruction while they run on the CPU, and turned into a time by a few assumed numbers of a GPU.

``UUV_KERNELS=gpu python -m benchmarks.cuda_stub.counting NUM_ENVS SENSORS STEPS``: prints counts as JSON.
"""

from __future__ import annotations

import ctypes
import json
import os
import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from uuvtai.native.gpu_shape import VARIABLE

ROOT = Path(__file__).resolve().parents[2]
_LONGEST_S = 1200
SYMBOL = "uuv_counts"
_INSTRUCTION = re.compile(r"^  (?:%[\w.]+ = )?(\w+)")
_LANES = re.compile(r"<(\d+) x ")
_LABEL = re.compile(r'^(?:[\w.$-]+|"[^"]+"):')
_FREE = ("phi", "br", "ret", "unreachable", "bitcast", "switch", "fence", "alloca")
_ACCESSES = ("load", "store", "atomicrmw", "cmpxchg")
_CALL_COSTS = 20
"""instructions of a function that is not in the module: sine, exponential and the like"""


@dataclass(frozen=True)
class Gpu:
    """A GPU's published numbers."""

    name: str
    processors: int
    """multiprocessors, each of which begins 128 instructions of single lanes in a cycle"""
    clock_hz: float
    bytes_per_s: float
    """of its memory"""


GPUS = (
    Gpu("A100 (80 GB)", 108, 1.41e9, 2.0e12),
    Gpu("H100 SXM", 132, 1.755e9, 3.35e12),
    Gpu("RTX 5090", 170, 2.41e9, 1.79e12),
)
_ISSUE_SHARE = 0.1
"""ASSUMED share of the lanes' cycles in which something is begun: a warp's envs take different branches, and
few warps fit beside each other where threads have many registers"""
_SECTOR_BYTES, _MISS_SHARE = 32, 0.3
"""ASSUMED: an access of a lane moves a sector, as envs lie far apart, unless a cache holds it"""
_CYCLES_ALONE = 8.0
"""ASSUMED cycles between two instructions of a thread: the least time that its work takes"""
_EPISODE_STEPS = 700
"""ASSUMED: one env in so many is reset in a step, and the pass of the resets is launched in every step"""
_THREADS_PER_ENV = {
    "cast_sonar": 32,
    "cast_depth": 20,
    "plan_evasion": 160,
    "scan_columns": 10,
} | dict.fromkeys(("update_map", "compute_clearance"), 32)
"""of kernels that have many; elsewhere a thread has an env or a track"""
_BESIDE = dict.fromkeys(("update_map", "compute_clearance"), 4)
"""ASSUMED accesses that share a sector, where the threads of an env go in step through neighbouring words of
eight bytes"""
_WAITS = 3
"""of the host in a step of a ``VectorEnv`` with a reset (counted by the stub)"""
_LAUNCH_S, _WAIT_S = 4e-6, 2e-5
"""ASSUMED of the host"""


def instrumented(text: str) -> str:
    """LLVM's text of a kernel with a count at the head of every block: instructions of single lanes, and
    accesses to memory."""
    lines: list[str] = []
    block: list[str] = []
    inside = False
    for line in text.splitlines():
        if line.startswith("define "):
            inside, block = True, []
            lines.append(line)
        elif inside and (line == "}" or _LABEL.match(line)):
            lines += _with_count(block, len(lines))
            lines.append(line)
            inside, block = line != "}", []
        elif inside:
            block.append(line)
        else:
            lines.append(line)
    return "\n".join([*lines, f"@{SYMBOL} = external global [2 x i64]", ""])


def _with_count(block: list[str], number: int) -> list[str]:
    """A block with its count after the phi nodes."""
    counts = [0, 0]
    for line in block:
        found = _INSTRUCTION.match(line)
        if found is None or found[1] in _FREE:
            continue
        lanes = _LANES.search(line)
        width = int(lanes[1]) if lanes else 1
        counts[0] += _CALL_COSTS if found[1] in ("call", "tail") and "@llvm." not in line else width
        counts[1] += width if found[1] in _ACCESSES else 0
    head = 0
    while head < len(block) and " = phi " in block[head]:
        head += 1
    added = []
    for which, count in enumerate(counts):
        if count:
            place = f"i64* getelementptr ([2 x i64], [2 x i64]* @{SYMBOL}, i64 0, i64 {which})"
            name = f"%uuv.{number}.{which}"
            added += [
                f"  {name} = load i64, {place}",
                f"  {name}.sum = add i64 {name}, {count}",
                f"  store i64 {name}.sum, {place}",
            ]
    return [*block[:head], *added, *block[head:]]


def counted(num_envs: int, sensors: str, steps: int) -> dict[str, Any]:
    """Counts in a process of its own, one thread, kernels shaped for a GPU. Raises CalledProcessError."""
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {
            VARIABLE: "gpu",
            "UUV_NATIVE_CACHE": folder,
            "UUV_NUM_THREADS": "1",
            "UUV_COMPILERS": "1",
            "PYTHONPATH": str(ROOT),
        }
        command = [sys.executable, "-m", __name__, str(num_envs), sensors, str(steps)]
        done = subprocess.run(
            command,
            env=environment,
            cwd=ROOT,
            stdout=subprocess.PIPE,
            text=True,
            check=True,
            timeout=_LONGEST_S,
        )
    return json.loads(done.stdout.splitlines()[-1])


def step_seconds(gpu: Gpu, counts: dict[str, Any], num_envs: int) -> float:
    """MODEL of the time of a step with the resets that fall into it [s].

    Every kernel takes the longest of: its instructions, its accesses, and the work of one of its threads.
    """
    issue = gpu.processors * 128 * gpu.clock_hz * _ISSUE_SHARE
    total = _WAITS * _WAIT_S
    passes = ((counts["step"], 1.0 / counts["steps"]), (counts["reset"], 1.0 / _EPISODE_STEPS))
    for name, count, share in ((n, c, share) for made, share in passes for n, c in made.items()):
        scale = num_envs / counts["num_envs"] * share
        instructions, accesses = count["instructions"] * scale, count["accesses"] * scale
        alone = count["of_item"] / _THREADS_PER_ENV.get(name, 1)
        total += max(
            instructions / issue,
            accesses * _SECTOR_BYTES * _MISS_SHARE / _BESIDE.get(name, 1) / gpu.bytes_per_s,
            count["busy_share"] * alone * _CYCLES_ALONE / gpu.clock_hz,
        )
        total += count["launches"] * _LAUNCH_S
    return total


# ------------------------------------------------------------------------------------- the process of its own


def _count(num_envs: int, sensors: str, steps: int) -> dict[str, Any]:
    import torch

    from uuvtai.loader import load_config
    from uuvtai.native import launch, machine, making
    from uuvtai.sim import Sim
    from uuvtai.tree import read_tree

    counts = (ctypes.c_int64 * 2)()
    found: dict[str, list[tuple[int, int]]] = {}
    parts: dict[str, int] = {}
    plain_object, plain_tasks, plain_launch, plain_again = (
        machine.Machine.object_of,
        machine.Machine.tasks_of,
        making.Native._launch,
        launch.NativeLaunch.again,
    )

    def object_of(self: Any, text: str) -> bytes:
        return plain_object(self, text if "@uuv_launch" in text else instrumented(text))

    def tasks_of(self: Any, code: bytes, names: list[str]) -> list[int]:
        self.symbols[SYMBOL] = ctypes.addressof(counts)
        return plain_tasks(self, code, names)

    def launched(self: Any, code: Any, kernel: Any, arguments: tuple, owner: Any) -> Any:
        made = plain_launch(self, code, kernel, arguments, owner)
        made.name = kernel.func.__name__
        parts[made.name] = len(code.tasks)
        return made

    def again(self: Any) -> None:
        before = tuple(counts)
        plain_again(self)
        made = found.setdefault(self.name, [])
        made.append((counts[0] - before[0], counts[1] - before[1]))

    machine.Machine.object_of = object_of  # type: ignore[method-assign]
    machine.Machine.tasks_of = tasks_of  # type: ignore[method-assign]
    making.Native._launch, launch.NativeLaunch.again = launched, again  # type: ignore[method-assign]
    sim = Sim(load_config("pool", sensors), num_envs, read_tree("bt"))
    ones = torch.ones(num_envs, dtype=torch.int32)
    numbers = torch.arange(num_envs, dtype=torch.int32)
    sim.observe()
    for _ in range(2):  # compiling launches each kernel twice
        found.clear()
        sim.reset(ones, 77001 * ones, numbers)
    if not found:
        raise RuntimeError("no kernel was launched by machine code of its own: nothing is counted")
    reset = {name: _summed(made, num_envs, parts[name]) for name, made in found.items()}
    sim.step()
    found.clear()
    plans = 0
    for _ in range(steps):
        sim.step()
        plans += int(sim.s.route.n_queue[None])
    kernels = {
        name: _summed(made, plans / max(steps, 1) if name == "plan_routes" else num_envs, parts[name])
        for name, made in found.items()
    }
    return {"num_envs": num_envs, "steps": steps, "plans": plans, "step": kernels, "reset": reset}


def _summed(made: list[tuple[int, int]], items: float, parts: int) -> dict[str, float]:
    """Counts of all launches of a kernel in so many ``parts``; ``of_item``: instructions of an item in a
    launch that is busy."""
    most = max(instructions for instructions, _ in made)
    busy = [instructions for instructions, _ in made if instructions > 0.2 * most]
    return {
        "instructions": sum(instructions for instructions, _ in made),
        "accesses": sum(accesses for _, accesses in made),
        "of_item": sum(busy) / len(busy) / max(items, 1.0),
        "busy_share": len(busy) / len(made),
        "launches": parts,
    }


def main() -> None:
    """See the module."""
    num_envs, sensors, steps = sys.argv[1:]
    print(json.dumps(_count(int(num_envs), sensors, int(steps))))


if __name__ == "__main__":
    main()
