"""Play a policy that learnt in the twin beside the tree, and keep what it said of itself in the twin:
``python -m docs.writers.twin_trials RUN``.

Each scene is one ``uuv eval`` in a process of its own. ``docs/data/twin_77001.json`` holds the outcome and
the time of every episode, by both, and the evaluations in the twin along the training. ``docs/learning.md``
shows the tables.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from docs.writers.evaluations import ONE_THREAD, commit_of_package
from docs.writers.figure_sources import ROOT
from docs.writers.pieces import LETTERS
from uuvtai.learn.recorder import read_metrics
from uuvtai.run_folder import hardware, write_atomic

SEEDS, EPISODES = "77001,77002", 256
"""tuning seeds"""
FILE = "docs/data/twin_77001.json"
CELLS = (
    ("gauntlet (8, 9, 1.5)", "gauntlet_9_1.5", "--world gauntlet -S 8 -D 9 -v 1.5"),
    ("pool (8, 9, 1.5)", "pool_9_1.5", "--world pool -S 8 -D 9 -v 1.5"),
    ("pool (8, 6, 0.6)", "pool_6_0.6", "--world pool -S 8 -D 6 -v 0.6"),
)
MORE = (("maze (8, 6, 0.6)", "", "--world maze -S 8 -D 6 -v 0.6"), ("netpen", "", "--world netpen"))
"""worlds that no training met, for ``--more``"""
"""(title, name in the twin's evaluations, options of ``uuv eval``)"""


def command_of(run: str, options: str, seeds: str = SEEDS, episodes: int = EPISODES) -> list[str]:
    """Arguments of ``uuv`` for one scene."""
    scene = ["--controller", "bt", *options.split()]
    return ["eval", run, *scene, "--seeds", seeds, "--episodes", str(episodes)]


def entry_of(cell: str, command: list[str], result: dict[str, Any], commit: str) -> dict[str, Any]:
    """What is kept of a ``uuv eval --json`` document, the tree first."""
    methods = sorted(result["methods"], key=lambda method: method["name"] != "bt")
    shown = ["RUN" if number == 1 else part for number, part in enumerate(command)]
    return {
        "cell": cell,
        "command": "uuv " + " ".join(shown),
        "commit": commit,
        "machine": hardware(),
        "policy_sha256": methods[1]["checkpoint"]["sha256"],
        "step": methods[1]["checkpoint"]["step"],
        **{
            who: {
                "outcomes": "".join(LETTERS[e["outcome"]] for e in method["episodes_detail"]),
                "times_s": [e["time_s"] for e in method["episodes_detail"]],
            }
            for who, method in zip(("bt", "policy"), methods, strict=True)
        },
        **({"chooser": methods[1]["chooser"]} if "chooser" in methods[1] else {}),
    }


def played(command: list[str]) -> dict[str, Any]:
    """The ``--json`` document of these arguments of ``uuv``, in a process of its own."""
    with tempfile.TemporaryDirectory() as place:
        done = subprocess.run(
            [sys.executable, "-m", "uuvtai", *command, "--json", "--run-dir", f"{place}/run"],
            env=os.environ | ONE_THREAD,
            capture_output=True,
            text=True,
            check=True,
        )
    return json.loads(done.stdout)


def curve_of(run: Path) -> list[dict[str, Any]]:
    """Success in the twin, by scene, along a training; decisions and seconds of the training so far."""
    rows, seconds = [], 0.0
    for row in read_metrics(run):
        seconds += row["time/simulate_s"] + row["time/learn_s"]
        names = [name for _title, name, _options in CELLS if f"eval/success_{name}" in row]
        found = {name: row[f"eval/success_{name}"] for name in names}
        if found:
            rows.append({"decisions": row["time/env_steps"], "seconds": round(seconds), **found})
    return rows


def main() -> None:
    """Play all scenes and write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", default=FILE, help="file of the results, from the root of the tree")
    parser.add_argument("--more", action="store_true", help="also worlds that no training met")
    parser.add_argument("--only", default="", help="scenes whose title begins so")
    parser.add_argument("--options", default="", help="more options of uuv eval, for both")
    parser.add_argument("--seeds", default=SEEDS, help="as uuv eval takes them")
    parser.add_argument("--episodes", type=int, default=EPISODES, help="of each seed")
    chosen = parser.parse_args()
    run = chosen.run
    document: dict[str, Any] = {
        "schema": 1,
        "seeds": chosen.seeds,
        "letters": {letter: name for name, letter in LETTERS.items()},
        "curve": curve_of(run),
        "rows": [],
    }
    cells = [cell for cell in (*CELLS, *(MORE if chosen.more else ())) if cell[0].startswith(chosen.only)]
    for title, _name, options in cells:
        more = chosen.options.split()
        command = [*command_of(str(run), options, chosen.seeds, chosen.episodes), *more]
        result = played(command)
        document["rows"].append(entry_of(title, command, result, commit_of_package()))
        write_atomic(ROOT / chosen.out, (json.dumps(document, indent=1) + "\n").encode())
        print(title, flush=True)


if __name__ == "__main__":
    main()
