"""Your own controller, a NumPy function from observations to actions, on the same episodes as a blind one: a
table.

``python examples/custom_controller.py`` (pip install 'uuvtai[gym]')
"""

from __future__ import annotations

import numpy as np
from judge import judge

import uuvtai
from uuvtai import Sim, VectorEnv

MAX_HEAVE_M = 0.4
"""height error [m] at which heave is full"""


def careful(obs: np.ndarray, columns: dict[str, slice]) -> np.ndarray:
    """Turns towards the look-ahead point of the route, drives while it is ahead, and stops for what is near
    ahead."""
    sine, cosine = obs[:, columns["heading_error"]].T
    near_m = obs[:, columns["sector_range"]][:, [-1, 0, 1]].min(
        axis=1
    )  # sector 0 is ahead, counter-clockwise from there
    action = np.zeros((len(obs), 4), np.float32)
    action[:, 0] = np.clip(cosine, 0, 1) * np.clip((near_m - 0.5) / 0.7, -0.5, 1)
    action[:, 2] = np.clip(obs[:, columns["lookahead"]][:, 2] / MAX_HEAVE_M, -1, 1)
    action[:, 3] = np.clip(1.5 * np.arctan2(sine, cosine), -1, 1)
    return action


def blind(obs: np.ndarray, columns: dict[str, slice]) -> np.ndarray:
    """Straight to the goal, whatever is in the way."""
    goal = obs[:, columns["goal"]]
    action = np.zeros((len(obs), 4), np.float32)
    action[:, :3] = goal / np.maximum(np.linalg.norm(goal, axis=1, keepdims=True), 1e-6)
    return action


def main(sim: Sim | None = None) -> str:
    """The table: success and return of both."""
    sim = sim or uuvtai.make("pool", num_envs=64).sim
    columns = VectorEnv(sim).columns
    lines = [f"{'controller':10} {'success':>8} {'return':>8}"]
    for controller in (careful, blind):
        returns, won = judge(sim, lambda obs, of=controller: of(obs, columns))
        lines.append(f"{controller.__name__:10} {won:>4}/{len(returns)} {returns.mean():8.1f}")
    return "\n".join(lines)


if __name__ == "__main__":
    print(main())
