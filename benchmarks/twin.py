"""Decisions per second of a training in the kinematic twin (``uuv train quick``) on all cores, beside another
commit (``--against``, default HEAD): whole commands of a few iterations in turns, the first two of each left
out. And the twin alone, without networks, in short turns of two processes."""

from __future__ import annotations

import contextlib
import json
import statistics
import tempfile
from pathlib import Path

from benchmarks.before import ROOT, Player, Side, checked_out
from benchmarks.common import Job, Row

LONGEST_S = 1800
_TURNS, _ITERATIONS, _LEFT_OUT = 5, 10, 2
_SHORT = ["--set", "train.evaluate_every=1000", "--set", "train.evaluate_episodes=16"]
_SMALL = ["--set", "train.num_envs=16", "--set", "ppo.minibatches=1", "--set", "twin.scenarios=16"]
_PARTS = ("simulate", "learn")
_SIZES, _DECISIONS, _ROUNDS = (2048, 8192), 50, 15
_KERNELS_US = 3.0
"""what a decision of the twin may take"""


def measure(job: Job) -> list[Row]:
    """Decisions per second of an iteration, and seconds of its parts."""
    options = [*_SHORT, "--iterations", str(3 if job.quick else _ITERATIONS), *(_SMALL if job.quick else [])]
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        commit, tree = stack.enter_context(checked_out(job.against or "HEAD", folder / "tree"))
        sides = Side(ROOT, folder / "ours"), Side(tree, folder / "theirs")
        found: list[list[dict[str, float]]] = [[], []]
        for turn in range(1 if job.quick else _TURNS):
            for i in (0, 1) if turn % 2 else (1, 0):
                place = sides[i].uuv(["train", "quick", *options], f"turn{turn}")
                lines = (place / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
                found[i] += [json.loads(line) for line in lines][_LEFT_OUT:]
            job.say(f"turn {turn + 1}")
        sizes = (64,) if job.quick else _SIZES
        return [*_rows(found, commit), *(_alone(job, sides, commit, size) for size in sizes)]


def _alone(job: Job, sides: tuple[Side, Side], commit: str, num_envs: int) -> Row:
    """A decision of the twin on all cores, medians of both sides in turns."""
    players = [Player(side, "twin", "twin", str(num_envs)) for side in sides]
    taken: list[list[float]] = [[], []]
    for turn in range(1 if job.quick else _ROUNDS):
        for i in (0, 1) if turn % 2 else (1, 0):
            taken[i].append(1e6 * players[i].seconds(_DECISIONS) / (_DECISIONS * num_envs))
    for player in players:
        player.close()
    ours, theirs = map(statistics.median, taken)
    told = dict(zip(("ours_us", "theirs_us"), taken, strict=True))
    return Row(
        f"a decision of the twin alone, {num_envs:,} vehicles", ours, "us", theirs, commit,
        less_is_better=True, floor=_KERNELS_US, details=told,
    )  # fmt: skip


def _rows(found: list[list[dict[str, float]]], commit: str) -> list[Row]:
    rate = "time/env_steps_per_s"
    ours, theirs = (_median(side, rate) for side in found)
    told = {
        name: [row[rate] for row in side]
        for name, side in zip(("rates", "rates_of_the_peer"), found, strict=True)
    }
    rows = [Row("training in the twin", ours, "decisions/s", theirs, commit, floor=40_000, details=told)]
    for part in _PARTS:
        ours, theirs = (_median(side, f"time/{part}_s") for side in found)
        rows.append(Row(f"an iteration: {part}", ours, "s", theirs, commit, less_is_better=True))
    return rows


def _median(side: list[dict[str, float]], name: str) -> float:
    return statistics.median(row[name] for row in side)
