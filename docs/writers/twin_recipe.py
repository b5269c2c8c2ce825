"""Train in the twin with each switch of the recipe: ``python -m docs.writers.twin_recipe RUNS``.

Each run is one ``uuv train twin`` in a process of its own, in a folder ``RUNS/ARM.SEED``; a second start
trains what is missing. ``docs/data/twin_recipe.json`` holds what each run reached in the twin, on the same
scenarios, which none learnt from; ``--later`` trains the switches that came with the twin's new tracks, and a
base of their own, for ``docs/data/twin_recipe_later.json``. ``docs/learning.md`` shows the tables.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from docs.writers.evaluations import ONE_THREAD, commit_of_package
from docs.writers.figure_sources import ROOT, Sources
from uuvtai.learn.recorder import read_metrics
from uuvtai.run_folder import hardware, write_atomic
from uuvtai.tables.table import text_table

FILE, LATER_FILE = "docs/data/twin_recipe.json", "docs/data/twin_recipe_later.json"
MEMORY_FILE = "docs/data/twin_memory.json"
"""of a trial whose code was not kept"""
SEEDS = (0, 1, 2)
IMITATED = "--set twin.warm_start_waves=0"
"""by the arm ``tree``, once for all, or not at all"""
BUDGET = f"--set train.iterations=40 {IMITATED}"
"""2.6 million decisions"""
FREE = "--set twin.anchor=0"
TREE = "tree"
"""arm that imitates the tree and learns nothing more; others begin as its seed 0"""
CELLS = {
    "gauntlet_9_1.5": "gauntlet (8, 9, 1.5)",
    "pool_9_1.5": "pool (8, 9, 1.5)",
    "pool_6_0.6": "pool (8, 6, 0.6)",
}
STUDENT_T = {1: 12.706, 2: 4.303, 3: 3.182, 4: 2.776}
"""97.5 % quantile by degrees of freedom"""


@dataclass(frozen=True)
class Arm:
    """A way to train."""

    name: str
    title: str
    """Markdown"""
    options: str
    """of ``uuv train twin``"""
    seeds: tuple[int, ...] = SEEDS


_START = f"--set twin.start={{runs}}/{TREE}.0"
ARMS = (
    Arm(
        TREE,
        "imitation of the tree alone",
        f"--set twin.warm_start_waves=12 {FREE} --set ppo.learning_rate=1e-9 --set train.iterations=1 "
        "--set train.evaluate_every=1",
        (0,),
    ),
    Arm("base", "every switch off", f"{BUDGET} {FREE}"),
    Arm("failure", "`failure_starts=0.25`", f"{BUDGET} {FREE} --set twin.failure_starts=0.25"),
    Arm("warm", "`start`", f"{BUDGET} {FREE} {_START}"),
    Arm(
        "anchored",
        "`start`, `anchor=0.3`, `anchor_until=0.5`",
        f"{BUDGET} {_START} --set twin.anchor=0.3 --set twin.anchor_until=0.5",
    ),
)
LATER = (
    Arm("base", "every switch off", f"{BUDGET} {FREE}"),
    Arm("curriculum", "`curriculum_until=0.5`", f"{BUDGET} {FREE} --set twin.curriculum_until=0.5"),
    Arm("blind", "`critic_sees_truth=false`", f"{BUDGET} {FREE} --set twin.critic_sees_truth=false"),
)
MEMORY = (
    Arm("base", "without a memory", ""),
    Arm("memory", "with a memory (64 gated recurrent units)", ""),
)


def entry_of(arm: Arm, seed: int, rows: list[dict[str, Any]]) -> dict[str, Any] | None:
    """What is kept of a run's metrics; None while its last iteration is not evaluated."""
    if not rows or "eval/success_rate" not in rows[-1]:
        return None
    last, prefix = rows[-1], "eval/success_"
    found = {name.removeprefix(prefix): value for name, value in last.items() if name.startswith(prefix)}
    return {
        "arm": arm.name,
        "seed": seed,
        "command": f"uuv train twin --seed {seed} {arm.options.format(runs='RUNS')}",
        "decisions": last["time/env_steps"],
        "seconds": round(sum(row["time/simulate_s"] + row["time/learn_s"] for row in rows)),
        "warm_start": {n: v for n, v in rows[0].items() if n.startswith("warm_start/")},
        "std": last["train/std"],
        "success": {"all": found.pop("rate"), **found},
    }


