"""SIGKILL at random moments of the commands that write most: is anything lost or half-written? ``interrupts``
sends the signals that a command can hear."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.common import Job, Row

LONGEST_S = 14400
"""the whole of it, on two cores"""
_ROOT = Path(__file__).resolve().parent.parent
_DONE = _ROOT / "build" / "signals.jsonl"
"""one finished part a line"""
_SEED = 20261122
_KILLS = {"train": 100, "eval": 50, "export": 25, "report": 25}
_QUICK = {"train": 3, "eval": 3, "export": 2, "report": 2}
_ONE_S = 900.0
_TRAIN = [
    "train",
    "smoke",
    "--device",
    "cpu",
    "--set",
    "train.checkpoint_every=2",
    "--set",
    "train.evaluate_every=10",
]
_ITERATIONS = ["--iterations", "20"]
_EVAL = ["eval", "--controller", "straight,bt", "--seeds", "77", "--num-envs", "8", "--device", "cpu"]
_HORIZON = ["--set", "episode.horizon_steps=400", "--set", "world.dynamic_capacity=9"]
_HALF = (".tmp", ".part", ".partial", ".repairing", ".part.webm")
_TIMES = ("wall_s", "env_steps_per_s")


def measure(job: Job) -> list[Row]:
    """Violations of each kind; a violation is shown as it is found. Parts that an earlier run finished are
    not done again while the package and this file are as they were."""
    counts = _QUICK if job.quick else _KILLS
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder), job)
        parts = {
            "train": bench.killed_train, "eval": bench.killed_eval, "export": bench.killed_export,
            "report": bench.killed_report,
        }  # fmt: skip
        key, found = _key(), []
        done = {} if job.quick else _finished(key)
        for name, part in parts.items():
            if name in done:
                job.say(f"{name}: known from an earlier run")
                rows = [Row(**row) for row in done[name]]
            else:
                rows = part(counts[name])
                if not job.quick:
                    _keep({"key": key, "part": name, "rows": [dataclasses.asdict(row) for row in rows]})
            found += rows
        return found


def _key() -> str:
    """sha256 of what the results are about."""
    files = [Path(__file__), *sorted((_ROOT / "uuvtai").rglob("*.py"))]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def _finished(key: str) -> dict[str, list[dict[str, Any]]]:
    lines = _DONE.read_text().splitlines() if _DONE.exists() else []
    kept = [json.loads(line) for line in lines]
    return {part["part"]: part["rows"] for part in kept if part["key"] == key}


def _keep(part: dict[str, Any]) -> None:
    _DONE.parent.mkdir(exist_ok=True)
    with _DONE.open("a") as stream:
        stream.write(json.dumps(part) + "\n")


class Bench:
    """All parts in one folder: what one of them makes the next ones read."""

    def __init__(self, folder: Path, job: Job) -> None:
        self.folder, self.job, self.random = folder, job, random.Random(_SEED)

    # ------------------------------------------------------------------------------------------------ SIGKILL

    def killed_train(self, kills: int) -> list[Row]:
        """Resume after every kill until so many have hit; the last checkpoint bit-equal to an undisturbed
        run's."""
        whole_s = self._whole([*_TRAIN, *_ITERATIONS], "whole")
        place, wrong, hit = self.folder / "killed", [], 0
        while hit < kills:
            if _done(place) or not any((place / "checkpoints").glob("step_*")):
                wrong += self._unequal(place) if _done(place) else []
                shutil.rmtree(place, ignore_errors=True)
                command = [*_TRAIN, *_ITERATIONS, "--run-dir", "killed"]
            else:
                command = ["train", "--resume", "killed", *_ITERATIONS]
            hit += self._kill(command, whole_s)
        if not _done(place):
            begun = any((place / "checkpoints").glob("step_*"))
            if not begun:
                shutil.rmtree(place, ignore_errors=True)
            self._uuv(
                ["train", "--resume", "killed", *_ITERATIONS]
                if begun
                else [*_TRAIN, *_ITERATIONS, "--run-dir", "killed"]
            )
        wrong += self._unequal(place)
        return [
            self._row(
                f"train killed {hit} times and resumed: runs that end otherwise than undisturbed", wrong
            )
        ]

    def _unequal(self, place: Path) -> list[str]:
        ours, theirs = (
            max((run / "checkpoints").glob("step_*"), key=_step) for run in (place, self.folder / "whole")
        )
        names = {file.name for file in theirs.iterdir() if file.name != "manifest.json"}
        return [
            f"train: {name} differs"
            for name in sorted(names)
            if (ours / name).read_bytes() != (theirs / name).read_bytes()
        ]

    def killed_eval(self, kills: int) -> list[Row]:
        """Resume after every kill; the result that of an undisturbed evaluation, every log readable, nothing
        else half-written."""
        record = "2" if self.job.quick else "6"
        arguments = [*_EVAL, "--episodes", "8" if self.job.quick else "24", "--record", record, *_HORIZON]
        whole_s = self._whole(arguments, "played")
        wanted, wrong, hit, place = _result(self.folder / "played"), [], 0, self.folder / "eval"
        while hit < kills:
            if _done(place) or not (place / "eval/request.json").exists():
                shutil.rmtree(place, ignore_errors=True)
                command = [*arguments, "--run-dir", "eval"]
            else:
                command = ["eval", "--resume", "eval"]
            hit += self._kill(command, whole_s)
            wrong += self._unreadable(place)
            if _done(place) and _result(place) != wanted:
                wrong.append("eval: the result differs")
        if (place / "eval/request.json").exists():
            self._uuv(["eval", "--resume", "eval"])
            wrong += [] if _result(place) == wanted else ["eval: the result differs at the end"]
            wrong += _half_written(place)
        return [
            self._row(
                f"eval --record killed {hit} times and resumed: results that differ, unreadable logs, halves "
                "left",
                wrong,
            )
        ]

    def _unreadable(self, place: Path) -> list[str]:
        """One log of those under way that ``uuv log repair`` cannot read, and of the finished ones that ``log
        info`` cannot."""
        wrong = []
        for log in sorted((place / "logs").glob("*.mcap"))[-1:]:
            wrong += [f"{log.name}: unreadable"] if self._run(["log", "info", str(log)])[0] else []
        for part in [p for p in sorted((place / "logs").glob("*.part")) if p.stat().st_size > 100_000][-1:]:
            repaired = self.folder / "repaired.mcap"
            wrong += (
                [f"{part.name}: beyond repair"]
                if self._run(["log", "repair", str(part), "--out", str(repaired)])[0]
                else []
            )
            repaired.unlink(missing_ok=True)
        return wrong

    def killed_export(self, kills: int) -> list[Row]:
        """The folder is whole or not there, and the next try succeeds."""
        whole_s, wrong = self._whole(["export", "residual"], "exported", "--out"), []
        for _ in range(kills):
            self._kill(["export", "residual", "--out", "again"], whole_s)
            if (self.folder / "again").exists() and self._run(["export", "--check", "again"])[0]:
                wrong.append("export: a folder that does not agree")
            shutil.rmtree(self.folder / "again", ignore_errors=True)
        wrong += [
            f"export: {err}" for code, err in [self._run(["export", "residual", "--out", "again"])] if code
        ]
        return [self._row(f"export killed {kills} times: halves under its name", wrong)]

    def killed_report(self, kills: int) -> list[Row]:
        """The page is whole or not there, and the next try succeeds."""
        whole_s, wrong, page = (
            self._whole(["report", self._played()], "page.html", "--out", "--force"),
            [],
            self.folder / "played/report.html",
        )
        for _ in range(kills):
            page.unlink(missing_ok=True)
            self._kill(["report", "played"], whole_s)
            if page.exists() and not page.read_text(encoding="utf-8").rstrip().endswith("</html>"):
                wrong.append("report: half a page")
        wrong += [f"report: {err}" for code, err in [self._run(["report", "played"])] if code]
        return [self._row(f"report killed {kills} times: halves under its name", wrong)]

    def _kill(self, command: list[str], whole_s: float) -> bool:
        """Whether a kill at a random moment hit."""
        child = self._begun(command)
        moment = self.random.uniform(0.0, 1.1 * whole_s)
        try:
            _, err = child.communicate(timeout=moment)
        except subprocess.TimeoutExpired:
            child.kill()
            child.communicate()
            return True
        if child.returncode:
            raise RuntimeError(f"uuv {' '.join(command)}: exit code {child.returncode}\n{err}")
        return False

    # ------------------------------------------------------------------------------------- SIGINT and SIGTERM

    def signalled(self, count: int) -> list[Row]:
        """Every command in turn, one of the two signals at a random moment of it."""
        # a shell's background ignores Ctrl-C, and so would every command
        signal.signal(signal.SIGINT, signal.default_int_handler)
        log = next((self.folder / self._played() / "logs").glob("*.mcap"))
        commands = [
            [*_EVAL, "--episodes", "8", "--record", "1", *_HORIZON, "--run-dir", "out"],
            [*_TRAIN, "--iterations", "10", "--run-dir", "out"],
            ["simulate", "--seconds", "20"], ["report", "played", "--out", "out/page.html"],
            ["export", "residual", "--out", "out/policy"],
            ["sweep", "--grid", "D=0,3", "--controller", "straight", "--episodes", "4", "--num-envs", "8",
            "--run-dir", "out"],
            ["profile", "--num-envs", "8", "--seconds", "1"], ["presets"], ["doctor"], ["tree", "played"],
            ["log", "info", str(log)],
            ["log", "repair", str(log), "--out", "out/log.mcap"],
            ["log", "picture", str(log), "--out", "out/log.png"],
            ["log", "video", str(log), "--out", "out/log.webm"], ["reproduce", "--run-dir", "out"],
            ["replay", str(log)], ["report", "played", "--paper", "out/paper"],
            ["benchmark", "pool", "--controller", "straight", "--quick", "--run-dir", "out"],
        ]  # fmt: skip
        wrong, interrupted, times = [], 0, {}
        for i in range(count):
            command, number = (
                commands[i % len(commands)],
                (signal.SIGINT, signal.SIGTERM)[i // len(commands) % 2],
            )
            code, wrongs = self._signal(command, number, times)
            interrupted += code == 128 + number
            wrong += [f"{' '.join(command)}: {what}" for what in wrongs]
        return [
            self._row(
                f"{count} signals, every command in turn: tracebacks, other exit codes, halves, inconsistent "
                "folders",
                wrong,
            ),
            Row("signals that hit a command at work", interrupted, f"of {count}"),
        ]

    def _signal(self, command: list[str], number: int, times: dict[str, float]) -> tuple[int, list[str]]:
        out = self.folder / "out"
        shutil.rmtree(out, ignore_errors=True)
        if "--run-dir" not in command:
            out.mkdir()
        key, begun = " ".join(command[:2]), time.monotonic()
        child = self._begun(command)
        while child.poll() is None and not _on_main_thread(
            child.pid
        ):  # what Python does before our first line is not ours
            time.sleep(0.002)
        longest = 20.0 if command[0] == "reproduce" else times.get(key, 40.0)
        moment = self.random.uniform(0.0, longest)
        try:
            _, err = child.communicate(timeout=moment)
            times[key] = time.monotonic() - begun
            wanted = [0]
        except subprocess.TimeoutExpired:
            child.send_signal(number)
            try:
                _, err = child.communicate(timeout=_ONE_S)
            except subprocess.TimeoutExpired:
                child.kill()
                return -9, ["did not end"]
            wanted = [128 + number, 0]
        wrongs = (
            [f"exit code {child.returncode} after {moment:.2f} s: {err[-300:]}"]
            if child.returncode not in wanted
            else []
        )
        wrongs += (
            [f"after {moment:.2f} s: {err[-600:]}"] if "Traceback" in err or "a bug of ours" in err else []
        )
        wrongs += _half_written(out, parts=command[0] == "eval") + _inconsistent(out, child.returncode)
        return child.returncode, wrongs

    # ----------------------------------------------------------------------------------------------- commands

    def _begun(self, command: list[str]) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-m", "uuvtai", *command],
            cwd=self.folder,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )

    def _run(self, command: list[str]) -> tuple[int, str]:
        child = self._begun(command)
        _, err = child.communicate()
        return child.returncode, err

    def _uuv(self, command: list[str]) -> None:
        code, err = self._run(command)
        if code:
            raise RuntimeError(f"uuv {' '.join(command)}: exit code {code}\n{err}")

    def _played(self) -> str:
        """Folder of an evaluation, played where no part before has done so."""
        if not (self.folder / "played").exists():
            self._uuv(
                [
                    *_EVAL,
                    "--episodes",
                    "8",
                    "--record",
                    "2",
                    "--depth-images",
                    *_HORIZON,
                    "--run-dir",
                    "played",
                ]
            )
        return "played"

    def _whole(self, command: list[str], place: str, option: str = "--run-dir", *again: str) -> float:
        """Time of an undisturbed run [s]. It is run twice, into ``place`` and another one: the first run may
        compile kernels. ``again``: what the second one needs more."""
        self._uuv([*command, option, place])
        begun = time.monotonic()
        self._uuv([*command, option, f"timed_{place}", *again])
        took = time.monotonic() - begun
        self.job.say(f"undisturbed: uuv {' '.join(command[:2])}: {took:.0f} s")
        return took

    def _row(self, what: str, wrong: list[str]) -> Row:
        for text in wrong:
            self.job.say(f"VIOLATION {text}")
        self.job.say(f"{what}: {len(wrong)}")
        return Row(
            what,
            len(wrong),
            "violations",
            less_is_better=True,
            floor=0,
            details={"violations": wrong, "seed": _SEED},
        )


