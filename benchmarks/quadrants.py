"""Taichi beside Quadrants, its maintained fork, in its place (``UUV_COMPILER=quadrants``): bits of the step,
its time on one thread, and seconds of a start.

Each side runs in processes of its own, with caches of its own. Taichi runs as users have it, and without
machine code of the kernels' own: then both compilers launch what they have compiled themselves.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from importlib import metadata
from pathlib import Path

from benchmarks.before import ROOT, Player, Side, equal
from benchmarks.common import Job, Row

LONGEST_S = 5400
_SCENES = (("pool", "nominal"), ("pool", "paper"), ("maze", "multibeam"), ("gauntlet", "harsh"))
_OURS = ("Taichi", "Taichi without machine code of our own")
_STEPS, _TURNS, _STARTS = 5, 24, 3


def measure(job: Job) -> list[Row]:
    """Milliseconds of a step; seconds from a process's begin to the end of its first step; arrays that
    differ. Raises RuntimeError where Quadrants is missing."""
    try:
        peer = f"Quadrants {metadata.version('quadrants')}"
    except metadata.PackageNotFoundError as error:
        raise RuntimeError("Quadrants is not here: pip install quadrants, or -e .[bench]") from error
    with tempfile.TemporaryDirectory() as folder:
        sides = [_side(Path(folder) / name, name) for name in (*_OURS, peer)]
        rows = []
        for sensors in ("nominal", "paper")[: 1 if job.quick else None]:
            rows += _steps(job, sides, sensors, peer)
        rows += _starts(job, Path(folder) / "starts", peer)
        return rows + _bits(job, sides[0], sides[-1], peer)


def _side(folder: Path, name: str) -> Side:
    side = Side(ROOT, folder)
    code = os.devnull if name == _OURS[1] else str(folder / "code")  # no folder: nothing can be kept there
    compiler = "taichi" if name in _OURS else "quadrants"
    side.environment |= {"UUV_COMPILER": compiler, "UUV_NATIVE_CACHE": code}
    return side


def _steps(job: Job, sides: list[Side], sensors: str, peer: str) -> list[Row]:
    """CPU time of steps with the tree, in turns, and the median ratio of the turns."""
    num_envs, turns = (16, 2) if job.quick else (1024, _TURNS)
    players = [Player(side, "speed", "pool", sensors, str(num_envs), threads=1) for side in sides]
    taken: list[list[float]] = [[] for _ in players]
    for turn in range(-1, turns):  # the first warms up
        for i in range(len(players))[:: 1 if turn % 2 else -1]:
            spent = 1e3 * players[i].seconds(_STEPS) / _STEPS
            taken[i] += [spent] if turn >= 0 else []
    for player in players:
        player.close()
    what = f"a step of {num_envs:,} vehicles, {sensors} sensing, one thread: "
    return [_row(job, what + _OURS[i], "CPU ms", taken[i], taken[-1], peer) for i in (0, 1)]


def _starts(job: Job, folder: Path, peer: str) -> list[Row]:
    """Wall time on all cores: everything compiled, and again."""
    num_envs, turns = (16, 1) if job.quick else (1024, _STARTS)
    names, kinds = (*_OURS, peer), ("everything compiled", "again")
    taken: dict[tuple[str, str], list[float]] = {(name, kind): [] for name in names for kind in kinds}
    for turn in range(turns):
        for name in names if turn % 2 else names[::-1]:
            side = _side(folder / f"{name} {turn}", name)
            for kind in kinds:
                begun = time.perf_counter()
                player = Player(side, "speed", "pool", "nominal", str(num_envs))
                taken[name, kind].append(time.perf_counter() - begun)
                player.close()
    what = f"start to the end of a first step, {num_envs:,} vehicles, nominal sensing, "
    return [
        _row(job, f"{what}{kind}: {name}", "s", taken[name, kind], taken[peer, kind], peer)
        for kind in kinds
        for name in _OURS
    ]


def _bits(job: Job, ours: Side, theirs: Side, peer: str) -> list[Row]:
    num_envs, steps = (16, 5) if job.quick else (256, 100)
    rows = []
    for world, sensors in _SCENES[: 1 if job.quick else None]:
        one, other = (side.bits(world, sensors, num_envs, steps) for side in (ours, theirs))
        what = f"{world}, {sensors} sensing, {num_envs} vehicles, {steps} steps: arrays that differ"
        rows.append(equal(what, one, other, peer))
        job.say(f"{what}: {rows[-1].note}")
    return rows


def _row(job: Job, what: str, unit: str, ours: list[float], theirs: list[float], peer: str) -> Row:
    ratios = [other / one for one, other in zip(ours, theirs, strict=True)]
    note = f"{len(ratios)} turns: median {statistics.median(ratios):.3f} x"
    job.say(f"{what}: {note}")
    one, other = map(statistics.median, (ours, theirs))
    return Row(what, one, unit, other, peer, less_is_better=True, note=note)
