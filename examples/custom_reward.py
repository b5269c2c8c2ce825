"""Other reward weights: what every term pays for the same driving, before and after: a table.

``python examples/custom_reward.py``
"""

from __future__ import annotations

import torch

import uuvtai
from uuvtai import VectorEnv

CAREFUL = {"reward.clearance": 0.5, "reward.ttc": 0.5, "reward.effort": 0.02, "reward.success": 10.0}
"""Nearness costs five times, effort four times as much; arriving pays half. `uuv presets show pool` lists
every weight."""


def terms(env: VectorEnv, steps: int) -> torch.Tensor:
    """Mean sum of every weighted term over so many steps that the behaviour tree drives, (number of
    terms,)."""
    _obs, info = env.reset(seed=0)
    total = torch.zeros(len(env.reward_terms))
    for _ in range(steps):
        *_rest, info = env.step(info["teacher_action"].clone())
        total += info["reward_terms"].mean(dim=0).cpu()
    return total


def table(columns: dict[str, torch.Tensor], names: tuple[str, ...]) -> str:
    """One row per term, and their sum: the reward."""
    lines = [f"{'term':16}" + "".join(f"{name:>10}" for name in columns)]
    lines += [
        f"{name:16}" + "".join(f"{float(sums[i]):10.2f}" for sums in columns.values())
        for i, name in enumerate(names)
    ]
    return "\n".join(
        [*lines, f"{'reward':16}" + "".join(f"{float(sums.sum()):10.2f}" for sums in columns.values())]
    )


def main(steps: int = 1000) -> str:
    """The table of 16 vehicles over 20 s."""
    columns = {}
    for name, overrides in (("default", {}), ("careful", CAREFUL)):
        with uuvtai.make("pool", num_envs=16, overrides=overrides) as env:
            columns[name], names = terms(env, steps), env.reward_terms
    return table(columns, names)


if __name__ == "__main__":
    print(main())
