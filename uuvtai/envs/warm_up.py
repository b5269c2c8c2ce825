"""Compile beforehand what commands will need: several shapes of simulator side by side."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from uuvtai.common.errors import UserError
from uuvtai.common.processes import LocalEngine
from uuvtai.compile.launch import compiling, native
from uuvtai.config import Config
from uuvtai.envs.vector_env import VectorEnv
from uuvtai.sim.behavior_tree import read_tree
from uuvtai.sim.scene import SceneOptions
from uuvtai.sim.setup import check_size
from uuvtai.sim.sim import Sim

_STEPS = 6  # one depth image and one decision of the tree are among them


@dataclass(frozen=True)
class Shape:
    """A simulator that is to be ready."""

    scene: SceneOptions
    num_envs: int


def shapes_of(scenes: Sequence[SceneOptions], sizes: Sequence[int]) -> list[Shape]:
    """Every scene in every size. ConfigError, and ValueError or MemoryError for sizes that cannot work."""
    shapes = [Shape(scene, size) for scene in scenes for size in sizes]
    for shape in shapes:
        check_size(shape.scene.config(), shape.num_envs, "cpu")
    return shapes


def warm(shapes: Sequence[Shape], workers: int | None = None) -> list[dict[str, Any]]:
    """Compile every shape, ``workers`` processes side by side (default: one per core); an entry per shape:
    world, sensors, num_envs, kernels compiled and found, seconds [s].

    Raises what the shape's config or size raises, and EngineError. What was compiled by then stays.
    """
    engine = LocalEngine(min(len(shapes), workers or os.cpu_count() or 1), "run it again")
    found = dict(engine.run(compiled, shapes))
    return [found[number] for number in range(len(shapes))]


def compiled(shape: Shape) -> dict[str, Any]:
    """Run a few steps of a shape in this process, so that all its kernels are compiled and kept."""
    begun, before = time.perf_counter(), _counts()
    config = shape.scene.config()
    env = VectorEnv(Sim(config, shape.num_envs, read_tree("bt")))
    _obs, info = env.reset()
    for _ in range(_STEPS):
        info = env.step(info["teacher_action"])[-1]
    made, found = (now - then for now, then in zip(_counts(), before, strict=True))
    return {
        "world": shape.scene.world,
        "sensors": shape.scene.sensors,
        "num_envs": shape.num_envs,
        "compiled": made,
        "found": found,
        "seconds": round(time.perf_counter() - begun, 1),
    }


def _counts() -> tuple[int, int]:
    """Kernels that this process has made, and found, by machine code of their own."""
    return (native[0].made, native[0].found) if native else (0, 0)


# ---- The second process of a start in which everything has to be compiled: ``python -m
# uuvtai.envs.warm_up``, which ``compile/runtime.py`` begins. The first one compiles a reset and a step in
# their order, this one from their end; they meet in the folder of machine code.


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
    sim = Sim(config, num_envs, read_tree("bt"))  # kernels know no tree
    calls = calls_of(sim)
    wake(sim)
    for kernel, arguments in reversed(calls):
        with compiling(kernel, arguments):
            native[0].first(kernel, arguments)
    return len(calls)


def wake(sim: Sim) -> None:
    """Have every row work, for a kernel that does nothing compares nothing; but not the rows that fill up a
    size: the tensors that kernels write to have none for them."""
    for clock in (sim.s.clock.active, sim.s.clock.running):
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
