"""A sweep killed ten times (SIGKILL, at random moments) and resumed, beside one that nobody disturbed: are
the cells equal?"""

from __future__ import annotations

import json
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.common import Job, Row
from uuvtai.measure.sweep.play import REQUEST, ROWS

_KILLS = 10
_LONGEST_S = 16.0
"""a kill comes at a random moment up to so long after the start; every second one up to half of that after
this run has finished a task"""
_METHODS = ["--controller", "straight", "--controller", "planner", "--controller", "bt"]
_SWEEP = [
    "--grid",
    "S=4,8",
    "--grid",
    "D=0,3,6,9",
    "--grid",
    "v=0.4,0.8,1.5,3.0",
    *_METHODS,
    "--episodes",
    "96",
]
"""nine tasks, three a method: what a kill loses is the task that runs"""
_SEED = 20261122
_TINY = ["--grid", "S=4", "--grid", "D=3,6", "--grid", "v=0.6", "--controller", "bt", "--episodes", "4"]


def measure(job: Job) -> list[Row]:
    """How many cells agree with the undisturbed sweep, and how many kills hit a sweep at work."""
    kills, sweep = (2, _TINY) if job.quick else (_KILLS, _SWEEP)
    with tempfile.TemporaryDirectory() as folder:
        whole = _uuv("sweep", *sweep, "--run-dir", f"{folder}/whole", "--json")["cells"]
        job.say(f"undisturbed: {len(whole)} cells")
        moments, left = _killed(sweep, Path(folder) / "killed", kills, job)
        found = _uuv("sweep", "--resume", f"{folder}/killed", "--json")["cells"]
    equal = sum(ours == theirs for ours, theirs in zip(found, whole, strict=True))
    details = {"killed_after_s": moments, "cells_when_killed": left, "seed": _SEED}
    what = f"cells equal to the last digit after {len(moments)} kills"
    return [
        Row(
            what,
            equal,
            f"of {len(whole)} cells",
            floor=len(whole),
            note=f"done when killed: {left}",
            details=details,
        ),
        Row(
            "kills that found finished cells on disk",
            sum(count > 0 for count in left),
            f"of {kills} kills",
            floor=kills / 2,
        ),
    ]


def _killed(sweep: list[str], place: Path, kills: int, job: Job) -> tuple[list[float], list[int]]:
    """Moments [s after the start] of the kills that hit, and the cells that lay finished on disk then."""
    generator, moments, left = random.Random(_SEED), [], []
    command = ["sweep", *sweep, "--run-dir", str(place)]
    while len(moments) < kills:
        child = subprocess.Popen(
            [sys.executable, "-m", "uuvtai", *command], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        moment = generator.uniform(0.0, _LONGEST_S)
        begun, finished = time.monotonic(), _finished(place)
        if len(moments) % 2:
            while child.poll() is None and _finished(place) == finished:
                time.sleep(0.01)
            moment = time.monotonic() - begun + 0.5 * moment
        while child.poll() is None and (time.monotonic() - begun < moment or not (place / REQUEST).exists()):
            time.sleep(0.01)
        if child.poll() is not None:
            job.say(f"done before kill {len(moments) + 1}")
            break
        child.kill()
        child.wait()
        moments.append(round(time.monotonic() - begun, 2))
        left.append(_finished(place))
        job.say(f"kill {len(moments)} after {moments[-1]:.1f} s, {left[-1]} cells done")
        command = ["sweep", "--resume", str(place)]
    return moments, left


def _finished(place: Path) -> int:
    """Cells that lie finished on disk."""
    lines = place / ROWS
    return len(lines.read_text().splitlines()) if lines.exists() else 0


def _uuv(*arguments: str) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, "-m", "uuvtai", *arguments], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"uuv {' '.join(arguments)}: exit code {done.returncode}\n{done.stderr}")
    return json.loads(done.stdout)
