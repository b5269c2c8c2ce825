"""Time of a control step beside another commit (``--against``, default HEAD): one vehicle paced at 50 Hz,
1,024 on all cores, and on one thread their steps, maps and resets; their memory.

Back to back, one step warms the caches and keeps the threads active for the next; a vehicle's loop sleeps in
between. Both sides run in this environment with caches of their own, in turns.
"""

from __future__ import annotations

import contextlib
import json
import statistics
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.before import ROOT, Player, Side, checked_out
from benchmarks.common import Job, Row

LONGEST_S = 3600
CODE = ("benchmarks.played", "uuvtai.envs.vector_env")
_SENSORS = ("nominal", "paper")
_PARTS = (
    ("a step of one, paper sensing", "speed", "paper", 6, "us", 1e6),
    ("a step of one, nominal sensing", "speed", "nominal", 6, "us", 1e6),
    ("a scan of one drawn into its map", "map", "paper", 5, "us", 1e6),
    ("a reset of two", "reset", "nominal", 10, "ms", 1e3),
)
"""name, what ``played.py`` does, sensing, how often a turn, unit and its share of a second"""


def measure(job: Job) -> list[Row]:
    """Quantiles of the paced step [ms], and env-steps per second."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        commit, tree = stack.enter_context(checked_out(job.against or "HEAD", folder / "tree"))
        sides = Side(ROOT, folder / "ours"), Side(tree, folder / "theirs")
        rows = []
        for sensors in _SENSORS[: 1 if job.quick else None]:
            rows += _paced(job, sides, sensors, commit)
            rows.append(_together(job, sides, sensors, commit))
            job.say(rows[-1].what)
        return rows + _alone(job, sides, commit) + [_memory(job, sides, commit)]


def _paced(job: Job, sides: tuple[Side, Side], sensors: str, commit: str) -> list[Row]:
    steps, turns = (50, 1) if job.quick else (1000, 5)
    found: list[list[list[float]]] = [[], []]
    for i, answers in _in_turns(sides, "paced", sensors, 1, steps, turns):
        found[i].append(json.loads(answers))
    what = f"one vehicle at 50 Hz, {sensors} sensing: "
    details = {"steps_a_turn": steps, "turns": turns}
    quantiles = {"median": 0.5, "99th percentile": 0.99, "longest": 1.0}
    rows = []
    for name, share in quantiles.items():
        ours, theirs = (statistics.median(float(np.quantile(turn, share)) for turn in side) for side in found)
        rows.append(
            Row(what + name, ours, "ms", theirs, commit, less_is_better=True, note="median of the turns",
                details=details)
        )  # fmt: skip
    return rows


def _together(job: Job, sides: tuple[Side, Side], sensors: str, commit: str) -> Row:
    num_envs, steps, turns = (16, 5, 1) if job.quick else (1024, 20, 15)
    found: list[list[float]] = [[], []]
    for i, seconds in _in_turns(sides, "all_cores", sensors, num_envs, steps, turns):
        found[i].append(steps * num_envs / float(seconds))
    ours, theirs = (statistics.median(rates) for rates in found)
    return Row(
        f"{num_envs:,} vehicles, {sensors} sensing, tree alone, all cores",
        ours,
        "env-steps/s",
        theirs,
        commit,
        details={"ours": found[0], "theirs": found[1]},
    )


def _alone(job: Job, sides: tuple[Side, Side], commit: str) -> list[Row]:
    """Parts of the work on one thread, CPU time; the ratio of every turn, and their median."""
    num_envs, turns = (16, 2) if job.quick else (1024, 24)
    rows = []
    for name, what, sensors, count, unit, scale in _PARTS:
        players = [Player(side, what, "pool", sensors, str(num_envs), threads=1) for side in sides]
        for player in players:
            player.seconds(2 * count)
        taken: list[list[float]] = [[], []]
        for turn in range(turns):
            for i in (0, 1) if turn % 2 else (1, 0):
                taken[i].append(scale * players[i].seconds(count) / count / (num_envs if unit == "us" else 1))
        for player in players:
            player.close()
        ratios = [theirs / ours for ours, theirs in zip(*taken, strict=True)]
        note = f"{turns} turns: median {statistics.median(ratios):.3f} x"
        ours, theirs = map(statistics.median, taken)
        said = f"{num_envs:,} vehicles, one thread: {name}"
        rows.append(
            Row(said, ours, unit, theirs, commit, less_is_better=True, note=note, details={"ratios": ratios})
        )
        job.say(f"{said}: {note}")
    return rows


def _memory(job: Job, sides: tuple[Side, Side], commit: str) -> Row:
    num_envs = 16 if job.quick else 1024
    ours, theirs = (
        float(
            subprocess.run(
                side.played("bytes", "pool", "paper", str(num_envs)),
                env=side.environment, cwd=side.tree, check=True, stdout=subprocess.PIPE, text=True,
            ).stdout.split()[-1]
        )
        for side in sides
    )  # fmt: skip
    what = f"{num_envs:,} vehicles: memory of each"
    return Row(what, ours / 1e3, "kB", theirs / 1e3, commit, less_is_better=True)


def _in_turns(
    sides: tuple[Side, Side], what: str, sensors: str, num_envs: int, steps: int, turns: int
) -> list[tuple[int, str]]:
    """(side, answer) of every turn."""
    with contextlib.ExitStack() as stack:
        players = [stack.enter_context(_player(side, what, sensors, num_envs)) for side in sides]
        for player in players:  # what is new to the caches
            _asked(player, steps)
        return [
            (i, _asked(players[i], steps)) for turn in range(turns) for i in ((0, 1) if turn % 2 else (1, 0))
        ]


@contextlib.contextmanager
def _player(side: Side, what: str, sensors: str, num_envs: int) -> Iterator[subprocess.Popen[str]]:
    command = side.played(what, "pool", sensors, str(num_envs))
    with subprocess.Popen(
        command, env=side.environment, cwd=side.tree, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        _line(process, "ready")
        yield process
        assert process.stdin
        process.stdin.close()


def _asked(process: subprocess.Popen[str], steps: int) -> str:
    assert process.stdin
    process.stdin.write(f"{steps}\n")
    process.stdin.flush()
    return _line(process, "steps")


def _line(process: subprocess.Popen[str], word: str) -> str:
    """The rest of the next line that begins with this word. Raises RuntimeError where the process ends
    before."""
    assert process.stdout
    for line in process.stdout:
        if line.startswith(word):
            return line.removeprefix(word)
    raise RuntimeError("the player ended early")
