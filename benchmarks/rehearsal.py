"""CUDA rehearsed without a GPU: what Taichi writes for it is assembled, and the kernels' shape for a GPU is
run on the CPU.

A stub of the driver has Taichi compile the whole reset and step; ``ptxas`` assembles that for three
generations of GPUs. Nothing here ran on a GPU, and no speed in it is measured: rows that say MODEL are
counted and estimated.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.common import Job, Row
from benchmarks.cuda_stub.assembling import (
    PACKAGE,
    Assembled,
    assemble,
    doubles_in,
    find_ptxas,
    kernel_of,
)
from benchmarks.cuda_stub.counting import GPUS, counted, step_seconds
from benchmarks.cuda_stub.emitting import Emitted, build_stub, emit
from benchmarks.cuda_stub.playing import differing, played_apart

LONGEST_S = 3600
SPILL_LIMIT = 64
"""[bytes] of a thread"""
ARCHITECTURES = {80: ("sm_80",), 90: ("sm_90", "sm_120")}
"""What is assembled of the PTX for a compute capability (times 10): A100; H100 and RTX 50. Taichi 1.7.4 knows
GPUs up to sm_86 and writes for that one where the GPU is newer: the driver assembles it, as ``ptxas`` does
here"""
NARROW = ("plan_routes",)
"""kernels that have fewer threads than envs on purpose: one for each plan that can be under way"""
_ENVS, _FEW_ENVS, _STEPS = 16384, 64, 200
_MODEL_ENVS = (4096, 65536)


def measure(job: Job) -> list[Row]:
    """Rows of assembling, of shape, and of equality."""
    compiler, ptxas = shutil.which("cc") or shutil.which("gcc"), find_ptxas()
    rows: list[Row] = []
    if compiler is None or ptxas is None:
        missing = "a C compiler" if compiler is None else f"ptxas (pip install {PACKAGE})"
        rows.append(Row("PTX of the whole step", None, "entries", floor=1, note=f"not done: needs {missing}"))
    else:
        with tempfile.TemporaryDirectory() as folder:
            build_stub(compiler, Path(folder))
            for sensors in ("paper",) if job.quick else ("paper", "nominal"):
                rows += _assembling(job, sensors, Path(folder), ptxas)
    for sensors in () if job.quick else ("paper", "nominal"):
        job.say(f"{sensors}: both shapes on the CPU")
        rows.append(_equality(sensors, _FEW_ENVS, _STEPS))
        job.say(f"{sensors}: counting instructions")
        rows += model_rows(f"{sensors} sensing", counted(_FEW_ENVS, sensors, _STEPS))
    return rows


def _assembling(job: Job, sensors: str, folder: Path, ptxas: Path) -> list[Row]:
    rows = []
    for capability, architectures in list(ARCHITECTURES.items())[: 1 if job.quick else None]:
        job.say(f"{sensors}, {', '.join(architectures)}")
        out = folder / f"{sensors}_{capability}"
        out.mkdir()
        emitted = emit(folder, out, capability, (_ENVS, "pool", sensors))
        for architecture in architectures:
            entries = assemble(ptxas, emitted.modules, architecture, os.cpu_count() or 1)
            rows += assembled_rows(f"{sensors} sensing, {architecture}", emitted, entries)
    return rows + step_rows(f"{sensors} sensing", emitted, _ENVS)


def assembled_rows(what: str, emitted: Emitted, entries: list[Assembled]) -> list[Row]:
    """What ``ptxas`` said of one architecture."""
    greedy = max(entries, key=lambda entry: entry.registers)
    worst = max(entries, key=lambda entry: entry.spilled)
    deepest = max(entries, key=lambda entry: entry.stack)
    details = {e.entry: {"registers": e.registers, "stack": e.stack, "spilled": e.spilled} for e in entries}
    return [
        Row(
            f"{what}: assembled",
            len(entries),
            "entries",
            note=f"{len(emitted.modules)} modules, no error; up to {greedy.registers} registers "
            f"({greedy.kernel}), stack up to {deepest.stack} bytes ({deepest.kernel})",
            details={"entries": details},
        ),
        Row(
            f"{what}: largest spill",
            worst.spilled,
            "bytes",
            less_is_better=True,
            floor=SPILL_LIMIT,
            note=worst.kernel if worst.spilled else "",
        ),
        Row(
            f"{what}: instructions on 64-bit floats",
            sum(doubles_in(module) for module in emitted.modules),
            "",
            less_is_better=True,
            floor=0,
        ),
    ]


def step_rows(what: str, emitted: Emitted, num_envs: int) -> list[Row]:
    """How a step is launched: launches, waits, and kernels that are too narrow for a GPU."""
    rows, narrow = [], too_narrow(emitted, num_envs)
    for name in ("step", "reset", "step of a VectorEnv"):
        made = emitted.counts[name]
        rows.append(Row(f"{what}: launches of a {name}", len(made["launches"]), ""))
        rows.append(
            Row(
                f"{what}: times that the host waits in a {name}",
                len(made["waits"]),
                "",
                less_is_better=True,
                note=", ".join(sorted(set(made["waits"]))),
            )
        )
    return [
        *rows,
        Row(
            f"{what}: kernels with fewer threads than envs, but for {', '.join(NARROW)}",
            len(narrow),
            "",
            less_is_better=True,
            floor=0,
            note=f"{num_envs} envs{': ' if narrow else ''}{', '.join(narrow)}",
        ),
    ]


def model_rows(what: str, counts: dict[str, Any]) -> list[Row]:
    """MODEL of env-steps per second; no GPU has run this."""
    rows = []
    for gpu in GPUS:
        speeds = {n: n / step_seconds(gpu, counts, n) for n in _MODEL_ENVS}
        rows.append(
            Row(
                f"MODEL, never run: {what}, {gpu.name}, {_MODEL_ENVS[-1]} envs",
                speeds[_MODEL_ENVS[-1]],
                "env-steps/s",
                note="an order of magnitude, from counted instructions and assumed shares; "
                + ", ".join(f"{n} envs: {speed:,.0f}" for n, speed in speeds.items()),
            )
        )
    rows[-1].details["counts"] = counts
    return rows


def too_narrow(emitted: Emitted, num_envs: int) -> list[str]:
    """Kernels of a reset and a step that loop with fewer threads than envs and should not."""
    made = {entry for name in ("step", "reset") for entry in emitted.counts[name]["launches"]}
    threads = {task.entry: task.blocks * task.threads for task in emitted.tasks if task.entry in made}
    found = {
        kernel_of(entry)
        for entry, count in threads.items()
        if count < num_envs and entry.endswith("range_for")
    }
    return sorted(found - set(NARROW))


def _equality(sensors: str, num_envs: int, steps: int) -> Row:
    sides = [played_apart(shape, num_envs, sensors, steps) for shape in ("cpu", "gpu")]
    found = differing(*sides)
    return Row(
        f"{sensors} sensing: arrays that differ between the two shapes on the CPU",
        len(found),
        "",
        less_is_better=True,
        floor=0,
        note=f"of {len(sides[0])}, after {steps} steps of {num_envs} envs with resets "
        f"{', '.join(found[:5])}".strip(),
        details={"differ": found},
    )
