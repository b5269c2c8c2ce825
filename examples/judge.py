"""What the training examples share: the same episodes before and after training, and a table of what came out."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

import uuvtai
from uuvtai.gym import UuvVectorEnv
from uuvtai.measure.statistics import wilson_interval
from uuvtai.sim import Sim

HOLD_STEPS = 10
"""control steps per decision: noise drawn anew every 0.02 s would average out before the vehicle has moved"""

Act = Callable[[np.ndarray], np.ndarray]
"""observations (n, n_obs) -> actions (n, 4), without exploration"""


def judge(sim: Sim, act: Act, seed: int = 1000) -> tuple[np.ndarray, int]:
    """Returns of the first episode of every env of ``seed``, and how many of them reached the goal."""
    envs = UuvVectorEnv(sim=sim, hold_steps=HOLD_STEPS, autoreset_mode="NextStep")
    obs, info = envs.reset(seed=seed)
    returns, won = np.zeros(envs.num_envs), np.zeros(envs.num_envs, bool)
    playing = np.ones(envs.num_envs, bool)
    while playing.any():
        obs, reward, terminated, truncated, info = envs.step(act(obs))
        returns += reward * playing
        won |= info["is_success"] & playing
        playing &= ~(terminated | truncated)
    return returns, int(won.sum())


def main(train: Callable[[Sim, int], Act], iterations: int) -> None:
    """Train from the command line; judges before (0 iterations) and after."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--world", default="pool")
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--iterations", type=int, default=iterations)
    given = parser.parse_args()
    sim = uuvtai.make(given.world, num_envs=given.num_envs).sim
    for name, count in (("before", 0), ("after", given.iterations)):
        begun = time.perf_counter()
        act = train(sim, count)
        wall_s = time.perf_counter() - begun
        returns, won = judge(sim, act)
        low, high = wilson_interval(won, len(returns)) or (0.0, 1.0)
        error = returns.std(ddof=1) / np.sqrt(len(returns))
        print(
            f"{name:6} {count:4} iterations, {wall_s:4.0f} s: return {returns.mean():6.1f} +- {error:.1f}, "
            f"success {won}/{len(returns)} ({100 * low:.0f} .. {100 * high:.0f} %)",
            flush=True,
        )
