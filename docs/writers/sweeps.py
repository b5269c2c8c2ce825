"""A sweep's run folder as a committed file: ``python -m docs.writers.sweeps RUN NAME`` writes
``docs/data/sweep_NAME.csv``.

Counts of every cell go into the CSV; command, seeds, commit, date and machine into ``docs/data/sweeps.json``.
"""

from __future__ import annotations

import argparse
import csv
import json
import shlex
import sys
from pathlib import Path
from typing import Any

from docs.writers.figure_sources import ROOT

ENDINGS = {
    "success": "success",
    "contact": "collision",
    "ttc_stop": "ttc",
    "out_of_tank": "out_of_tank",
    "timeout": "timeout",
}
"""columns of the CSV and the endings of an episode that they count"""


def keep(run: Path, name: str, root: Path = ROOT) -> Path:
    """Write the CSV and the entry of a finished sweep; the CSV's path. Raises OSError, ValueError or KeyError
    for another folder."""
    sweep = json.loads((run / "sweep.json").read_text(encoding="utf-8"))
    record = json.loads((run / "run.json").read_text(encoding="utf-8"))
    axes = ["v_m_s" if axis == "v" else axis for axis in sweep["axes"]]
    target = root / f"docs/data/sweep_{name}.csv"
    with target.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*axes, "method", "episodes", *ENDINGS, "time_to_success_mean_s"])
        writer.writerows(_row(cell, axes, sweep.get("unchanged", {})) for cell in sweep["cells"])
    _note(root / "docs/data/sweeps.json", name, sweep, record)
    return target


def _row(cell: dict[str, Any], axes: list[str], unchanged: dict[str, Any]) -> list[Any]:
    """One line; an axis at which a sweep of one axis at a time changes nothing is empty, and so is the speed
    where nothing moves."""
    held = [
        "" if cell.get(axis) is None or (axis in unchanged and cell[axis] == unchanged[axis]) else cell[axis]
        for axis in axes
    ]
    time = cell["time_to_success_mean_s"]
    return [
        *held,
        cell["method"],
        cell["episodes"],
        *(cell["outcomes"][e] for e in ENDINGS.values()),
        "" if time is None else round(time, 2),
    ]


def _note(path: Path, name: str, sweep: dict[str, Any], record: dict[str, Any]) -> None:
    """What made the sweep, beside those of the other sweeps."""
    entries = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    entries[name] = {
        "command": _shown(record["argv"]),
        "seeds": sweep["seeds"],
        "episodes": sweep["episodes_per_seed"],
        "commit": record.get("git_sha"),
        "date": record["started"],
        "cpu": record.get("hardware", {}).get("cpu"),
        "wall_s": record.get("wall_s"),
    }
    path.write_text(json.dumps(dict(sorted(entries.items())), indent=1) + "\n", encoding="utf-8")


def _shown(argv: list[str]) -> str:
    """The command without the machine's paths."""
    words, skip = ["uuv"], False
    for word in argv[1:]:
        if not skip and word not in ("--run-dir", "--json"):
            words.append(shlex.quote(word))
        skip = word == "--run-dir"
    return " ".join(words)


def main(arguments: list[str] | None = None) -> int:
    """Keep a sweep; 1 where the folder is none."""
    parser = argparse.ArgumentParser(
        prog="python -m docs.writers.sweeps", description=(__doc__ or "").split("\n\n")[0]
    )
    parser.add_argument("run", type=Path, help="run folder of a finished uuv sweep")
    parser.add_argument(
        "name", help="what the text calls it: pool, gauntlet, caution, robustness, dead_reckoning"
    )
    chosen = parser.parse_args(arguments)
    try:
        print(keep(chosen.run, chosen.name))
    except (OSError, ValueError, KeyError) as error:
        print(f"{chosen.run}: is no finished sweep ({error})", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
