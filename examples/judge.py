"""What the training examples share: the same episodes before and after training, a table of what came out,
and the learning curve.

``python examples/train_sb3.py --out runs/sb3`` saves the policy there, reads it back and plays it; ``--play
runs/sb3`` plays it again. ``--curve sb3.csv`` keeps the return of every training episode; ``python
examples/judge.py sb3.csv skrl.csv curves.png`` draws such files.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import uuvtai
from uuvtai import Sim, UuvVectorEnv

HOLD_STEPS = 10
"""control steps per decision: noise drawn anew every 0.02 s would average out before the vehicle has moved"""

TOLD_EVERY_S, NEWEST = 5.0, 100
"""between two lines of progress, which speak of so many episodes"""

Act = Callable[[np.ndarray], np.ndarray]
"""observations (n, n_obs) -> actions (n, 4), without exploration"""


class Watched(UuvVectorEnv):
    """The batch as it is, which also keeps the return of every episode that ends in it, and tells how far it
    is: a line every few seconds."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._decisions, self._return = 0, np.zeros(self.num_envs)
        self.curve: list[tuple[int, float]] = []
        """(decisions of all envs so far, return)"""
        self._begun = self._told = time.perf_counter()
        watched.append(self)

    def step(self, actions: Any) -> Any:
        """``UuvVectorEnv.step``."""
        told = super().step(actions)
        self._decisions += self.num_envs
        self._return += np.asarray(told[1])
        for env in np.flatnonzero(np.asarray(told[2]) | np.asarray(told[3])):
            self.curve.append((self._decisions, float(self._return[env])))
            self._return[env] = 0.0
        now = time.perf_counter()
        if now - self._told > TOLD_EVERY_S and self.curve:
            self._told = now
            newest = [earned for _, earned in self.curve[-NEWEST:]]
            done = f"{self._decisions:,} decisions, {now - self._begun:.0f} s"
            print(f"{done}: mean return of {len(newest)} episodes {np.mean(newest):.1f}", file=sys.stderr)
        return told


watched: list[Watched] = []
"""the newest one is the one that training used"""


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


Train = Callable[[Sim, int, Path | None], Act]
"""(simulator, iterations, where to save) -> the policy"""
Play = Callable[[Sim, Path], Act]
"""(simulator, where it was saved) -> the policy"""


def main(
    train: Train, play: Play, iterations: int, arguments: list[str] | None = None, sim: Sim | None = None
) -> None:
    """From the command line: judge the untrained policy, train and save it, read it back and judge it; or
    only the last.

    ``sim`` is one that is there already, in place of ``--world`` and ``--num-envs``.
    """
    parser = argparse.ArgumentParser()
    parser.add_argument("--world", default="pool")
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--iterations", type=int, default=iterations)
    parser.add_argument("--curve", type=Path, help="CSV file for the return of every training episode")
    parser.add_argument(
        "--out", type=Path, help="new folder for what was learnt [default: runs/TIME_EXAMPLE]"
    )
    parser.add_argument(
        "--play", type=Path, metavar="FOLDER", help="train nothing: play what was saved there"
    )
    given = parser.parse_args(arguments)
    name = Path(sys.argv[0]).stem if train.__module__ == "__main__" else train.__module__
    out = given.play or given.out or Path("runs") / f"{time.strftime('%Y%m%d-%H%M%S')}_{name}"
    if out.exists() and not given.play:
        parser.error(f"--out {out}: is there already; give a new folder, or --play {out}")
    sim = sim or uuvtai.make(given.world, num_envs=given.num_envs).sim
    if not given.play:
        print(f"before {told(sim, train(sim, 0, None))}", flush=True)
        begun = time.perf_counter()
        out.mkdir(parents=True, exist_ok=True)
        train(sim, given.iterations, out)
        print(
            f"{given.iterations} iterations, {time.perf_counter() - begun:.0f} s, saved in {out}", flush=True
        )
    if given.curve and watched:
        with given.curve.open("w", newline="") as file:
            csv.writer(file).writerows([("decisions", "return"), *watched[-1].curve])
    print(f"played {told(sim, play(sim, out))}")


def told(sim: Sim, act: Act) -> str:
    """Mean return and success of one episode per env, with standard error and Wilson's interval (95 %)."""
    returns, won = judge(sim, act)
    n, z = len(returns), 1.96
    error = returns.std(ddof=1) / np.sqrt(n)
    middle = (won + z**2 / 2) / (n + z**2)
    off = z * np.sqrt(won * (n - won) / n + z**2 / 4) / (n + z**2)
    return (
        f"return {returns.mean():6.1f} +- {error:.1f}, success {won}/{n} ({100 * (middle - off):.0f} .. "
        f"{100 * (middle + off):.0f} %)"
    )


def draw(files: list[Path], target: Path) -> None:
    """Mean return of the episodes that end within the same 4096 decisions, with its standard error, one line
    a file."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.4, 3.6), layout="constrained")
    for path in files:
        decisions, returns = np.loadtxt(path, delimiter=",", skiprows=1, unpack=True)
        bins = ((decisions - 1) // 4096).astype(int)
        groups = [returns[bins == i] for i in range(bins.max() + 1)]
        at = np.array([4096 * (i + 1) for i, group in enumerate(groups) if len(group) > 1])
        mean = np.array([group.mean() for group in groups if len(group) > 1])
        error = np.array([group.std(ddof=1) / np.sqrt(len(group)) for group in groups if len(group) > 1])
        axes.plot(at, mean, label=path.stem)
        axes.fill_between(at, mean - error, mean + error, alpha=0.25)
    axes.set(xlabel="decisions (0.2 s each, all envs)", ylabel="return of a training episode")
    axes.legend()
    figure.savefig(target, dpi=110)


if __name__ == "__main__":
    *sources, picture = map(Path, sys.argv[1:])
    draw(sources, picture)
