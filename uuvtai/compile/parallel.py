"""A second process that compiles the same simulator's kernels from the other end, so that two cores are of
use."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys

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
