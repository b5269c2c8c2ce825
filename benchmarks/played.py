"""One side of ``before.py``, in a process of its own with one tree's package: plays and answers on stdout.

python played.py bits WORLD SENSORS NUM_ENVS STEPS   sha256 of the steps and of every array, as JSON
python played.py speed WORLD SENSORS NUM_ENVS        for every number read: CPU seconds of so many steps
"""

from __future__ import annotations

import hashlib
import json
import sys
import time
from typing import Any

_SEED = 5


def main() -> None:
    """Play as the command line says."""
    del sys.path[0]  # this folder: its names must not hide others
    what, world, sensors, *numbers = sys.argv[1:]
    if what == "bits":
        print("\n" + json.dumps(bits(world, sensors, *map(int, numbers))))
    else:
        speed(world, sensors, int(numbers[0]))


def bits(world: str, sensors: str, num_envs: int, steps: int) -> dict[str, str]:
    """sha256 of observations, rewards and endings of ``steps`` steps with the tree, and of every array after
    them."""
    import uuvtai

    env = uuvtai.make(world, num_envs, _SEED, sensors=sensors)
    observation, info = env.reset()
    played = hashlib.sha256(observation.numpy().tobytes())
    for _ in range(steps):
        observation, reward, terminated, truncated, info = env.step(info["teacher_action"])
        for tensor in (observation, reward, terminated, truncated):
            played.update(tensor.numpy().tobytes())
    found = {name: hashlib.sha256(array.tobytes()).hexdigest() for name, array in env.capture().items()}
    return {"every step": played.hexdigest(), **found}


def speed(world: str, sensors: str, num_envs: int) -> None:
    """Answer every number of steps with the CPU seconds they took; the first answer: those of the start."""
    import uuvtai

    env = uuvtai.make(world, num_envs, _SEED, sensors=sensors)
    _observation, info = env.reset()
    info = _steps(env, info, 1)
    print(f"ready {time.process_time()}", flush=True)
    for line in sys.stdin:
        begun = time.process_time()
        info = _steps(env, info, int(line))
        print(f"steps {time.process_time() - begun}", flush=True)


def _steps(env: Any, info: dict[str, Any], count: int) -> dict[str, Any]:
    for _ in range(count):
        info = env.step(info["teacher_action"])[4]
    return info


if __name__ == "__main__":
    main()
