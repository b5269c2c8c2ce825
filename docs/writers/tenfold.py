"""The paper's methods at ten times its budget: ``python -m docs.writers.tenfold RUNS``.

Each run is one ``uuv train METHOD`` of 380 iterations in a folder ``RUNS/METHOD_SEED``, on one thread; a
second start goes on with what is missing. All of them then play the same episodes.
``docs/data/tenfold_77801.json`` holds the outcome and the time of every episode; ``docs/learning.md`` shows
the tables.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

from docs.writers.evaluations import ONE_THREAD, commit_of_package
from docs.writers.figure_sources import ROOT, Sources
from docs.writers.pieces import LETTERS
from docs.writers.sonar_trials import document_at, play
from docs.writers.twin_recipe import gain_of
from uuvtai.learn.recorder import read_metrics
from uuvtai.learn.run import CONFIG
from uuvtai.measure.reproduce.claims import Share
from uuvtai.run_folder import hardware, write_atomic
from uuvtai.tables.table import text_table

SEED, EPISODES = 77801, 1000
"""a tuning seed"""
FILE = f"docs/data/tenfold_{SEED}.json"
ITERATIONS = 380
"""of 256 envs x 64 steps: 6,225,920 env-steps"""
SEEDS = (0, 1, 2)
METHODS = ("curriculum", "distill_20", "no_risk_scaling", "no_world_model")
CLAIMS = {
    "distill_20": "a curriculum instead of a constant weight of 0.2",
    "no_risk_scaling": "scaling by the world model's uncertainty",
    "no_world_model": "the world model's columns",
}
"""what ``curriculum`` has and the method has not"""


def train(method: str, seed: int, place: Path) -> None:
    """One training, or the rest of it."""
    begun = (place / CONFIG).exists()
    new = [method, "--seed", str(seed), "--set", f"train.iterations={ITERATIONS}", "--run-dir", str(place)]
    command = ["train", "--resume", str(place)] if begun else ["train", *new]
    subprocess.run([sys.executable, "-m", "uuvtai", *command], env=os.environ | ONE_THREAD, check=True)


def _is_over(place: Path) -> bool:
    return (place / CONFIG).exists() and len(read_metrics(place)) == ITERATIONS


def entry_of(method: str, seed: int, commit: str, place: Path) -> dict[str, Any]:
    """What a training came to on the episodes that all of them play."""
    at = ["--world", "pool", "--seeds", str(SEED), "--episodes", str(EPISODES)]
    result = play(["eval", str(place), *at])
    (entry,) = (found for found in result["methods"] if found["name"] != "bt")
    episodes = entry["episodes_detail"]
    return {
        "method": method,
        "seed": seed,
        "trained": f"uuv train {method} --seed {seed} --set train.iterations={ITERATIONS}",
        "played": " ".join(["uuv eval RUN", *at]),
        "commit": commit,
        "machine": hardware(),
        "outcomes": "".join(LETTERS[episode["outcome"]] for episode in episodes),
        "times_s": [episode["time_s"] for episode in episodes],
    }


def tenfold(sources: Sources) -> str:
    """Each method over its seeds."""
    rows = []
    for method in METHODS:
        own = _by_seed(sources, method)
        if not own:
            continue
        ends = "".join(entry["outcomes"] for entry in own.values())
        arrived_s = [
            time
            for entry in own.values()
            for time, end in zip(entry["times_s"], entry["outcomes"], strict=True)
            if end == "s"
        ]
        by_seed = ", ".join(f"{_success(entry):.1f}" for entry in own.values())
        told = [Share(sum(ends.count(end) for end in kinds), len(ends)) for kinds in ("s", "cxo", "t")]
        rows.append([f"`{method}`", by_seed, *map(str, told), f"{statistics.mean(arrived_s):.1f} s"])
    return text_table(
        ["method", "success by seed, %", "success", "collision", "timeout", "time to success"], rows
    )


def tenfold_claims(sources: Sources) -> str:
    """What each part of ``curriculum`` is worth, seed by seed, with Student's interval."""
    base, rows = _by_seed(sources, METHODS[0]), []
    for method, claim in CLAIMS.items():
        other = _by_seed(sources, method)
        shared = sorted(base.keys() & other.keys())
        if len(shared) < 2:
            continue
        gains = [_success(base[seed]) - _success(other[seed]) for seed in shared]
        rows.append([claim, f"`{method}`", ", ".join(f"{gain:+.1f}" for gain in gains), gain_of(gains)])
    head = ["what", "compared with", "points of success, by seed", "mean, 95 % (Student, over seeds)"]
    return text_table(head, rows)


def _success(entry: dict[str, Any]) -> float:
    return 100 * entry["outcomes"].count("s") / len(entry["outcomes"])


def _by_seed(sources: Sources, method: str) -> dict[int, dict[str, Any]]:
    found = [row for row in sources.json(FILE)["rows"] if row["method"] == method]
    return {row["seed"]: row for row in sorted(found, key=lambda row: row["seed"])}


def main() -> None:
    """Train and play what is missing, and write the file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("runs", type=Path)
    parser.add_argument("--read", action="store_true", help="train nothing: play what is there")
    parser.add_argument("--commit", help="of the package that trained, where it is not this one")
    chosen = parser.parse_args()
    path: Path = ROOT / FILE
    document = document_at(path, SEED)
    done = {(row["method"], row["seed"]) for row in document["rows"]}
    commit = chosen.commit or commit_of_package()
    for seed, method in ((seed, method) for seed in SEEDS for method in METHODS):
        place: Path = chosen.runs / f"{method}_{seed}"
        if (method, seed) in done or (chosen.read and not _is_over(place)):
            continue
        if not chosen.read:
            train(method, seed, place)
        document["rows"].append(entry_of(method, seed, commit, place))
        write_atomic(path, (json.dumps(document, indent=1) + "\n").encode())
        print(method, seed, flush=True)


if __name__ == "__main__":
    main()
