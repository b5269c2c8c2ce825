"""How long commands take to start, beside another commit (``--against``, default HEAD).

Whole commands that do next to nothing, so that importing, compiling and resetting are all there is. Both
sides run in this environment with caches of their own, in turns. A cold start compiles everything, a warm one
has run before, a new one asks for a number of obstacles, a speed, a batch or a threshold that has never been
run.
"""

from __future__ import annotations

import contextlib
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.before import ROOT, Side, checked_out
from benchmarks.common import Job, Row

LONGEST_S = 3600
_TURNS = 5
_SHORT = ["--device", "cpu", "--set", "episode.horizon_steps=4"]
_EVAL = ["eval", "--agent", "bt", "--seeds", "77", *_SHORT]
_WARM = {
    "uuv eval, 8 episodes of 4 steps": [*_EVAL, "--episodes", "8"],
    "uuv simulate, 1 s": ["simulate", "--seconds", "1"],
    "uuv train smoke, one iteration": ["train", "smoke", "--iterations", "1", *_SHORT],
}
_EIGHT = [*_EVAL, "--episodes", "8"]
_NEW = {
    "uuv eval with a D never run before": [[*_EIGHT, "-D", text] for text in ("3", "4", "5")],
    "uuv eval with a batch never run before": [[*_EVAL, "--episodes", text] for text in ("5", "7", "11")],
    "uuv eval with a speed never run before": [[*_EIGHT, "--speed", text] for text in ("0.5", "0.7", "0.9")],
    "uuv eval with a threshold never run before": [
        [*_EIGHT, "--set", f"behavior.caution={text}"] for text in ("0.8", "1.2", "1.4")
    ],
}


def measure(job: Job) -> list[Row]:
    """Wall time of each command on both sides, medians [s]."""
    turns = 1 if job.quick else _TURNS
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        commit, tree = stack.enter_context(checked_out(job.against or "HEAD", folder / "tree"))
        rows, sides = [], list[Side]()
        for what, arguments in _WARM.items():
            cold = []
            for _ in range(1 if rows else turns):  # the first command's caches are the others', too
                if not rows:
                    sides = [Side(one, Path(tempfile.mkdtemp(dir=folder))) for one in (ROOT, tree)]
                cold.append([_seconds(side, arguments) for side in sides])
            cold = [list(times) for times in zip(*cold, strict=True)]
            rows.append(_row(f"{what}: everything compiled", cold, commit))
            rows.append(_row(f"{what}: again", _in_turns(sides, [arguments] * turns), commit))
            job.say(rows[-1].what)
        for what, commands in _NEW.items():
            rows.append(_row(what, _in_turns(sides, commands[:turns]), commit))
            job.say(what)
        return rows


def _in_turns(sides: list[Side], commands: list[list[str]]) -> list[list[float]]:
    times: list[list[float]] = [[], []]
    for turn, arguments in enumerate(commands):
        for i in (0, 1) if turn % 2 else (1, 0):
            times[i].append(_seconds(sides[i], arguments))
    return times


def _seconds(side: Side, arguments: list[str]) -> float:
    """Wall time of a command of the side's tree, in a run folder of its own."""
    with tempfile.TemporaryDirectory() as run:
        begun = time.perf_counter()
        subprocess.run(
            [sys.executable, "-m", "uuvtai", *arguments, *_folder_of(arguments, run)],
            env=side.environment, cwd=side.tree, check=True, stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )  # fmt: skip
        return time.perf_counter() - begun


def _folder_of(arguments: list[str], run: str) -> list[str]:
    """Where a command that keeps its results is to put them."""
    return [] if arguments[0] == "simulate" else ["--run-dir", f"{run}/run"]


def _row(what: str, times: list[list[float]], commit: str) -> Row:
    ours, theirs = (statistics.median(found) for found in times)
    details = {"ours_s": times[0], "theirs_s": times[1]}
    return Row(what, ours, "s", theirs, commit, less_is_better=True, details=details)
