"""Speed of training beside another commit (``--against``, default HEAD): the recipe that was ``best`` there
(today's ``residual``), 1,024 envs with nominal sensing.

Whole commands of a few iterations, in turns; the first iteration of each is left out, for it begins episodes
and allocates. What counts is the time that the other iterations took to simulate, infer and learn. The same
recipe with hidden layers in float32 (``ppo.bfloat16=false``), as it was there, is in the same turns.
"""

from __future__ import annotations

import contextlib
import json
import statistics
import tempfile
from pathlib import Path

from benchmarks.before import ROOT, Side, checked_out
from benchmarks.common import Job, Row

LONGEST_S = 3600
_TURNS, _ITERATIONS = 5, 4
_RECIPES = ("residual", "best")
"""its names, the newest first"""
_SHORT = ["--sensors", "nominal", "--device", "cpu", "--set", "train.evaluate_episodes=16"]
_PARTS = ("simulate", "infer", "learn")


def measure(job: Job) -> list[Row]:
    """Env-steps per second of an iteration, and seconds of its parts."""
    iterations = 2 if job.quick else _ITERATIONS
    options = [*_SHORT, "--iterations", str(iterations)]
    options += ["--set", "train.num_envs=16"] if job.quick else []
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        commit, tree = stack.enter_context(checked_out(job.against or "HEAD", folder / "tree"))
        ours, theirs = Side(ROOT, folder / "ours"), Side(tree, folder / "theirs")
        plays = (ours, options), (theirs, options), (ours, [*options, "--set", "ppo.bfloat16=false"])
        for i, (side, told) in enumerate(plays):  # what is new to the caches
            _iterations(side, told, f"first{i}")
        found: list[list[dict[str, float]]] = [[] for _ in plays]
        for turn in range(1 if job.quick else _TURNS):
            for i in range(len(plays))[:: 1 if turn % 2 else -1]:
                side, told = plays[i]
                found[i] += _iterations(side, told, f"turn{turn}_{i}")
            job.say(f"turn {turn + 1}")
    return _rows(found, commit)


def _iterations(side: Side, options: list[str], run: str) -> list[dict[str, float]]:
    """Metrics of all iterations of a training but the first."""
    recipe = next(name for name in _RECIPES if (side.tree / f"uuvtai/presets/train/{name}.yaml").exists())
    place = side.uuv(["train", recipe, *options], run)
    lines = (place / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
    return [json.loads(line) for line in lines][1:]


def _rows(found: list[list[dict[str, float]]], commit: str) -> list[Row]:
    rate = "time/env_steps_per_s"
    ours, theirs, wide = (_median(side, rate) for side in found)
    told = {name: [row[rate] for row in side]
            for name, side in zip(("ours", "theirs", "float32"), found, strict=True)}  # fmt: skip
    rows = [Row("training, nominal sensing", ours, "env-steps/s", theirs, commit, floor=1.3, floor_on="ratio",
                details=told),
            Row("training, hidden layers in float32", wide, "env-steps/s", theirs, commit)]  # fmt: skip
    for part in _PARTS:
        ours, theirs, wide = (_median(side, f"time/{part}_s") for side in found)
        rows.append(Row(f"an iteration: {part}", ours, "s", theirs, commit, less_is_better=True))
        rows.append(Row(f"in float32: {part}", wide, "s", theirs, commit, less_is_better=True))
    return rows


def _median(side: list[dict[str, float]], name: str) -> float:
    return statistics.median(row[name] for row in side)
