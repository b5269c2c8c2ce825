"""Keep what the trials of ``uuv train best`` did: ``python -m docs.writers.learned_search --add RUN...``.

``docs/data/learned_search.json`` holds the share of arrivals and the mean length of every iteration's trials,
and the numbers found; ``docs/learning.md`` shows the tables, and the curves of searches that differ in their
seed alone as ``docs/learned_search.png``.
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
PICTURE = "docs/learned_search.png"
SECTIONS = ("slow", "fast")
PARTS = 4
"""of a run, that the table shows one after the other"""
LATELY = 8
"""iterations in a scene that a point of its curve is the mean of"""


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
            name: {n.name: round(metrics[-1].get(f"{name}/{n.name}", 1.0), 4) for n in TUNED}
            for name in SECTIONS  # the search did not know all of them if it is older than some
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
            cells = []
            for part in range(PARTS):
                first, last = (len(run["iterations"]) * k // PARTS for k in (part, part + 1))
                here = [row for row in run["iterations"][first:last] if names[row["scene"]] == scene]
                arrived, seconds = (
                    sum(row[key] for row in here) / len(here) for key in ("arrived", "seconds")
                )
                cells.append(f"{100 * arrived:.1f} %, {seconds:.1f} s")
            rows.append([str(nth + 1), scene_title(list(scene)), *cells])
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


def from_nothing(runs: list[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Searches that began at the tree's own numbers, by their scenes; those of one key differ in their seed
    alone. A key names the scenes, parted by "; "."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for run in runs:
        if all(factor == 1 for section in run["began_at"].values() for factor in section.values()):
            key = "; ".join(dict.fromkeys(scene_title(scene) for scene in run["scenes"]))
            groups.setdefault(key, []).append(run)
    return groups


def scene_title(scene: list[Any]) -> str:
    """A scene as the tables have it."""
    world, s, d, v = scene
    return f"{world} ({s}, {d}, {v:g})"


def curve(run: dict[str, Any], title: str) -> tuple[list[int], list[float], list[float]]:
    """Trials played, and the arrivals [%] and length [s] of the last ``LATELY`` iterations in that scene."""
    here = [n for n, row in enumerate(run["iterations"]) if scene_title(run["scenes"][row["scene"]]) == title]
    windows = [here[max(0, k + 1 - LATELY) : k + 1] for k in range(len(here))]
    arrived, seconds = (
        [sum(run["iterations"][n][key] for n in window) / len(window) for window in windows]
        for key in ("arrived", "seconds")
    )
    return [(n + 1) * run["trials"] for n in here], [100 * share for share in arrived], seconds


def draw(runs: list[dict[str, Any]], out: Path) -> None:
    """Two curves, arrivals and length, for each scene; a line for each seed."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    scenes = [(key, title) for key in from_nothing(runs) for title in key.split("; ")]
    figure, panels = pyplot.subplots(2, len(scenes), figsize=(3.1 * len(scenes), 4.6), sharex="col")
    for (key, title), column in zip(scenes, panels.T, strict=True):
        for run in from_nothing(runs)[key]:
            played, arrived, seconds = curve(run, title)
            for panel, values in zip(column, (arrived, seconds), strict=True):
                panel.plot([n / 1000 for n in played], values, lw=1.2, label=f"seed {run['seed']}")
        column[0].set_title(title, fontsize=9)
        column[1].set_xlabel("trials [thousand]", fontsize=9)
        for panel in column:
            panel.grid(alpha=0.25)
            panel.tick_params(labelsize=8)
    panels[0, 0].set_ylabel("arrivals [%]", fontsize=9)
    panels[1, 0].set_ylabel("mean length [s]", fontsize=9)
    panels[0, 0].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(out, format="png", dpi=100, facecolor="white", metadata={"Software": None})
    pyplot.close(figure)


def main() -> None:
    """Write the file anew, or add to it, and draw it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("runs", nargs="*", type=Path, help="run folders, in the order of the table")
    parser.add_argument("--add", action="store_true", help="behind those that the file has")
    chosen = parser.parse_args()
    played = {"commit": commit_of_package(), "machine": hardware()}
    runs = [run_of(folder) for folder in chosen.runs]
    document = {"schema": 1, **played, "runs": runs}
    if chosen.add:
        document = json.loads((ROOT / FILE).read_text(encoding="utf-8"))
        document["runs"] += [run | played for run in runs]
    write_atomic(ROOT / FILE, (json.dumps(document, indent=1) + "\n").encode())
    draw(document["runs"], ROOT / PICTURE)


if __name__ == "__main__":
    main()
