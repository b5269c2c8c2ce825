"""This tree against another commit of it (``--against``, default HEAD): are the bits equal, is it as fast?

A refactoring shows here that it is one: 300 steps of 256 vehicles in three worlds, the messages of two
recorded episodes, four iterations of training in the simulator and in the surrogate, compared bit by bit;
what has another name on the other side is found by its bits, and what only one side has is named. Then steps
per CPU second of one thread, the start with warm kernels and the writing of logs, in turns (wall time on a
shared machine wanders by a third). Both sides run in this environment, each with its own package and caches.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from mcap.reader import make_reader

from benchmarks.common import Job, Row

LONGEST_S = 5400
ROOT = Path(__file__).resolve().parent.parent
_WORLDS = (("pool", "paper"), ("gauntlet", "harsh"), ("maze", "nominal"))
_EVAL = ["eval", "--agent", "bt", "--episodes", "2", "--seeds", "77", "--num-envs", "4", "--record", "2"]
_TRAIN = ["--device", "cpu", "--iterations", "4"]
_SMALL = {
    "paper": {
        "train.num_envs": 16,
        "ppo.rollout_steps": 16,
        "distillation.batch": 64,
        "world_model.batch": 64,
    },
    "policy": {"train.num_envs": 64, "surrogate.scenarios": 64},
}
"""trainings in the simulator and in the surrogate, as small as they go"""
_OLDER = (("--agent", "--controller"), ("distillation.", "distill."), ("surrogate.", "twin."))
"""words of our commands and those of trees that do not know them"""
_PAIRS, _LOGS = 16, 5
_NO_BYTECODE = "PYTHONDONTWRITEBYTECODE"
"""compiles every module again at every start, on both sides: nobody's start"""


class Side:
    """A tree with folders of its own for kernels and runs."""

    def __init__(self, tree: Path, folder: Path) -> None:
        self.tree, self.folder = tree, folder
        places = {"HOME": folder / "home", "XDG_CACHE_HOME": folder / "cache", "PYTHONPATH": tree}
        for place in ("home", "cache"):
            (folder / place).mkdir(parents=True)
        kept = {name: value for name, value in os.environ.items() if name != _NO_BYTECODE}
        self.environment = kept | {name: str(place) for name, place in places.items()}

    def played(self, *arguments: str) -> list[str]:
        """The command of ``played.py`` for this side."""
        return [sys.executable, str(ROOT / "benchmarks" / "played.py"), *arguments]

    def bits(self, world: str, sensors: str, num_envs: int, steps: int) -> dict[str, str]:
        """sha256 by name: see ``played.bits``."""
        command = self.played("bits", world, sensors, str(num_envs), str(steps))
        done = subprocess.run(
            command, env=self.environment, cwd=self.tree, check=True, stdout=subprocess.PIPE, text=True
        )
        return json.loads(done.stdout.splitlines()[-1])

    def uuv(self, arguments: list[str], run: str) -> Path:
        """Run a command of the tree's own CLI, in the words that it knows; the folder that it wrote."""
        place, quiet = self.folder / run, subprocess.DEVNULL
        for new, old in (("", ""), *_OLDER):
            told = [word.replace(new, old) for word in arguments]
            command = [sys.executable, "-m", "uuvtai", *told, "--run-dir", str(place)]
            done = subprocess.run(
                command, env=self.environment, cwd=self.tree, stdout=quiet, stderr=quiet, check=False
            )
            if done.returncode == 0:
                return place
        raise RuntimeError(f"{self.tree}: uuv {' '.join(arguments)} failed")


