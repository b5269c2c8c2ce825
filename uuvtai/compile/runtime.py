"""Start Taichi once per process, and a second process that compiles beside it. Only this module calls
``ti.init``."""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import taichi as ti
from taichi.lang import impl
from taichi.lang.impl import default_cfg

from uuvtai.common.errors import DeviceError, SettingError
from uuvtai.compile.first_import import adapt_quadrants

# ------------------------------------------------------------------------------------------------------------
# Taichi's cache of compiled kernels: how large it may grow, and locks that nobody holds any more.


_LOCKED_S = 60.0
"""Taichi locks its cache by a file, for as long as it reads or writes there: one older than this belongs to a
process that was killed"""

CACHE_BYTES = 1 << 30
"""Taichi's own limit, 100 MB, is about twelve sizes of simulator (6 to 9 MB each): a sweep and a training
push each other's kernels out"""


def cache_folder() -> Path:
    """Where Taichi keeps compiled kernels."""
    return Path(os.environ.get("TI_OFFLINE_CACHE_FILE_PATH") or default_cfg().offline_cache_file_path)


def stale_locks() -> list[Path]:
    """Locks of the kernel cache that nobody holds any more: with one of them every process compiles
    everything again."""
    return [lock for lock in cache_folder().rglob("*.lock") if time.time() - lock.stat().st_mtime > _LOCKED_S]


# ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Runtime:
    """How Taichi was started."""

    device: str
    """'cpu' or 'cuda'"""
    precision: str
    """'f32' or 'f64': dtype of continuous quantities"""

    @property
    def real(self):
        """Taichi dtype of continuous quantities."""
        return ti.f64 if self.precision == "f64" else ti.f32


_started: list[Runtime] = []

_MAX_THREADS = 1024

LOOP_PARTS = 16
"""threads that loops are cut for, however many there are: one code, and one entry in the kernel cache, for
all"""


def start_taichi(device: str = "cpu", precision: str = "f32") -> Runtime:
    """Start Taichi on ``device`` ('auto', 'cpu' or 'cuda'), or return the runtime that is already up.

    A second ``ti.init`` would destroy every field, so a process has one runtime; asking for another kind is
    an error. ``UUV_NUM_THREADS`` bounds the CPU threads. Raises DeviceError where the device is missing,
    SettingError for others.
    """
    wanted = Runtime(_resolved(device), precision)
    if _started:
        if _started[0] != wanted:
            raise RuntimeError(f"Taichi already runs as {_started[0]}; start a new process for {wanted}")
        return wanted
    # another process was faster, or may do so in our place: ``uuv doctor`` tells
    with contextlib.suppress(OSError):
        for lock in stale_locks():
            lock.unlink()
    options: dict[str, Any] = {"offline_cache_max_size_of_files": CACHE_BYTES}
    if ti.__name__ == "quadrants":
        adapt_quadrants()
        options = {}
    if threads := os.environ.get("UUV_NUM_THREADS"):
        options["cpu_max_num_threads"] = _thread_count(threads)
    print("starting; kernels of sizes not used before are compiled, about half a minute", file=sys.stderr)
    with contextlib.redirect_stdout(io.StringIO()):  # Taichi greets on stdout, which belongs to results
        ti.init(
            arch=ti.cuda if wanted.device == "cuda" else ti.cpu,
            default_fp=wanted.real,
            fast_math=False,
            offline_cache=True,
            cache_loop_invariant_global_vars=False,  # wrong where two indices are of one element
            cfg_optimization=False,  # LLVM does that work again: half of the time to compile, equal results;
            # and on CUDA Taichi 1.7.4 falls over what that pass leaves of ``tick_tree``
            log_level=ti.WARN,
            **options,
        )
    arch = impl.current_cfg().arch
    if wanted.device == "cuda" and arch != ti.cuda:  # our tensors would lie where its kernels cannot reach
        ti.reset()
        raise DeviceError(
            f"--device {device}: torch sees a CUDA device, but Taichi cannot use it and fell back to "
            f"{str(arch).rpartition('.')[2]}; use --device cpu, or mend the driver"
        )
    if wanted.device == "cpu":  # its pool has its threads by now, and takes no more than it has
        program: Any = impl.get_runtime().prog
        program.config().cpu_max_num_threads = LOOP_PARTS
    _started.append(wanted)
    return wanted


def _thread_count(text: str) -> int:
    """Number of threads that ``UUV_NUM_THREADS`` asks for. Raises SettingError."""
    try:
        count = int(text)
    except ValueError:
        count = 0
    if not 1 <= count <= _MAX_THREADS:
        raise SettingError(
            f"UUV_NUM_THREADS={text!r}: must be a whole number of CPU threads from 1 to {_MAX_THREADS}; "
            "unset it to use all"
        )
    return count


def _resolved(device: str) -> str:
    if device == "cpu":
        return "cpu"
    import torch

    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if device == "cuda":
        if not torch.cuda.is_available():
            raise DeviceError("--device cuda: torch sees no CUDA device here; use --device cpu")
        return "cuda"
    raise SettingError(f"unknown device {device!r}: use auto, cpu or cuda")


# ------------------------------------------------------------------------------------------------------------
# A second process that compiles the same simulator's kernels from the other end, so that two cores are of
# use.


PROGRAM = "uuvtai.envs.warm_up"
"""module that the process runs; it is not imported here, for it needs the simulator"""


class Companion:
    """At most one process at a time. It reads from a pipe and ends when that is closed: it never outlives
    whoever asked for it."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._asked: set[bytes] = set()

    def ask(self, recipe: bytes) -> None:
        """Have the simulator of this recipe compiled from its last kernel on, unless that was asked for
        before, another one is being compiled, or one core is all there is. Quiet where it cannot be had: it
        saves time and nothing else."""
        if recipe in self._asked or self.is_busy() or compilers() < 2:
            return
        self._asked.add(recipe)
        self.close()
        with contextlib.suppress(OSError):
            self._process = subprocess.Popen(
                [sys.executable, "-m", PROGRAM],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env={**os.environ, "UUV_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
                start_new_session=True,  # Ctrl+C is for whoever asked
            )
            pipe = self._process.stdin
            if pipe:
                pipe.write(len(recipe).to_bytes(8, "little") + recipe)
                pipe.flush()

    def is_busy(self) -> bool:
        """Whether it is still compiling."""
        return self._process is not None and self._process.poll() is None

    def close(self) -> None:
        """End it; what it has compiled stays."""
        if self._process is None:
            return
        self._process.kill()
        with contextlib.suppress(OSError):
            if self._process.stdin:
                self._process.stdin.close()
        self._process.wait()
        self._process = None


def compilers() -> int:
    """Processes that may compile side by side: ``UUV_COMPILERS``, else 2 where there are two threads."""
    chosen = os.environ.get("UUV_COMPILERS", "")
    if chosen.isdecimal():
        return int(chosen)
    threads = os.environ.get("UUV_NUM_THREADS", "")
    return min(2, int(threads) if threads.isdecimal() else len(os.sched_getaffinity(0)))
