"""Compile beforehand what commands will need: each shape of simulator in a process of its own."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any

from uuvtai.scene_options import SceneOptions

_STEPS = 6
"""one depth image and one decision of the tree are among them"""


@dataclass(frozen=True)
class Shape:
    """A simulator that is to be ready."""

    scene: SceneOptions
    num_envs: int


def warm(
    shapes: Sequence[Shape], workers: int | None = None, told: Callable[[dict[str, Any]], None] | None = None
) -> list[dict[str, Any]]:
    """Compile every shape, ``workers`` at a time (default: one per core, and at least 2 GiB of memory each is
    wise); an entry per shape: world, sensors, num_envs, kernels compiled and found, seconds [s].

    Raises what the shape's config or size raises. What was compiled by then stays.
    """
    workers = min(len(shapes), workers or os.cpu_count() or 1)
    found: dict[Shape, dict[str, Any]] = {}
    with ProcessPoolExecutor(workers, get_context("spawn"), max_tasks_per_child=1) as pool:
        work = {pool.submit(compiled, shape): shape for shape in shapes}
        try:
            for done in as_completed(work):
                found[work[done]] = done.result()
                if told:
                    told(found[work[done]])
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return [found[shape] for shape in shapes]


def compiled(shape: Shape) -> dict[str, Any]:
    """Play a few steps of a shape in this process, so that all its kernels are compiled and kept."""
    from uuvtai.env import VectorEnv
    from uuvtai.native.launch import native
    from uuvtai.sim import Sim
    from uuvtai.tree import read_tree

    begun = time.perf_counter()
    config = shape.scene.config()
    env = VectorEnv(Sim(config, shape.num_envs, read_tree("bt")))
    _obs, info = env.reset()
    for _ in range(_STEPS):
        info = env.step(info["teacher_action"])[-1]
    counts = (native[0].made, native[0].found) if native else (0, 0)
    return {
        "world": shape.scene.world,
        "sensors": shape.scene.sensors,
        "num_envs": shape.num_envs,
        "compiled": counts[0],
        "found": counts[1],
        "seconds": round(time.perf_counter() - begun, 1),
    }
