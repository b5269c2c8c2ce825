"""The second process of a start in which everything has to be compiled: ``python -m uuvtai.other_end``, which
``native/companion.py`` begins. The first one compiles a reset and a step in their order, this one from their
end; they meet in the folder of machine code."""

from __future__ import annotations

import os
import sys
import threading
from typing import Any

import numpy as np
import torch

from uuvtai.config import Config
from uuvtai.errors import UserError
from uuvtai.native.launch import compiling, native
from uuvtai.sim import Sim
from uuvtai.tree import read_tree


def main() -> None:
    """Read a recipe, compile its simulator, and end; at once where the other process has ended."""
    pipe = sys.stdin.buffer
    size = int.from_bytes(pipe.read(8), "little")
    if not size:
        return
    config, num_envs = understood(pipe.read(size))
    threading.Thread(target=_end_with, args=(pipe,), daemon=True).start()
    compile_backwards(config, num_envs)


def understood(recipe: bytes) -> tuple[Config, int]:
    """Config and number of envs of what ``Sim`` asks for."""
    num_envs, config = recipe.decode().split("\n", 1)
    return Config.model_validate_json(config), int(num_envs)


def compile_backwards(config: Config, num_envs: int) -> int:
    """Compile the kernels of a reset and a step from the last to the first, each run once on empty arrays;
    how many there are."""
    sim = Sim(config, num_envs, read_tree("bt", config.teacher.max_node))  # kernels know no tree
    calls = calls_of(sim)
    wake(sim)
    for kernel, arguments in reversed(calls):
        with compiling(kernel, arguments):
            native[0].first(kernel, arguments)
    return len(calls)


def wake(sim: Sim) -> None:
    """Have every row work, for a kernel that does nothing compares nothing; but not the rows that fill up a
    size: the tensors that kernels write to have none for them."""
    for clock in (sim.s.clock.awake, sim.s.clock.active):
        rows = clock.to_numpy()
        rows[:] = np.arange(len(rows)) < sim.num_envs
        clock.from_numpy(rows)


def calls_of(sim: Sim) -> list[tuple[Any, tuple]]:
    """Every launch of a reset and a step in the order in which a process comes to them; none is made."""
    recorder = _Recorder()
    kept, native[:] = list(native), [recorder]
    mask, seed, number = (torch.zeros(sim.num_envs, dtype=torch.int32) for _ in range(3))
    try:
        sim.observe()
        sim.reset(mask, seed, number)
        sim.step()
    finally:
        native[:] = kept
    return list(recorder.calls.values())


class _Recorder:
    """In the place of ``Native``: writes down what is to be launched, and does nothing."""

    def __init__(self) -> None:
        self.calls: dict[tuple[int, ...], tuple[Any, tuple]] = {}

    def first(self, kernel: Any, arguments: tuple) -> _Recorder:
        """Nothing to launch."""
        self.calls.setdefault((id(kernel), *map(id, arguments)), (kernel, arguments))
        return self

    program: Any = None
    """of no running Taichi: this launch is not repeated"""


def _end_with(pipe: Any) -> None:
    pipe.read()
    os._exit(0)


if __name__ == "__main__":
    try:
        main()
    except (UserError, MemoryError, RuntimeError):
        sys.exit(1)  # the other process says what is wrong
