"""The table of ``docs/own_pieces.md`` from the run folder of an evaluation: ``python -m
docs.writers.own_pieces RUN`` writes ``docs/data/own_pieces.json``."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from docs.writers.figure_sources import ROOT

FILE = "docs/data/own_pieces.json"
_KEPT = ("name", "episodes", "outcomes", "time_to_success_mean_s", "env_steps_per_s")
_OWN = ("kind", "sha256", "calls", "decisions", "decision_ms", "slowest_ms", "late_calls", "budget_ms")
BESIDE = "bt"


def document(run: Path) -> dict[str, Any]:
    """What the page shows of an evaluation: its condition, every row, and its pairs with the tree."""
    result, record = (json.loads((run / name).read_text()) for name in ("eval/result.json", "run.json"))
    methods = [
        {name: entry[name] for name in _KEPT}
        | ({"own": {name: entry["own"][name] for name in _OWN}} if "own" in entry else {})
        for entry in result["methods"]
    ]
    return {
        "schema": 1,
        "git_sha": record["git_sha"],
        "seeds": result["seeds"],
        "condition": [result["world"], result["S"], result["D"], result["v_m_s"], result["sensors"]],
        "methods": methods,
        "paired": [pair for pair in result["paired"] if BESIDE in (pair["a"], pair["b"])],
    }


def main() -> None:
    """Keep the table of one run."""
    text = json.dumps(document(Path(sys.argv[1])), indent=1, allow_nan=False)
    (ROOT / FILE).write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