def measure(job: Job) -> list[Row]:
    """Arrays, topics and files that differ, kernels that have other keys, and the ratios of speed."""
    steps, num_envs = (20, 16) if job.quick else (300, 256)
    horizon = ["--set", f"episode.horizon_steps={100 if job.quick else 400}"]
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        commit, tree = stack.enter_context(checked_out(job.against or "HEAD", folder / "tree"))
        ours, theirs = Side(ROOT, folder / "ours"), Side(tree, folder / "theirs")
        rows = []
        for world, sensors in _WORLDS[: 1 if job.quick else None]:
            one, other = (side.bits(world, sensors, num_envs, steps) for side in (ours, theirs))
            what = f"{world}, {sensors} sensing, {num_envs} vehicles, {steps} steps: arrays that differ"
            rows.append(equal(what, one, other, commit))
        one, other = (_topics(side.uuv([*_EVAL, *horizon], "eval")) for side in (ours, theirs))
        rows.append(equal("two recorded episodes: topics that differ", one, other, commit))
        for name, small in _SMALL.items():
            sets = (word for key, value in small.items() for word in ("--set", f"{key}={value}"))
            command = ["train", name, *_TRAIN, *sets]
            one, other = (_weights(side.uuv(command, name)) for side in (ours, theirs))
            what = f"four iterations of uuv train {name}: tensors of checkpoints that differ"
            rows.append(equal(what, one, other, commit))
        rows += _speed(job, ours, theirs, commit, num_envs)
        return rows + _logging(job, (ours, theirs), commit, [*_EVAL, *horizon])


@contextlib.contextmanager
def checked_out(commit: str, place: Path) -> Iterator[tuple[str, Path]]:
    """(short name, folder) of a commit, in a work tree that is taken away again."""
    git = ["git", "-C", str(ROOT)]
    name = subprocess.run(
        [*git, "rev-parse", "--short", commit], check=True, stdout=subprocess.PIPE, text=True
    )
    subprocess.run([*git, "worktree", "add", "--quiet", "--detach", str(place), commit], check=True)
    try:
        yield name.stdout.strip(), place
    finally:
        subprocess.run([*git, "worktree", "remove", "--force", str(place)], check=False)


def equal(what: str, ours: dict[str, str], theirs: dict[str, str], commit: str) -> Row:
    """How many of the names that both sides have are of other bits; those of one side alone are named, but
    where the other side has their bits under another name."""
    both = ours.keys() & theirs.keys()
    wrong = sorted(name for name in both if ours[name] != theirs[name])
    left: dict[str, list[str]] = {}
    for name in sorted(theirs.keys() - both):
        left.setdefault(theirs[name], []).append(name)
    renamed = {name: left[ours[name]].pop(0) for name in sorted(ours.keys() - both) if left.get(ours[name])}
    alone = {
        "here": sorted(ours.keys() - both - renamed.keys()),
        commit: sorted(theirs.keys() - both - set(renamed.values())),
    }
    count = len(both) + len(renamed)
    notes = [f"of {count}" + (f": {', '.join(wrong[:5])}" if wrong else "")]
    notes += [f"{len(renamed)} of them renamed"] if renamed else []
    notes += [f"only {side}, {len(names)}: {', '.join(names)}" for side, names in alone.items() if names]
    details = {"differ": wrong, "only": alone, "renamed": renamed}
    found = len(wrong) if count else None
    return Row(what, found, "", less_is_better=True, floor=0, note="; ".join(notes), details=details)


def _topics(run: Path) -> dict[str, str]:
    """sha256 of the times and bytes of all messages of a topic, by log and topic."""
    found: dict[str, str] = {}
    for log in sorted((run / "logs").glob("*.mcap")):
        hashes = {}
        with log.open("rb") as stream:
            for _schema, channel, message in make_reader(stream).iter_messages(log_time_order=False):
                topic = hashes.setdefault(channel.topic, hashlib.sha256())
                topic.update(message.log_time.to_bytes(8, "little") + message.data)
        found |= {f"{log.stem}{topic}": value.hexdigest() for topic, value in hashes.items()}
    return found


def _weights(run: Path) -> dict[str, str]:
    """sha256 of every tensor of every checkpoint."""
    found = {}
    for file in sorted((run / "checkpoints").glob("step_*/*.safetensors")):
        content = file.read_bytes()
        begin = 8 + int.from_bytes(content[:8], "little")
        for name, tensor in json.loads(content[8:begin]).items():
            if name != "__metadata__":
                first, last = (begin + offset for offset in tensor["data_offsets"])
                value = hashlib.sha256(f"{tensor['dtype']}{tensor['shape']}".encode() + content[first:last])
                found[f"{file.parent.name}/{file.stem}/{name}"] = value.hexdigest()
    return found