def train(arm: Arm, seed: int, runs: Path) -> None:
    """One training."""
    options = arm.options.format(runs=runs).split()
    place = runs / f"{arm.name}.{seed}"
    command = ["train", "twin", "--seed", str(seed), *options, "--run-dir", str(place)]
    subprocess.run([sys.executable, "-m", "uuvtai", *command], env=os.environ | ONE_THREAD, check=True)


def twin_recipe(sources: Sources) -> str:
    """Success in the twin with each switch: mean and range over the seeds, and the difference from ``base``,
    seed by seed, with Student's 95 % interval."""
    return _table(sources, FILE, ARMS)


def twin_recipe_later(sources: Sources) -> str:
    """As ``twin_recipe``, of the switches that came with the twin's new tracks."""
    return _table(sources, LATER_FILE, LATER)


def twin_memory(sources: Sources) -> str:
    """As ``twin_recipe``, of policies with and without a memory."""
    return _table(sources, MEMORY_FILE, MEMORY)


def _table(sources: Sources, file: str, arms: tuple[Arm, ...]) -> str:
    found = sources.json(file)["rows"]
    base = _by_seed(found, "base")
    rows = []
    for arm in arms:
        own = _by_seed(found, arm.name)
        if own:
            rows.append(
                [arm.title, str(len(own)), *_cells(own), *_gain(own, base if arm.name != "base" else {})]
            )
    head = ["training", "runs", *CELLS.values(), "all six", "all six: gain", "fast gauntlet: gain"]
    return text_table(head, rows)


def _by_seed(found: list[dict[str, Any]], arm: str) -> dict[int, dict[str, float]]:
    return {row["seed"]: row["success"] for row in found if row["arm"] == arm}


def _cells(own: dict[int, dict[str, float]]) -> list[str]:
    out = []
    for cell in (*CELLS, "all"):
        values = sorted(100 * success[cell] for success in own.values())
        spread = f" ({values[0]:.1f} .. {values[-1]:.1f})" if len(values) > 1 else ""
        out.append(f"{statistics.mean(values):.1f}{spread} %")
    return out


def _gain(own: dict[int, dict[str, float]], base: dict[int, dict[str, float]]) -> list[str]:
    shared = sorted(own.keys() & base.keys())
    if len(shared) < 2:
        return ["", ""]
    return [
        gain_of([100 * (own[seed][cell] - base[seed][cell]) for seed in shared])
        for cell in ("all", "gauntlet_9_1.5")
    ]


def gain_of(values: list[float]) -> str:
    """Mean of differences [points] with its interval."""
    middle, se = statistics.mean(values), statistics.stdev(values) / math.sqrt(len(values))
    half = STUDENT_T[len(values) - 1] * se
    return f"{middle:+.1f} [{middle - half:+.1f}, {middle + half:+.1f}]"


def main() -> None:
    """Train what is missing and write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--read", action="store_true", help="train nothing: write what is there")
    parser.add_argument("--later", action="store_true", help="the later switches and their base")
    parser.add_argument("--commit", help="of the package that trained, where it is not this one")
    chosen = parser.parse_args()
    runs: Path = chosen.runs
    commit = chosen.commit or commit_of_package()
    document: dict[str, Any] = {"schema": 1, "commit": commit, "machine": hardware(), "rows": []}
    for arm in LATER if chosen.later else ARMS:
        for seed in arm.seeds:
            place = runs / f"{arm.name}.{seed}"
            if not place.exists() and not chosen.read:
                train(arm, seed, runs)
            entry = entry_of(arm, seed, read_metrics(place)) if place.exists() else None
            if entry:
                document["rows"].append(entry)
                file = ROOT / (LATER_FILE if chosen.later else FILE)
                write_atomic(file, (json.dumps(document, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
