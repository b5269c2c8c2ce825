"""Play a policy before and after its fine-tuning in the simulator beside the tree, and keep what the
fine-tuning said of itself: ``python -m docs.writers.finetune_trials BEFORE AFTER`` (run folders or
checkpoints).

``docs/data/finetune_77701.json`` holds the outcome and the time of every episode, by all three, and the
evaluations on held-out episodes of the simulator along the fine-tuning; ``--late`` keeps the evaluations
alone, of a fine-tuning that began with a policy that had learnt longer. ``docs/learning.md`` shows the
tables.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from docs.writers.evaluations import commit_of_package
from docs.writers.figure_sources import ROOT
from docs.writers.pieces import LETTERS
from docs.writers.twin_trials import CELLS, curve_of, played
from uuvtai.learn import checkpoint
from uuvtai.run_folder import hardware, write_atomic

SEED, EPISODES = 77701, 600
FILE, LATE_FILE = "docs/data/finetune_77701.json", "docs/data/finetune_late.json"


def entry_of(method: dict[str, Any]) -> dict[str, Any]:
    """What is kept of one method."""
    found = method.get("checkpoint") or {}
    return {
        **{name: found[name] for name in ("sha256", "step") if name in found},
        "outcomes": "".join(LETTERS[episode["outcome"]] for episode in method["episodes_detail"]),
        "times_s": [episode["time_s"] for episode in method["episodes_detail"]],
    }


def row_of(title: str, options: str, before: Path, after: Path) -> dict[str, Any]:
    """One scene, played by the tree, the policy as it came, and as it is."""
    scene = [*options.split(), "--seeds", str(SEED), "--episodes", str(EPISODES)]
    methods = played(["eval", str(before), str(after), "--controller", "bt", *scene])["methods"]
    found = {
        "bt": next(method for method in methods if method["name"] == "bt"),
        **{who: method_of(methods, path) for who, path in (("before", before), ("after", after))},
    }
    return {
        "cell": title,
        "command": " ".join(["uuv eval BEFORE AFTER --controller bt", *scene]),
        "commit": commit_of_package(),
        "machine": hardware(),
        **{who: entry_of(method) for who, method in found.items()},
    }


def method_of(methods: list[dict[str, Any]], path: Path) -> dict[str, Any]:
    """What a run folder's best checkpoint, or a checkpoint, did."""
    is_run = (path / "checkpoints").is_dir()
    wanted = (checkpoint.best(path) if is_run else checkpoint.open_checkpoint(path)).sha256
    return next(method for method in methods if (method.get("checkpoint") or {}).get("sha256") == wanted)


def main() -> None:
    """Play all scenes and write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--late", action="store_true", help="only what a later fine-tuning said of itself")
    chosen = parser.parse_args()
    if chosen.late:
        late: dict[str, Any] = {"schema": 1, "commit": commit_of_package(), "machine": hardware()}
        late["curve"] = curve_of(chosen.after)
        write_atomic(ROOT / LATE_FILE, (json.dumps(late, indent=1) + "\n").encode())
        return
    document: dict[str, Any] = {
        "schema": 1,
        "seeds": str(SEED),
        "letters": {letter: name for name, letter in LETTERS.items()},
        "curve": curve_of(chosen.after),
        "rows": [],
    }
    for title, _name, options in CELLS:
        document["rows"].append(row_of(title, options, chosen.before, chosen.after))
        write_atomic(ROOT / FILE, (json.dumps(document, indent=1) + "\n").encode())
        print(title, flush=True)


if __name__ == "__main__":
    main()
