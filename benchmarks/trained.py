"""Speed of training beside another commit (``--against``, default HEAD): in the simulator, 1,024 envs with
nominal sensing, and in the surrogate.

Whole commands of a few iterations, in turns; the first iterations of each are left out, for they begin
episodes and allocate.
"""

from __future__ import annotations

import contextlib
import json
import statistics
import tempfile
from pathlib import Path

from benchmarks.before import ROOT, Side, checked_out
from benchmarks.common import Job, Row

LONGEST_S = 5400
_TURNS, _LEFT_OUT = 5, 2
_SHORT = ["--device", "cpu", "--set", "train.evaluate_every=1000", "--set", "train.evaluate_episodes=16"]
_SIMULATOR = ["--sensors", "nominal", "--iterations", "5", "--set=stack=null", "--set=train.num_envs=1024"]
_RECIPES = {"paper": _SIMULATOR, "policy": ["--iterations", "10"]}
_QUICK = [
    *("--iterations", "3", "--set", "train.num_envs=16", "--set", "ppo.minibatches=1"),
    *("--set", "surrogate.scenarios=16"),
]
_PARTS = ("simulate", "infer", "learn")


def measure(job: Job) -> list[Row]:
    """Env-steps per second of an iteration, and seconds of its parts."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        commit, tree = stack.enter_context(checked_out(job.against or "HEAD", folder / "tree"))
        sides = Side(ROOT, folder / "ours"), Side(tree, folder / "theirs")
        rows = []
        for recipe, options in _RECIPES.items():
            told = [recipe, *_SHORT, *(_QUICK if job.quick else options)]
            found: list[list[dict[str, float]]] = [[], []]
            for turn in range(1 if job.quick else _TURNS):
                for i in (0, 1) if turn % 2 else (1, 0):
                    place = sides[i].uuv(["train", *told], f"{recipe}{turn}")
                    lines = (place / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
                    found[i] += [json.loads(line) for line in lines][_LEFT_OUT:]
                job.say(f"{recipe}: turn {turn + 1}")
            rows += _rows(recipe, found, commit)
        return rows


def _rows(recipe: str, found: list[list[dict[str, float]]], commit: str) -> list[Row]:
    rate = "time/env_steps_per_s"
    ours, theirs = (_median(side, rate) for side in found)
    sides = zip(("ours", "theirs"), found, strict=True)
    told = {name: [row[rate] for row in side] for name, side in sides}
    rows = [Row(f"uuv train {recipe}", ours, "env-steps/s", theirs, commit, details=told)]
    for part in _PARTS:
        if f"time/{part}_s" in found[0][0]:
            ours, theirs = (_median(side, f"time/{part}_s") for side in found)
            rows.append(Row(f"an iteration: {part}", ours, "s", theirs, commit, less_is_better=True))
    return rows


def _median(side: list[dict[str, float]], name: str) -> float:
    return statistics.median(row[name] for row in side)
