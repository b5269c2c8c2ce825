"""Train ``quick`` with several seeds, as it is and with a floor under the deviation that falls at the end;
then play what was learnt in the simulator: ``python -m docs.writers.quick_seeds RUNS``.

Each run is one ``uuv train quick`` in a process of its own, in a folder ``RUNS/ARM.SEED``; a second start
trains what is missing. Each best checkpoint by the twin then plays the same episodes in the simulator, and
the tree beside it. ``docs/data/quick_seeds_77801.json`` holds the evaluations in the twin along the
trainings, and the outcome and the time of every episode. ``docs/learning.md`` shows the tables, and the
evaluations along the trainings as ``docs/quick_seeds.png``.
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
from docs.writers.twin_recipe import gain_of
from docs.writers.twin_trials import CELLS, command_of, curve_of, entry_of, played
from uuvtai.run_folder import hardware, write_atomic
from uuvtai.tables.table import text_table

FILE = "docs/data/quick_seeds_77801.json"
PICTURE = "docs/quick_seeds.png"
SEED, EPISODES = "77801", 512
"""a tuning seed"""
TITLE, SCENE, OPTIONS = CELLS[2]
ARMS = {"base": ("as it is", ""), "std": ("`last_std=0.1`", "--set twin.last_std=0.1")}
"""name: (title in the table, options of ``uuv train quick``)"""
SEEDS = {"base": (0, 1, 2), "std": (0, 1, 2)}
"""of each arm"""


def train(arm: str, seed: int, place: Path) -> None:
    """One training."""
    command = ["train", "quick", "--seed", str(seed), *ARMS[arm][1].split(), "--run-dir", str(place)]
    subprocess.run([sys.executable, "-m", "uuvtai", *command], env=os.environ | ONE_THREAD, check=True)


def quick_seeds(sources: Sources) -> str:
    """Success of every run in the twin and in the simulator, and the gain of the second arm, seed by seed."""
    runs = sources.json(FILE)["runs"]
    rows, found = [], {}
    for arm, (title, _options) in ARMS.items():
        own = [run for run in runs if run["arm"] == arm]
        shares = found[arm] = {run["seed"]: _shares(run) for run in own}
        for part in shares.values():
            rows.append([title, *(f"{value:.1f} %" for value in part)])
    both = [
        gain_of([found["std"][seed][i] - found["base"][seed][i] for seed in SEEDS["std"]]) for i in range(2)
    ]
    rows.append(["gain, points", *both])
    return text_table(["training, seed by seed", "twin, best", f"simulator, {EPISODES}"], rows)


def _shares(run: dict[str, Any]) -> tuple[float, float]:
    """[%] the best of the evaluations in the twin, and what came of that checkpoint in the simulator."""
    outcomes = run["played"]["policy"]["outcomes"]
    return (
        100 * max(row[SCENE] for row in run["curve"]),
        100 * outcomes.count("s") / len(outcomes),
    )


def quick_failures(sources: Sources) -> str:
    """How episodes ended in the simulator, of all seeds together, beside the tree."""
    runs = sources.json(FILE)["runs"]
    names = {"bt": [run["played"]["bt"] for run in runs[:1]]}
    names |= {ARMS[arm][0]: [r["played"]["policy"] for r in runs if r["arm"] == arm] for arm in ARMS}
    rows = []
    for name, parts in names.items():
        text = "".join(part["outcomes"] for part in parts)
        times = [
            t for part in parts for t, o in zip(part["times_s"], part["outcomes"], strict=True) if o == "s"
        ]
        ended = [
            f"{100 * text.count(LETTERS[end]) / len(text):.1f} %" for end in ("success", "collision", "ttc")
        ]
        rows.append([name, *ended, f"{statistics.mean(times):.1f} s"])
    return text_table(["driver", "success", "collision", "ttc", "time of a success"], rows)


def draw(runs: list[dict[str, Any]], out: Path) -> None:
    """Success in the twin along every training: a line for each seed, the second arm's dashed."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panel = pyplot.subplots(figsize=(6.2, 3.2))
    for run in runs:
        decisions = [row["decisions"] / 1e6 for row in run["curve"]]
        success = [100 * row[SCENE] for row in run["curve"]]
        title, seed = ARMS[run["arm"]][0].replace("`", ""), run["seed"]
        style = "-" if run["arm"] == "base" else "--"
        panel.plot(decisions, success, style, color=f"C{seed}", lw=1.2, label=f"{title}, seed {seed}")
    panel.set_xlabel("decisions [million]", fontsize=9)
    panel.set_ylabel("success in the twin [%]", fontsize=9)
    panel.grid(alpha=0.25)
    panel.tick_params(labelsize=8)
    panel.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(out, format="png", dpi=100, facecolor="white", metadata={"Software": None})
    pyplot.close(figure)


def main() -> None:
    """Train what is missing, play all of it, write the file and draw it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--commit", help="of the package that trained, where it is not this one")
    chosen = parser.parse_args()
    commit = chosen.commit or commit_of_package()
    document: dict[str, Any] = {
        "schema": 1,
        "seed": SEED,
        "letters": {letter: name for name, letter in LETTERS.items()},
        "commit": commit,
        "machine": hardware(),
        "runs": [],
    }
    for arm in ARMS:
        for seed in SEEDS[arm]:
            place = chosen.runs / f"{arm}.{seed}"
            if not place.exists():
                train(arm, seed, place)
            command = command_of(str(place), OPTIONS, SEED, EPISODES)
            entry = entry_of(TITLE, command, played(command), commit_of_package())
            run = {"arm": arm, "seed": seed, "curve": curve_of(place), "played": entry}
            document["runs"].append(run)
            write_atomic(ROOT / FILE, (json.dumps(document, indent=1) + "\n").encode())
            print(place.name, flush=True)
    draw(document["runs"], ROOT / PICTURE)


if __name__ == "__main__":
    main()
