"""Play the tree with each kind of sonar, on the same episodes: ``python -m docs.writers.sonar_trials``.

Each row is one ``uuv eval`` in a process of its own. ``docs/data/sonars_77001.json`` holds the outcome and
the time of every episode and why the others failed; a second start plays what is missing. ``docs/sonars.md``
shows the table.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from docs.writers.evaluations import ONE_THREAD, commit_of_package
from docs.writers.figure_sources import ROOT
from docs.writers.pieces import LETTERS
from uuvtai.run_folder import hardware, write_atomic

SEED, EPISODES = 77001, 500
"""a tuning seed"""
FILE = "docs/data/sonars_77001.json"
CELLS = (("pool (8, 0)", "-S 8 -D 0"), ("pool (8, 6, 0.6)", "-S 8 -D 6 -v 0.6"))
"""(title, options of ``uuv eval``)"""


@dataclass(frozen=True)
class SonarKind:
    """A row of the table."""

    title: str
    """Markdown"""
    options: str
    """of ``uuv eval``"""


KINDS = (
    SonarKind("ring, 256 beams, Doppler: `paper`", "--sensors paper"),
    SonarKind("the same without Doppler", "--sensors paper --set sensors.sonar.doppler=false"),
    SonarKind(
        "fan of 130 degrees, 256 beams, Doppler", "--sensors multibeam --set sensors.sonar.doppler=true"
    ),
    SonarKind("the same without Doppler: `multibeam`", "--sensors multibeam"),
    SonarKind(
        "fan of 120 degrees, 512 beams, without Doppler",
        "--sensors multibeam --set sensors.sonar.horizontal_aperture_deg=120 --set sensors.sonar.n_ray=512",
    ),
    SonarKind(
        "130 degrees, ten pings a second, ranges detected in the image (SO-CFAR): `multibeam_image`",
        "--sensors multibeam_image",
    ),
    SonarKind("one mechanical beam, a sector of 115 degrees in 1.8 s: `ping360`", "--sensors ping360"),
    SonarKind(
        "the same, whole turns of 400 steps in 14 s, 12 m",
        "--sensors ping360 --set sensors.sonar.horizontal_aperture_deg=360 --set sensors.sonar.n_ray=400 "
        "--set sensors.sonar.max_range_m=12",
    ),
)
"""the first is what the others are compared with"""


def command_of(kind: SonarKind, options: str, episodes: int) -> list[str]:
    """Arguments of ``uuv`` for one row."""
    who = ["eval", "--controller", "bt", "--world", "pool", *options.split(), *kind.options.split()]
    return [*who, "--seeds", str(SEED), "--episodes", str(episodes), "--explain"]


def entry_of(
    kind: SonarKind, cell: str, command: list[str], result: dict[str, Any], commit: str
) -> dict[str, Any]:
    """What is kept of a ``uuv eval --json`` document."""
    (method,) = result["methods"]
    return {
        "sonar": kind.title,
        "cell": cell,
        "command": "uuv " + " ".join(command),
        "commit": commit,
        "machine": hardware(),
        "outcomes": "".join(LETTERS[e["outcome"]] for e in method["episodes_detail"]),
        "times_s": [e["time_s"] for e in method["episodes_detail"]],
        "causes": {cause["label"]: cause["count"] for cause in method["causes"]},
    }


def document_at(path: Path, seed: int) -> dict[str, Any]:
    """What a file of results holds so far; an empty document where there is none."""
    if path.exists():
        return json.loads(path.read_text(encoding="utf-8"))
    letters = {letter: name for name, letter in LETTERS.items()}
    return {"schema": 1, "seed": seed, "letters": letters, "rows": []}


def play(command: list[str]) -> dict[str, Any]:
    """The document that ``uuv`` prints."""
    with tempfile.TemporaryDirectory() as place:
        done = subprocess.run(
            [sys.executable, "-m", "uuvtai", *command, "--json", "--run-dir", f"{place}/run"],
            env=os.environ | ONE_THREAD,
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
    return json.loads(done.stdout)


def main() -> None:
    """Play all rows that are not in the file yet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=EPISODES)
    parser.add_argument("--out", default=FILE, help="file of the results, from the root of the tree")
    chosen = parser.parse_args()
    path: Path = ROOT / chosen.out
    document = document_at(path, SEED)
    for kind in KINDS:
        for cell, options in CELLS:
            command = command_of(kind, options, chosen.episodes)
            if "uuv " + " ".join(command) not in {row["command"] for row in document["rows"]}:
                entry = entry_of(kind, cell, command, play(command), commit_of_package())
                document["rows"].append(entry)
                write_atomic(path, (json.dumps(document, indent=1) + "\n").encode())
                print(kind.title, cell, flush=True)


if __name__ == "__main__":
    main()
