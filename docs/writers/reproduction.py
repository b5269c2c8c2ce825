"""A reproduction as a committed page: ``python -m docs.writers.reproduction RUN`` writes
``docs/data/reproduce.json``, ``docs/results.md``.

Without RUN the page is written again from the committed file.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from docs.writers.figure_sources import ROOT
from uuvtai.measure.reproduce.markdown import results_page
from uuvtai.tables.heatmap import cell_name

DATA, PAGE = "docs/data/reproduce.json", "docs/results.md"

_KEPT = (
    "schema",
    "budget",
    "seed",
    "notes",
    "started",
    "git_sha",
    "hardware",
    "commands",
    "table_main",
    "claims",
    "inconsistencies",
)
_ENTRY = ("name", "episodes", "outcomes", "time_mean_s", "time_to_success_mean_s")
"""of a method or a cell, what the page needs"""


def kept(document: dict[str, Any]) -> dict[str, Any]:
    """What the page needs of a ``uuv reproduce --json`` document, small enough to be committed beside it."""
    small = {name: document[name] for name in _KEPT if name in document}
    small["table_main"] = {
        name: [_entry(entry) for entry in entries] for name, entries in document["table_main"].items()
    }
    small["ceilings"] = {"methods": [_entry(entry) for entry in document["ceilings"]["methods"]]}
    small["sweeps"] = {name: _small_sweep(sweep) for name, sweep in document["sweeps"].items()}
    profile = document["profile"]
    rows = [
        {"num_envs": row["num_envs"], "env_steps_per_s": row["env_steps_per_s"]} for row in profile["rows"]
    ]
    small["profile"] = {
        "paper_latency": profile["paper_latency"],
        "paper_density": profile["paper_density"],
        "rows": rows,
    }
    return small


def _entry(entry: dict[str, Any]) -> dict[str, Any]:
    return {name: entry[name] for name in _ENTRY if name in entry}


def _small_sweep(sweep: dict[str, Any]) -> dict[str, Any]:
    axes = {cell_name(axis) for axis in sweep["axes"]} | {"S", "D", "v_m_s", "method"}
    rest = {name: sweep[name] for name in ("axes", "one_at_a_time", "unchanged") if name in sweep}
    return rest | {
        "cells": [{k: cell[k] for k in cell if k in axes or k in _ENTRY} for cell in sweep["cells"]]
    }


def page(root: Path = ROOT) -> str:
    """The page as the committed results have it."""
    return results_page(json.loads((root / DATA).read_text(encoding="utf-8")))


def main(arguments: list[str] | None = None) -> int:
    """Keep a reproduction and write its page; 1 where the folder is none."""
    parser = argparse.ArgumentParser(
        prog="python -m docs.writers.reproduction", description=(__doc__ or "").split("\n\n")[0]
    )
    parser.add_argument("run", type=Path, nargs="?", help="run folder of a finished uuv reproduce")
    chosen = parser.parse_args(arguments)
    if chosen.run:
        try:
            small = kept(json.loads((chosen.run / "reproduce.json").read_text(encoding="utf-8")))
        except (OSError, ValueError, KeyError) as error:
            print(f"{chosen.run}: is no finished reproduction ({error})", file=sys.stderr)
            return 1
        (ROOT / DATA).write_text(json.dumps(small, indent=1) + "\n", encoding="utf-8")
    (ROOT / PAGE).write_text(page(), encoding="utf-8")
    print(ROOT / PAGE)
    return 0


if __name__ == "__main__":
    sys.exit(main())
