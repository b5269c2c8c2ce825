"""``ptxas``: machine code of a GPU from PTX, and what it says of registers, spills and shared memory."""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

PACKAGE = "nvidia-cuda-nvcc"
_LONGEST_S = 300
_ENTRY = re.compile(r"Compiling entry function '(\S+)'")
_FRAME = re.compile(r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads")
_USED = re.compile(r"Used (\d+) registers(?:.*?(\d+) bytes cumulative stack size)?")


@dataclass
class Assembled:
    """An entry (a part of a kernel that is launched for itself) as assembled for one architecture."""

    module: str
    """number of its PTX module"""
    entry: str
    registers: int = 0
    """of a thread"""
    stack: int = 0
    """[bytes] of a thread: local arrays, and what is spilled"""
    spilled: int = 0
    """[bytes] the larger one of what is stored and loaded because there are too few registers"""

    @property
    def kernel(self) -> str:
        """Name of the kernel in our sources."""
        return kernel_of(self.entry)


class PtxasError(RuntimeError):
    """``ptxas`` refuses what Taichi wrote: its words."""


def kernel_of(entry: str) -> str:
    """Name of the kernel in our sources that an entry is a part of."""
    return re.sub(r"_c\d+_\d+(_kernel_\d+.*)?$", "", entry)


def find_ptxas() -> Path | None:
    """``ptxas`` of the package from PyPI, or else of an installed CUDA; None where there is none."""
    found = importlib.util.find_spec("nvidia")
    for folder in found.submodule_search_locations or () if found else ():
        for path in sorted(Path(folder).glob("*/bin/ptxas")):  # cu13 before an older cuda_nvcc
            return path
    installed = shutil.which("ptxas")
    return Path(installed) if installed else None


def assemble(ptxas: Path, modules: Sequence[Path], architecture: str, jobs: int = 1) -> list[Assembled]:
    """Every entry of these PTX modules for an architecture such as 'sm_90'. Raises PtxasError."""
    with ThreadPoolExecutor(jobs) as pool:
        found = pool.map(lambda module: _assembled(ptxas, module, architecture), modules)
        return [entry for entries in found for entry in entries]


def _assembled(ptxas: Path, module: Path, architecture: str) -> list[Assembled]:
    target = module.with_suffix(f".{architecture}.cubin")
    command = [str(ptxas), "-v", f"-arch={architecture}", "-O3", "-o", str(target), str(module)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=_LONGEST_S)
    if done.returncode:
        raise PtxasError(f"{' '.join(command)}: {(done.stdout + done.stderr).strip()[:2000]}")
    target.unlink()
    return list(_said(module.stem, done.stdout + done.stderr))


def _said(module: str, text: str) -> Iterator[Assembled]:
    """Entries that ``ptxas -v`` tells of."""
    entry = None
    for line in text.splitlines():
        if named := _ENTRY.search(line):
            if entry:
                yield entry
            entry = Assembled(module, named[1])
        elif entry and (frame := _FRAME.search(line)):
            entry.stack = max(entry.stack, int(frame[1]))
            entry.spilled = max(entry.spilled, int(frame[2]), int(frame[3]))
        elif entry and (used := _USED.search(line)):
            entry.registers = int(used[1])
            entry.stack = max(entry.stack, int(used[2] or 0))
    if entry:
        yield entry


def doubles_in(module: Path) -> int:
    """How many instructions of a PTX module work on 64-bit floating point."""
    return len(re.findall(r"^\s*(?:@%p\d+\s+)?[a-z][\w.]*\.f64\b", module.read_text(), re.M))
