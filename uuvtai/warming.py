"""Compile beforehand what commands will need: several shapes of simulator side by side."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from uuvtai.scene_options import SceneOptions
from uuvtai.workers import LocalEngine

_STEPS = 6
"""one depth image and one decision of the tree are among them"""


@dataclass(frozen=True)
class Shape:
    """A simulator that is to be ready."""

    scene: SceneOptions
    num_envs: int


def shapes_of(scenes: Sequence[SceneOptions], sizes: Sequence[int]) -> list[Shape]:
    """Every scene in every size. ConfigError, and ValueError or MemoryError for sizes that cannot work."""
    from uuvtai.sizes import check_size

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
    """Play a few steps of a shape in this process, so that all its kernels are compiled and kept."""
    from uuvtai.env import VectorEnv
    from uuvtai.sim import Sim
    from uuvtai.tree import read_tree

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
    from uuvtai.native.launch import native

    return (native[0].made, native[0].found) if native else (0, 0)
