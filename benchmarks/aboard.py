"""Exported stacks (``uuv export LOG``) decide what was decided at their export: on this machine without
Taichi and torch, and on aarch64. ``UUV_AARCH64`` names a Python of that machine with NumPy, as the words that
start it (for example a user-mode emulator and its interpreter); without it that half is not tried.
``UUV_STACK_FOLDER`` names a folder that was exported before, to be looked at in place of new ones.
"""

from __future__ import annotations

import json
import os
import platform
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.common import Job, Row

THREADS = 1
LONGEST_S = 3600
SEED = 77001
FOREIGN, BEFORE = "UUV_AARCH64", "UUV_STACK_FOLDER"
CASES = (("pool", "multibeam", "6", "0.6"),)
"""world, sensors, moving obstacles, their speed [m/s]"""
_EMPTY = """
import runpy, sys
class Nobody:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("taichi", "torch", "llvmlite", "pydantic", "uuvtai"):
            raise ImportError(name)
sys.meta_path.insert(0, Nobody())
sys.path.insert(0, sys.argv[1])
runpy.run_module("uuv_stack", run_name="__main__")
"""
_ALONE = "import numpy, resource; print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)"


def measure(job: Job) -> list[Row]:
    """A row for each case and machine. RuntimeError where a command fails."""
    rows = []
    with tempfile.TemporaryDirectory() as name:
        before = os.environ.get(BEFORE, "")
        for case in CASES:
            out = Path(before) if before else _exported(case, Path(name))
            told = "a folder exported before" if before else f"{case[0]}, {case[1]} sensing"
            rows.append(_row(f"{platform.machine()}: {told}", [sys.executable, "-I"], out, job))
            if words := shlex.split(os.environ.get(FOREIGN, "")):
                rows.append(_row(f"aarch64: {told}", words, out, job))
    if not os.environ.get(FOREIGN):
        rows.append(Row("aarch64", None, "", note=f"not tried: {FOREIGN} names no interpreter"))
    return rows


def _exported(case: tuple[str, ...], folder: Path) -> Path:
    world, sensors, obstacles, speed = case
    run, out = folder / f"{world}_{sensors}", folder / f"{world}_{sensors}_stack"
    uuv = [sys.executable, "-m", "uuvtai"]
    scene = (
        f"--world {world} --sensors {sensors} --vehicle bluerov2_16v -D {obstacles} --speed {speed}".split()
    )
    count = ["--episodes", "1", "--record", "1", "--seeds", str(SEED)]
    _done([*uuv, "eval", "--agent", "bt", *scene, *count, "--depth-images", "--run-dir", str(run)])
    (log,) = (run / "logs").glob("*.mcap")
    _done([*uuv, "export", str(log), "--out", str(out)])
    return out


def _row(what: str, words: list[str], folder: Path, job: Job) -> Row:
    found: dict[str, Any] = json.loads(_done([*words, "-c", _EMPTY, str(folder)]))
    alone = float(_done([*words, "-c", _ALONE]))
    if found["foreign"]:
        raise RuntimeError(f"the folder has imported {found['foreign']}")
    memory = f"{found['memory_mib']:.0f} MiB, {alone:.0f} of them Python and NumPy"
    note = f"largest difference {found['largest_difference']:.1e}; {memory}"
    job.say(f"{what}: {found['equal']} of {found['steps']}; {note}")
    share = 100.0 * found["equal"] / found["steps"]
    return Row(
        what, share, f"% of {found['steps']} commands equal to the last bit", note=note,
        details={**found, "python_and_numpy_mib": round(alone, 1)},
    )  # fmt: skip


def _done(words: list[str]) -> str:
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=1200)
    if done.returncode not in (0, 3):
        raise RuntimeError(f"{' '.join(words[:6])}: {done.stderr[-500:]}")
    return done.stdout