def _step(path: Path) -> int:
    return int(path.name.partition("_")[2])


def _done(place: Path) -> bool:
    return _status(place) == "finished"


def _status(place: Path) -> str | None:
    file = place / "run.json"
    return json.loads(file.read_text())["status"] if file.exists() else None


def _result(place: Path) -> dict[str, Any]:
    """The document without the machine's times."""
    document = json.loads((place / "eval/result.json").read_text())
    for method in document["methods"]:
        for name in _TIMES:
            method.pop(name)
    return document


def _half_written(place: Path, parts: bool = False) -> list[str]:
    """Temporary files; of an evaluation ``.mcap.part`` may stay, and it says so."""

    def halves(path: Path) -> bool:
        return path.name.endswith(_HALF) or path.name.startswith(".partial")

    return [
        f"left {path.name}"
        for path in place.rglob("*")
        if halves(path) and not (parts and path.name.endswith(".mcap.part"))
    ]


def _inconsistent(place: Path, code: int) -> list[str]:
    """Files that cannot be read, and a run folder that says otherwise than the exit code."""
    wrong = []
    for file in place.rglob("*.json"):
        try:
            json.loads(file.read_text())
        except ValueError:
            wrong.append(f"{file.name} is not whole")
    status = _status(place)
    if status is not None and status != {0: "finished", 130: "interrupted", 143: "interrupted"}.get(
        code, "failed"
    ):
        wrong.append(f"run.json says {status}, exit code {code}")
    return wrong


def _on_main_thread(pid: int) -> bool:
    """Whether a process has a handler of SIGTERM (Linux)."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return False
    caught = next((line.split()[1] for line in lines if line.startswith("SigCgt:")), "0")
    return bool(int(caught, 16) >> (signal.SIGTERM - 1) & 1)
