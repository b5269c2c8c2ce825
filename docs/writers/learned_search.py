"""Keep what the trials of ``uuv train best`` did: ``python -m docs.writers.learned_search RUN...``.

``docs/data/learned_search.json`` holds the share of arrivals and the mean length of every iteration's trials,
and the numbers found; ``docs/learning.md`` shows the tables.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from docs.writers.evaluations import commit_of_package
from docs.writers.figure_sources import ROOT, Sources
from uuvtai.learn.recorder import read_metrics
from uuvtai.loader import load_resolved
from uuvtai.run_folder import hardware, write_atomic
from uuvtai.tables.table import text_table
from uuvtai.tuned_numbers import TUNED

FILE = "docs/data/learned_search.json"
SECTIONS = ("slow", "fast")
PARTS = 4
"""of a run, that the table shows one after the other"""


def run_of(folder: Path) -> dict[str, Any]:
    """What is kept of a run folder."""
    config = load_resolved(folder / "config.yaml")
    scenes = config.tuner.scenes
    dt = config.episode.control_dt_s
    metrics = read_metrics(folder)
    return {
        "seed": config.train.seed,
        "trials": config.train.num_envs,
        "spread": config.tuner.spread,
        "slow_time_cost": config.tuner.slow_time_cost,
        "scenes": [list(scene) for scene in scenes],
        "began_at": {name: _factors(getattr(config, name)) for name in SECTIONS},
        "iterations": [
            {
                "scene": number % len(scenes),
                "arrived": row["rollout/success_rate"],
                "seconds": round(row["rollout/ep_len_mean"] * dt, 3),
                "learn_s": round(row["time/simulate_s"] + row["time/learn_s"], 1),
            }
            for number, row in enumerate(metrics)
        ],
        "found": {
            name: {n.name: round(metrics[-1][f"{name}/{n.name}"], 4) for n in TUNED} for name in SECTIONS
        },
    }


def _factors(section: Any) -> dict[str, float]:
    return {number.name: getattr(section, number.name) for number in TUNED}


def learned_curve(sources: Sources) -> str:
    """Arrivals and mean length of the searches' trials, by quarters of the search."""
    rows = []
    for nth, run in enumerate(sources.json(FILE)["runs"]):
        names = [tuple(scene) for scene in run["scenes"]]
        for scene in dict.fromkeys(names):
            world, s, d, v = scene
            cells = []
            for part in range(PARTS):
                first, last = (len(run["iterations"]) * k // PARTS for k in (part, part + 1))
                here = [row for row in run["iterations"][first:last] if names[row["scene"]] == scene]
                arrived, seconds = (
                    sum(row[key] for row in here) / len(here) for key in ("arrived", "seconds")
                )
                cells.append(f"{100 * arrived:.1f} %, {seconds:.1f} s")
            rows.append([str(nth + 1), f"{world} ({s}, {d}, {v:g})", *cells])
    return text_table(["search", "world (S, D, v in m/s)", "first quarter", "second", "third", "last"], rows)


def learned_numbers(sources: Sources) -> str:
    """The numbers that were found: factors, and what they make of the config's numbers."""
    from uuvtai.loader import load_config, with_stack

    teacher, ours = load_config("pool").teacher, with_stack(load_config("pool"), "best")
    rows = []
    for number in TUNED:
        usual = getattr(teacher, number.name)
        found = [getattr(getattr(ours, section), number.name) for section in SECTIONS]
        rows.append(
            [
                f"`{number.name}`",
                f"{usual:g}",
                *(f"{usual * factor:.3g} (x {factor:.2f})" for factor in found),
                f"x {number.least:g} .. {number.most:g}",
            ]
        )
    return text_table(["number of `teacher`", "usual", "slow bodies", "fast bodies", "tried"], rows)


def main() -> None:
    """Write the file anew."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("runs", nargs="+", type=Path, help="run folders, in the order of the table")
    chosen = parser.parse_args()
    document = {
        "schema": 1,
        "commit": commit_of_package(),
        "machine": hardware(),
        "runs": [run_of(folder) for folder in chosen.runs],
    }
    write_atomic(ROOT / FILE, (json.dumps(document, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
