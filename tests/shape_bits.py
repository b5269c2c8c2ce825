"""The same episodes by kernels of either shape: what must come out alike to the last bit.

``UUV_KERNELS=gpu python -m tests.shape_bits NUM_ENVS SENSORS STEPS``: prints digests as JSON.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch

from uuvtai.compile.launch import VARIABLE
from uuvtai.config.loader import load_config
from uuvtai.sim.behavior_tree import read_tree
from uuvtai.sim.sim import Sim

ROOT = Path(__file__).resolve().parents[1]
_LONGEST_S = 1200
RESET_STEPS = 25
"""every so many steps one row in four begins another episode"""
OVERRIDES = {"world.dynamic_capacity": 9}
"""those of the tests' small simulator: its kernels are compiled already"""


def play(sim: Sim, steps: int) -> dict[str, str]:
    """SHA-256 of every array but scratch after so many steps of the tree, with resets in between."""
    numbers = torch.arange(sim.num_envs, dtype=torch.int32)
    seeds = torch.full_like(numbers, 77001)
    sim.observe()
    sim.reset(torch.ones_like(numbers), seeds, numbers)
    for step in range(1, steps + 1):
        sim.step()
        due = (numbers % 4 == step // RESET_STEPS % 4) & (step % RESET_STEPS == 0)
        begun = due | (sim.terminated + sim.truncated > 0)
        if bool(begun.any()):
            numbers = numbers + sim.num_envs * begun.to(torch.int32)
            sim.reset(begun.to(torch.int32), seeds, numbers)
    memory = sim.memory()
    arrays = memory.views(memory.read()) | {
        name: getattr(sim, name).numpy() for name in ("observation", "action", "reward")
    }
    return {name: hashlib.sha256(np.ascontiguousarray(a).tobytes()).hexdigest() for name, a in arrays.items()}


def played_apart(shape: str, num_envs: int, sensors: str, steps: int) -> dict[str, str]:
    """``play`` in a process of its own, by kernels of a shape, 'cpu' or 'gpu'."""
    environment = os.environ | {VARIABLE: shape, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", __name__, str(num_envs), sensors, str(steps)]
    done = subprocess.run(
        command, env=environment, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True, timeout=_LONGEST_S
    )
    return json.loads(done.stdout.splitlines()[-1])


def differing(one: dict[str, str], other: dict[str, str]) -> list[str]:
    """Names of the arrays that are not alike, or are missing on one side."""
    return sorted(name for name in one.keys() | other.keys() if one.get(name) != other.get(name))


def main() -> None:
    """See the module."""
    num_envs, sensors, steps = sys.argv[1:]
    sim = Sim(load_config("pool", sensors, overrides=OVERRIDES), int(num_envs), read_tree("bt"))
    print(json.dumps(play(sim, int(steps))))


if __name__ == "__main__":
    main()
