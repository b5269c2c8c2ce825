"""One side of ``before.py`` or ``paced.py``, in a process of its own with one tree: plays and
answers on stdout.

python played.py bits WORLD SENSORS NUM_ENVS STEPS   sha256 of the steps and of every array, as JSON
python played.py speed WORLD SENSORS NUM_ENVS        for every number read: CPU seconds of so many steps
python played.py paced WORLD SENSORS NUM_ENVS        for every number read: milliseconds of each of so many
                                                     steps, one begun every 20 ms, as JSON
python played.py all_cores WORLD SENSORS NUM_ENVS    for every number read: seconds of so many steps
"""

from __future__ import annotations

import hashlib
import json
import sys
import time
from typing import Any

_SEED = 5
_PERIOD_S = 0.02


def main() -> None:
    """Play as the command line says."""
    del sys.path[0]  # this folder: its names must not hide others
    what, world, sensors, *numbers = sys.argv[1:]
    if what == "bits":
        print("\n" + json.dumps(bits(world, sensors, *map(int, numbers))))
    else:
        answer(what, world, sensors, int(numbers[0]))


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


def answer(what: str, world: str, sensors: str, num_envs: int) -> None:
    """Answer every number of steps with what they took; the first answer: CPU seconds of the start."""
    import uuvtai

    env = uuvtai.make(world, num_envs, _SEED, sensors=sensors)
    _observation, info = env.reset()
    info = _steps(env, info, 1)
    print(f"ready {time.process_time()}", flush=True)
    for line in sys.stdin:
        if what == "paced":
            info, taken = _paced(env, info, int(line))
            print("steps " + json.dumps(taken), flush=True)
            continue
        clock = time.process_time if what == "speed" else time.perf_counter
        begun = clock()
        info = _steps(env, info, int(line))
        print(f"steps {clock() - begun}", flush=True)


def _paced(env: Any, info: dict[str, Any], count: int) -> tuple[dict[str, Any], list[float]]:
    """Steps as a control loop makes them: it sleeps until the next is due. Milliseconds of each; those of a
    step that begins another episode are left out, for no vehicle does that."""
    taken, due = [], time.perf_counter()
    for _ in range(count):
        due += _PERIOD_S
        time.sleep(max(0.0, due - time.perf_counter()))
        begun = time.perf_counter()
        _observation, _reward, terminated, truncated, info = env.step(info["teacher_action"])
        if not bool((terminated | truncated).any()):
            taken.append(1e3 * (time.perf_counter() - begun))
    return info, taken


def _steps(env: Any, info: dict[str, Any], count: int) -> dict[str, Any]:
    for _ in range(count):
        info = env.step(info["teacher_action"])[4]
    return info


if __name__ == "__main__":
    main()
