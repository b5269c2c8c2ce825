"""One side of ``before.py`` or ``paced.py``, in a process of its own with one tree: plays and
answers on stdout.

python played.py bits WORLD SENSORS NUM_ENVS STEPS   sha256 of the steps and of every array, as JSON
python played.py speed WORLD SENSORS NUM_ENVS        for every number read: CPU seconds of so many steps
python played.py paced WORLD SENSORS NUM_ENVS        for every number read: milliseconds of each of so many
                                                     steps, one begun every 20 ms, as JSON
python played.py all_cores WORLD SENSORS NUM_ENVS    for every number read: seconds of so many steps
python played.py map WORLD SENSORS NUM_ENVS          for every number read: CPU seconds of so many scans drawn
                                                     into the map
python played.py reset WORLD SENSORS NUM_ENVS        for every number read: CPU seconds of so many resets of
                                                     two rows
python played.py bytes WORLD SENSORS NUM_ENVS        memory of the arrays of a vehicle
"""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Callable
from typing import Any

_SEED = 5
_PERIOD_S = 0.02


def main() -> None:
    """Play as the command line says."""
    del sys.path[0]  # this folder: its names must not hide others
    what, world, sensors, *numbers = sys.argv[1:]
    if what == "bits":
        print("\n" + json.dumps(bits(world, sensors, *map(int, numbers))))
    elif what == "bytes":
        from uuvtai.config.loader import load_config
        from uuvtai.sim.setup import memory_bytes

        print(f"\n{memory_bytes(load_config(world, sensors), int(numbers[0])) / int(numbers[0])}")
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
    info = _steps(env, info, 100 if what in ("map", "reset") else 0)
    work = _drawing(env) if what == "map" else _resetting(env) if what == "reset" else None
    print(f"ready {time.process_time()}", flush=True)
    for line in sys.stdin:
        if work:
            print(f"steps {sum(work(turn) for turn in range(int(line)))}", flush=True)
            continue
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


def _drawing(env: Any) -> Callable[[int], float]:
    """Draws the scan that is there into the map, with another error each time; CPU seconds."""
    import numpy as np

    from uuvtai.kernels.perception.mapping import update_map

    s, memory = env.sim.s, env.sim.memory()
    range_m, hit = memory.live(s.scan.range_m), memory.live(s.scan.hit) == 1
    fresh, step, image = (memory.live(field) for field in (s.scan.fresh, s.clock.step, s.image.fresh))
    first = range_m.copy()
    errors = np.random.default_rng(0).normal(0, 0.02, (5, *first.shape)).astype(np.float32) * hit

    def drawn(turn: int) -> float:
        range_m[...], fresh[...], image[...], step[...] = first + errors[turn % 5], 1, 0, step + 3
        begun = time.process_time()
        update_map(env.sim.io.mapping)
        return time.process_time() - begun

    return drawn


def _resetting(env: Any) -> Callable[[int], float]:
    """Begins new episodes in two rows, others each time; CPU seconds."""
    import torch

    n, made = env.num_envs, [0]

    def reset(_turn: int) -> float:
        mask, made[0] = torch.zeros(n, dtype=torch.int32), made[0] + 1
        mask[torch.tensor([37 * made[0] % n, (37 * made[0] + 1) % n])] = 1
        seed, number = torch.zeros_like(mask), torch.arange(n, dtype=torch.int32) + n * (made[0] % 1000)
        begun = time.process_time()
        env.sim.reset(mask, seed, number)
        return time.process_time() - begun

    return reset


def _steps(env: Any, info: dict[str, Any], count: int) -> dict[str, Any]:
    for _ in range(count):
        info = env.step(info["teacher_action"])[4]
    return info


if __name__ == "__main__":
    main()