def _speed(job: Job, ours: Side, theirs: Side, commit: str, num_envs: int) -> list[Row]:
    """Steps and starts of pairs of processes, in turns. A process keeps for its life the few per cent that
    its place in memory gives or takes, so pairs are counted, not turns. Kernels are compiled by then."""
    world, sensors = _WORLDS[0]
    steps, turns = (5, 2) if job.quick else (20, 10)
    both = (ours, theirs)
    samples: dict[Side, list[float]] = {side: [] for side in both}
    begun: dict[Side, list[float]] = {side: [] for side in both}
    ratios = []
    for pair in range(2 if job.quick else _PAIRS):
        order = both if pair % 2 else both[::-1]
        players = {side: Player(side, "speed", world, sensors, str(num_envs), threads=1) for side in order}
        taken: dict[Side, list[float]] = {side: [] for side in both}
        for turn in range(turns):
            for side in order if turn % 2 else order[::-1]:
                taken[side].append(players[side].seconds(steps))
        for side, player in players.items():
            begun[side].append(player.start_s)
            samples[side] += taken[side]
            player.close()
        ratios.append(statistics.median(taken[theirs]) / statistics.median(taken[ours]))
    rate = [len(samples[side]) * steps * num_envs / sum(samples[side]) for side in both]
    start = [statistics.median(begun[side]) for side in both]
    low, middle, high = _median_interval(ratios)
    note = f"{len(ratios)} pairs of processes: median {middle:.3f} x ({low:.3f} to {high:.3f})"
    return [
        Row(f"{world}, {num_envs} vehicles, tree alone, one thread", rate[0], "env-steps/CPU s", rate[1],
            commit, floor=0.98, floor_on="ratio", note=note,
            details={"ours_s": samples[ours], "theirs_s": samples[theirs], "pairs": ratios}),
        Row("start with cached kernels, to the end of the first step", start[0], "CPU s", start[1], commit,
            less_is_better=True, floor=0.98, floor_on="ratio",
            details={"ours": begun[ours], "theirs": begun[theirs]}),
    ]  # fmt: skip


def _logging(job: Job, sides: tuple[Side, Side], commit: str, command: list[str]) -> list[Row]:
    """CPU time of an evaluation that records all that it plays, in turns, and the bytes of its logs."""
    spent: list[list[float]] = [[], []]
    for turn in range(1 if job.quick else _LOGS):
        for i in (0, 1) if turn % 2 else (1, 0):
            begun = _children_s()
            sides[i].uuv(command, f"eval{turn}")
            spent[i].append(_children_s() - begun)
    sizes = [sum(log.stat().st_size for log in (side.folder / "eval0/logs").glob("*.mcap")) for side in sides]
    ours, theirs = map(statistics.median, spent)
    details = {"ours_s": spent[0], "theirs_s": spent[1]}
    return [
        Row("uuv eval that writes two logs", ours, "CPU s", theirs, commit, less_is_better=True,
            details=details),
        Row("their size", sizes[0] / 1e6, "MB", sizes[1] / 1e6, commit, less_is_better=True),
    ]  # fmt: skip


def _children_s() -> float:
    """CPU seconds of all processes that were waited for."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _median_interval(values: list[float]) -> tuple[float, float, float]:
    """(low end, median, high end): ranks that hold the median with 95 %."""
    ordered, aside = sorted(values), 0.98 * math.sqrt(len(values))
    low, high = (round(0.5 * len(values) + way * aside) for way in (-1, 1))
    return ordered[max(low, 0)], statistics.median(ordered), ordered[min(high, len(values) - 1)]


class Player:
    """A process that steps when it is asked to; ``start_s``: CPU time up to its first step."""

    def __init__(self, side: Side, *arguments: str, threads: int = 0) -> None:
        """``arguments`` of ``played.py``; ``threads`` 0: all cores."""
        limits = ("UUV_NUM_THREADS", "OMP_NUM_THREADS") if threads else ()
        self.process = subprocess.Popen(
            side.played(*arguments),
            env={**side.environment, **dict.fromkeys(limits, str(threads))},
            cwd=side.tree,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.start_s = self._answer("ready")

    def seconds(self, steps: int) -> float:
        """What so many steps took [s]."""
        assert self.process.stdin
        self.process.stdin.write(f"{steps}\n")
        self.process.stdin.flush()
        return self._answer("steps")

    def close(self) -> None:
        """End the process."""
        self.process.communicate()

    def _answer(self, word: str) -> float:
        assert self.process.stdout
        for line in self.process.stdout:
            if line.startswith(word):
                return float(line.split()[1])
        raise RuntimeError(f"played.py ended with {self.process.wait()}")
