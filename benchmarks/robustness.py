"""Kills, signals and damaged files: is anything lost, half-written or told by a traceback?

SIGKILL at random moments of training, evaluation, sweep and export: what is resumed must end as an
undisturbed run does. SIGINT and SIGTERM at random moments of every command: its exit code, no half of a file,
a consistent folder. Files with random damage: an answer or a refusal, within 60 s and 1 GiB, and nothing
written elsewhere.
"""

from __future__ import annotations

import json
import math
import os
import random
import resource
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from benchmarks.common import Job, Row

LONGEST_S = 28800
"""the whole of it, on two cores"""
_ROOT = Path(__file__).resolve().parent.parent
_SEED = 20261122
_KILLS = {"train": 60, "eval": 40, "sweep": 10, "export": 20}
_SIGNALS, _FILES = 100, 300
_TRAIN = [
    *("train", "smoke", "--device", "cpu", "--iterations", "20"),
    *("--set", "train.checkpoint_every=2", "--set", "train.evaluate_every=10"),
]
_EVAL = [
    *("eval", "--agent", "straight,bt", "--seeds", "77", "--num-envs", "8", "--device", "cpu"),
    *("--set", "episode.horizon_steps=400", "--set", "world.dynamic_capacity=9"),
]
_SWEEP = [
    *("sweep", "--grid", "S=4,8", "--grid", "D=3,6", "--grid", "v=0.6", "--agent", "straight"),
    *("--agent", "bt", "--num-envs", "8"),
]
_HALF = (".tmp", ".part", ".tmp.mp4")
_TIMES = ("wall_s", "env_steps_per_s")
_LONGEST_S, _MOST_BYTES = 60.0, 1 << 30


def measure(job: Job) -> list[Row]:
    """Violations of each kind; a violation is shown as it is found."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background ignores Ctrl-C
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder), job)
        found = [*bench.killed(), *bench.signalled(), *bench.damaged()]
        found += remade(12 if job.quick else 200)
    return [*found, *starts(job)]  # last: Taichi's threads do not survive a fork


# ---------------------------------------------------------------------------------------- starts of uuv pilot

_WRONG = {"right": (0.0, 0.0), "0.5 m": (0.5, 0.0), "15 degrees": (0.0, 15.0), "both": (0.5, 15.0)}
"""by how much typed starts and headings are wrong, in directions drawn at random"""
_RESTS_S, _TURNS_RAD_S = 4.0, 0.35
"""the vehicle rests, then its operator turns it around"""


def starts(
    job: Job, world: str = "pool", sensors: str = "multibeam", overrides: dict[str, Any] | None = None
) -> Iterator[Row]:
    """Starts typed rightly and wrongly, and what the fix makes of them, from the scans of the simulated sonar
    as MAVLink tells them."""
    ends = _starts_fixed(world, sensors, 4 if job.quick else 50, overrides or {})
    for kind, found in ends.items():
        count, n = Counter(end for end, *_ in found), len(found)
        for end, told, *_ in found:
            if end != "fixed":
                job.say(f"{world}, {sensors}: start wrong by {kind}: {end}: {told}")
        fixed = [numbers for end, _, *numbers in found if end == "fixed"] or [(math.nan,) * 3]
        worst = [max(column) for column in zip(*fixed, strict=True)]
        note = f"worst {worst[0]:.2f} m, {worst[1]:.1f} degrees; last after {worst[2]:.0f} s, "
        note += f"{sum(numbers[2] <= _RESTS_S for numbers in fixed)} before it was turned"
        row = f"{world}, {sensors}: start, {kind}" + (" wrong" if kind != "right" else "")
        least = n if kind == "right" else round(0.9 * n)
        yield Row(
            f"{row}: fixed within 0.1 m and 2 degrees", count["fixed"], f"of {n}", floor=least, note=note
        )
        yield Row(f"{row}: wrong and accepted", count["wrong"], f"of {n}", less_is_better=True, floor=0)


def _starts_fixed(
    world: str, sensors: str, n: int, overrides: dict[str, Any]
) -> dict[str, list[tuple[str, str, float, float, float]]]:
    """By kind, of every start: fixed, wrong or refused; what was found; off by [m, degrees]; after [s]."""
    import torch

    from uuvtai.config.loader import load_config
    from uuvtai.sim.behavior_tree import read_tree
    from uuvtai.sim.sim import Sim
    from uuvtai.vehicle.start_fix import LONGEST_S, StartFix

    config = load_config(world, sensors, overrides={"sensors.localization": "truth", **overrides})
    sim, rng = Sim(config, n, read_tree("straight")), random.Random(_SEED)
    ones, action, dt = torch.ones(n, dtype=torch.int32), torch.zeros(n, 4), config.episode.control_dt_s
    sim.reset(ones, 77 * ones, torch.arange(n, dtype=torch.int32))
    memory = sim.memory()
    views = memory.views(memory.read(), scratch=True)
    waiting, ends = [], {kind: [("", "", 0.0, 0.0, 0.0)] * n for kind in _WRONG}
    for kind, (metres, degrees) in _WRONG.items():
        for row, (x, y, z) in enumerate(views["vehicle.pos_w"][:n].tolist()):
            way, turn = rng.uniform(0, math.tau), rng.choice((-1, 1)) * math.radians(degrees)
            typed = x + metres * math.cos(way), y + metres * math.sin(way), z
            waiting.append((kind, row, turn, StartFix(config, typed)))
    for step in range(round((LONGEST_S + 2.0) / dt)):
        if step:
            action[:, 3] = (step * dt > _RESTS_S) * _TURNS_RAD_S / config.vehicle.max_yaw_rate_rad_s
            sim.step(action)
        told = [_told(config, views, row) for row in range(n)]
        for kind, row, turn, fix in waiting:
            for message in told[row](turn):
                fix.feed(message)
            if found := fix.result:
                truth, yaw = views["vehicle.pos_w"][row], float(views["ego.imu_rpy"][row][2])
                off_m, off = math.dist(found.place, truth[:2]), abs(math.degrees(found.turn_rad + turn))
                said = f"start {truth[:2].round(2)}, yaw {yaw:.2f}, after {step * dt:.1f} s: "
                end = "refused" if found.refusal else "fixed" if off_m < 0.1 and off < 2.0 else "wrong"
                said += found.refusal or f"off by {off_m:.2f} m and {off:.1f} degrees"
                ends[kind][row] = end, said, off_m, off, step * dt
        waiting = [row for row in waiting if row[-1].result is None]
        if not waiting:
            break
    return ends


def _told(config: Any, views: dict[str, Any], row: int) -> Callable[[float], list[Any]]:
    """What a vehicle's sensors say in this step, as messages of the pilot; the yaw wrong by what is asked."""
    import numpy as np

    from uuvtai.vehicle.onboard import DvlReading, ImuReading, SonarPing
    from uuvtai.vehicle.telemetry import ping_of, sectors_of

    sonar, dt, step = config.sensors.sonar, config.episode.control_dt_s, int(views["clock.step"][row])
    now_s, rpy, rest = step * dt, views["ego.imu_rpy"][row].copy(), []
    if views["ego.dvl_fresh"][row] and step % 5 == 0:
        rest.append(DvlReading(now_s, views["ego.dvl_b"][row].copy()))
    if views["scan.fresh"][row] and (step % 5 == 0 or sonar.mechanical):
        ranges, hit = (views[f"scan.{name}"][row][: sonar.n_ray] for name in ("range_m", "hit"))
        ping_s = float(views["scan.ping_step"][row]) * dt
        if sonar.mechanical:
            first = int(views["scan.new_from"][row])
            beams = (first + np.arange(int(views["scan.new_count"][row]))) % sonar.n_ray
            rest.append(SonarPing(ping_s, ranges[beams], hit[beams], np.zeros(0), first))
        else:
            distances, increment, offset = sectors_of(sonar, ranges, hit)
            reach = round(100 * sonar.max_range_m)
            ping = ping_of(sonar, ping_s, np.array(distances), increment, offset, 1, reach)
            rest += [ping] if isinstance(ping, SonarPing) else []
    zero = np.zeros(3)
    return lambda turn: [ImuReading(now_s, rpy + np.array([0.0, 0.0, turn]), zero, zero), *rest]


class Bench:
    """All parts in one folder: what one of them makes the next ones read."""

    def __init__(self, folder: Path, job: Job) -> None:
        self.folder, self.job, self.random = folder, job, random.Random(_SEED)
        self.times: dict[str, float] = {}
        """[s] that commands took"""

    # ------------------------------------------------------------------------------------------------ SIGKILL

    def killed(self) -> Iterator[Row]:
        """Every command resumed after every kill, and its result that of an undisturbed one."""
        episodes, record = ("8", "2") if self.job.quick else ("24", "6")
        evaluate = [*_EVAL, "--episodes", episodes, "--record", record, "--depth-images"]
        sweep = [*_SWEEP, "--episodes", "4" if self.job.quick else "48"]
        cases = (
            ("train", _TRAIN, "checkpoints/step_*", _newest_checkpoint),
            ("eval", evaluate, "eval/request.json", _result),
            ("sweep", sweep, "sweep_request.json", lambda run: _read(run / "sweep.json")["cells"]),
        )
        for name, begin, begun, result in cases:
            yield self._resumed(name, begin, begun, result)
        wrong = []
        for _ in self._kills("export", ["export", "train_whole", "--out"]):
            again = self.folder / "again"
            if again.exists() and self._run(["export", "--check", "again"])[0]:
                wrong.append("a folder that does not agree")
            shutil.rmtree(again, ignore_errors=True)
        yield self._row("export killed: halves under its name", wrong)

    def _resumed(self, name: str, begin: list[str], begun: str, result: Callable[[Path], Any]) -> Row:
        """``begun``: a file that is there once a run can be resumed."""
        place, wrong = self.folder / "again", []

        def command() -> list[str]:
            if _status(place) == "finished" or not any(place.glob(begun)):
                shutil.rmtree(place, ignore_errors=True)
                return [*begin, "--run-dir", "again"]
            return [name, "--resume", "again", *(_TRAIN[4:6] if name == "train" else ())]

        def ended() -> list[str]:
            return [] if result(place) == wanted else ["the result differs"]

        wanted = None
        for _ in self._kills(name, [*begin, "--run-dir"], command):
            wanted = wanted or result(self.folder / f"{name}_whole")
            wrong += ended() if _status(place) == "finished" else self._unreadable(place)
        if _status(place) != "finished":
            self._uuv(command())
        wrong += ended() + _half_written(place)
        shutil.rmtree(place)
        return self._row(f"{name} killed and resumed: other results, unreadable logs, halves left", wrong)

    def _kills(
        self, name: str, begin: list[str], command: Callable[[], list[str]] | None = None
    ) -> Iterator[None]:
        """After every try to kill, until enough have hit; ``begin`` ends in the option of a folder. An
        undisturbed run lies in ``NAME_whole``."""
        self._uuv([*begin, f"{name}_whole"])  # may compile kernels
        whole_s, hit = self._uuv([*begin, f"{name}_timed"]), 0
        while hit < (2 if self.job.quick else _KILLS[name]):
            words = command() if command else [*begin, "again"]
            child = self._begun(words)
            try:
                _, err = child.communicate(timeout=self.random.uniform(0.0, 1.1 * whole_s))
                if child.returncode:
                    raise RuntimeError(f"uuv {' '.join(words)}: exit code {child.returncode}\n{err}")
            except subprocess.TimeoutExpired:
                child.kill()
                child.communicate()
                hit += 1
            yield
        self.job.say(f"{name}: {hit} kills")

    def _unreadable(self, place: Path) -> list[str]:
        """Of the finished logs one that ``uuv log info`` cannot read, of those under way one that ``uuv log
        repair`` cannot."""
        wrong = []
        for log in sorted((place / "logs").glob("*.mcap"))[-1:]:
            wrong += [f"{log.name}: unreadable"] if self._run(["log", "info", str(log)])[0] else []
        for part in [p for p in sorted((place / "logs").glob("*.part")) if p.stat().st_size > 100_000][-1:]:
            code, _ = self._run(["log", "repair", str(part), "--out", "repaired.mcap"])
            wrong += [f"{part.name}: beyond repair"] if code else []
            (self.folder / "repaired.mcap").unlink(missing_ok=True)
        return wrong

    # ------------------------------------------------------------------------------------- SIGINT and SIGTERM

    def signalled(self) -> list[Row]:
        """Every command in turn, one of the two signals at a random moment of it."""
        log = str(next((self.folder / "eval_whole/logs").glob("*.mcap")))
        run = ["--run-dir", "out"]
        commands = [
            [*_EVAL, "--episodes", "8", "--record", "1", *run], [*_TRAIN, *run],
            [*_SWEEP, "--episodes", "4", *run],
            ["simulate", "--seconds", "20"], ["report", "eval_whole", "--out", "out/page.html"],
            ["report", "eval_whole", "--paper", "out/paper"],
            ["export", "train_whole", "--out", "out/policy"],
            ["profile", "--num-envs", "8", "--seconds", "1"], ["reproduce", *run], ["replay", log],
            ["presets"], ["doctor"], ["log", "info", log], ["log", "repair", log, "--out", "out/log.mcap"],
            ["log", "render", log, "--out", "out/log.png"], ["log", "render", log, "--out", "out/log.mp4"],
        ]  # fmt: skip
        wrong, interrupted, count = [], 0, len(commands) if self.job.quick else _SIGNALS
        for i in range(count):
            command = commands[i % len(commands)]
            number = (signal.SIGINT, signal.SIGTERM)[i // len(commands) % 2]
            code, wrongs = self._signal(command, number)
            interrupted += code == 128 + number
            wrong += [f"{' '.join(command)}: {what}" for what in wrongs]
        what = f"{count} signals, every command in turn: tracebacks, other exit codes, halves"
        return [self._row(what, wrong), Row("signals that hit a command at work", interrupted, f"of {count}")]

    def _signal(self, command: list[str], number: int) -> tuple[int, list[str]]:
        out = self.folder / "out"
        shutil.rmtree(out, ignore_errors=True)
        if "--run-dir" not in command:
            out.mkdir()
        key, begun = " ".join(command[:2]), time.monotonic()
        child, wanted = self._begun(command), [0]
        while child.poll() is None and not _hears(child.pid):
            time.sleep(0.002)  # what Python does before our first line is not ours
        longest = 20.0 if command[0] == "reproduce" else self.times.get(key, 40.0)
        try:
            _, err = child.communicate(timeout=self.random.uniform(0.0, longest))
            self.times[key] = time.monotonic() - begun
        except subprocess.TimeoutExpired:
            child.send_signal(number)
            wanted = [128 + number, 0]
            try:
                _, err = child.communicate(timeout=15 * _LONGEST_S)
            except subprocess.TimeoutExpired:
                child.kill()
                child.communicate()
                return -9, ["did not end"]
        code = child.returncode
        wrong = [f"exit code {code}: {err[-300:]}"] if code not in wanted else []
        wrong += [err[-600:]] if "Traceback" in err or "a bug of ours" in err else []
        return code, wrong + _half_written(out, parts=command[0] == "eval") + _inconsistent(out, code)

    # ------------------------------------------------------------------------------------------ damaged files

    def damaged(self) -> Iterator[Row]:
        """A row for each kind of file; every file that ended badly is kept in the temporary folder."""
        import torch  # noqa: F401 - here, so that the processes of the cases need not import it

        import uuvtai.cli  # noqa: F401

        self._uuv(["export", "train_whole", "--out", "exported", "--force"])
        presets = _ROOT / "uuvtai/presets"
        log = next((self.folder / "eval_whole/logs").glob("*.mcap"))
        kinds: dict[str, tuple[list[Path], list[list[str]]]] = {
            "logs": ([log], [["log", "info", "FILE"], ["log", "export", "FILE", "--out", "out"],
            ["log", "repair", "FILE", "--out", "whole.mcap"], ["log", "render", "FILE", "--out", "a.png"]]),
            "presets": (sorted(presets.rglob("*.yaml")),
            [["presets", "show", "FILE"], ["eval", "--world", "FILE", "--agent", "nobody"]]),
            "trees": (sorted(presets.rglob("*.xml")),
            [["eval", "--agent", "FILE", "--agent", "nobody"]]),
            "evaluations": (_whole(self.folder / "eval_whole"), [["report", "."]]),
            "trainings": (_whole(self.folder / "train_whole"), [["export", ".", "--out", "out"]]),
            "policies": (_whole(self.folder / "exported"), [["export", "--check", "."]]),
        }  # fmt: skip
        for kind, (files, commands) in kinds.items():
            ends: Counter[str] = Counter()
            for i in range(4 if self.job.quick else _FILES):
                self.random.seed(f"{_SEED} {kind} {i}")
                end, told = self._judged(self.random.choice(files), self.random.choice(commands))
                ends[end] += 1
                if end not in ("accepted", "refused"):
                    kept = Path(tempfile.gettempdir()) / "robustness" / f"{kind}_{i}"
                    shutil.copytree(self.folder / "case", kept, dirs_exist_ok=True)
                    self.job.say(f"VIOLATION {kept}: {end}: {told[-300:]}")
            bad = ends.total() - ends["accepted"] - ends["refused"]
            note = ", ".join(f"{end} {number}" for end, number in sorted(ends.items()))
            what, unit = f"damaged {kind}: ended badly", f"of {ends.total()}"
            yield Row(what, bad, unit, less_is_better=True, floor=0, note=note)

    def _judged(self, file: Path, command: list[str]) -> tuple[str, str]:
        """(how it ended, what was told) of a command on one damaged file, in its folder."""
        case = self.folder / "case"
        shutil.rmtree(case, ignore_errors=True)
        inside = file.is_relative_to(self.folder) and "FILE" not in command
        if inside:
            top = self.folder / file.relative_to(self.folder).parts[0]
            shutil.copytree(top, case, ignore=shutil.ignore_patterns("*.mcap", ".lock"))
        case.mkdir(exist_ok=True)
        name = file.relative_to(top) if inside else f"file{file.suffix}"
        (case / name).write_bytes(_mutated(file.read_bytes(), self.random))
        elsewhere = _sizes(self.folder, case)
        words = [str(name) if word == "FILE" else word for word in command]
        code, told, peak = _forked(words, case)
        told = f"uuv {' '.join(words)}: {code}: {told}"
        if code is None:
            return "hang", told
        if peak > _MOST_BYTES:
            return f"{peak >> 20} MiB", told
        if _sizes(self.folder, case) != elsewhere:
            return "wrote elsewhere", told
        if code not in (0, 2, 3) or "Traceback" in told or "a bug of ours" in told:
            return "bug", told
        return ("accepted" if code == 0 else "refused"), told

    # ----------------------------------------------------------------------------------------------- commands

    def _begun(self, command: list[str]) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-m", "uuvtai", *command], cwd=self.folder, text=True,
            env=os.environ | {"PYTHONPATH": str(_ROOT)}, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        )  # fmt: skip

    def _run(self, command: list[str]) -> tuple[int, str]:
        child = self._begun(command)
        _, err = child.communicate()
        return child.returncode, err

    def _uuv(self, command: list[str]) -> float:
        """Seconds that it took. Raises RuntimeError where it fails."""
        begun = time.monotonic()
        code, err = self._run(command)
        if code:
            raise RuntimeError(f"uuv {' '.join(command)}: exit code {code}\n{err}")
        return time.monotonic() - begun

    def _row(self, what: str, wrong: list[str]) -> Row:
        for text in wrong:
            self.job.say(f"VIOLATION {text}")
        self.job.say(f"{what}: {len(wrong)}")
        details = {"violations": wrong, "seed": _SEED}
        return Row(what, len(wrong), "violations", less_is_better=True, floor=0, details=details)


# ---------------------------------------------------------------------------------------------------- folders


def _read(path: Path) -> Any:
    return json.loads(path.read_text())


def _status(place: Path) -> str | None:
    file = place / "run.json"
    return _read(file)["status"] if file.exists() else None


def _newest_checkpoint(run: Path) -> dict[str, bytes]:
    """Its files by name, but for the manifest, which has times."""
    newest = max((run / "checkpoints").glob("step_*"), key=lambda path: int(path.name.partition("_")[2]))
    return {file.name: file.read_bytes() for file in newest.iterdir() if file.name != "manifest.json"}


def _result(run: Path) -> dict[str, Any]:
    """The document of an evaluation without the machine's times."""
    document = _read(run / "eval/result.json")
    for agent in document["agents"]:
        for name in _TIMES:
            agent.pop(name)
    return document


def _half_written(place: Path, parts: bool = False) -> list[str]:
    """Temporary files; of an evaluation that was interrupted ``.part`` files may stay, and it says so."""
    return [
        f"left {path.name}"
        for path in place.rglob("*")
        if (path.name.endswith(_HALF) or path.name.startswith(".partial"))
        and not (parts and path.name.endswith(".part"))
    ]


def _inconsistent(place: Path, code: int) -> list[str]:
    """Files that cannot be read, and a run folder that says otherwise than the exit code."""
    wrong = []
    for file in place.rglob("*.json"):
        try:
            _read(file)
        except ValueError:
            wrong.append(f"{file.name} is not whole")
    ends = {0: "finished", 130: "interrupted", 143: "interrupted"}
    status = _status(place)
    if status is not None and status != ends.get(code, "failed"):
        wrong.append(f"run.json says {status}, exit code {code}")
    return wrong


def _whole(folder: Path) -> list[Path]:
    """Files of a folder that are damaged one at a time."""
    return sorted(path for path in folder.rglob("*") if path.is_file() and path.suffix not in ("", ".mcap"))


def _sizes(folder: Path, without: Path) -> dict[Path, tuple[int, int]]:
    """Size and time of change of every file below ``folder`` that does not lie in ``without``."""
    files = [path for path in folder.rglob("*") if path.is_file() and without not in path.parents]
    return {path: (path.stat().st_size, path.stat().st_mtime_ns) for path in files}


# -------------------------------------------------------------------------------------------------- processes


def _hears(pid: int) -> bool:
    """Whether a process has a handler of SIGTERM (Linux)."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return False
    caught = next((line.split()[1] for line in lines if line.startswith("SigCgt:")), "0")
    return bool(int(caught, 16) >> (signal.SIGTERM - 1) & 1)


def _forked(words: list[str], folder: Path) -> tuple[int | None, str, int]:
    """(exit code or None where it hangs, stderr, bytes that it took more than this process has)."""
    told = folder.parent / "told.txt"
    begun, pid = time.monotonic(), os.fork()
    if pid == 0:
        _be_uuv(words, folder, told)
    while True:
        ended, status, used = os.wait4(pid, os.WNOHANG)
        if ended or time.monotonic() - begun > _LONGEST_S:
            break
        time.sleep(0.002)
    if not ended:
        os.kill(pid, signal.SIGKILL)
        os.wait4(pid, 0)
    text = told.read_text(errors="replace")
    told.unlink()
    more = 1024 * (used.ru_maxrss - resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    return (os.waitstatus_to_exitcode(status) if ended else None), text, more


def _be_uuv(words: list[str], folder: Path, told: Path) -> None:
    """The rest of a forked process: a command, its stderr in a file."""
    code = 70
    try:
        os.chdir(folder)
        os.dup2(os.open(os.devnull, os.O_RDWR), 1)
        os.dup2(os.open(told, os.O_WRONLY | os.O_CREAT), 2)
        from uuvtai.cli import main

        main(words)
    except SystemExit as left:
        code = left.code if isinstance(left.code, int) else 70
    finally:
        sys.stderr.flush()
        os._exit(code)


# ----------------------------------------------------------------------------------------------------- memory


def remade(rounds: int = 200) -> Iterator[Row]:
    """Environments made, driven and closed, at 2 and at 64 envs."""
    for n_env in (2, 64):
        grown = memory_growth_mib(n_env, rounds, sensors="multibeam", vehicle="bluerov2_16v")
        what = f"{rounds} environments of {n_env} made and closed: memory that was not given back"
        yield Row(what, grown, "MiB", less_is_better=True, floor=_MOST_GROWTH_MIB)


_MOST_GROWTH_MIB = 50.0


def memory_growth_mib(n_env: int, rounds: int, **options: Any) -> float:
    """What this process holds more after so many environments than after three, each driven for ten steps;
    ``options``: of ``uuvtai.make``."""
    import gc

    import torch

    import uuvtai

    held = []
    for _ in range(3 + rounds):
        with uuvtai.make(num_envs=n_env, **options) as env:
            env.reset()
            for _ in range(10):
                env.step(torch.zeros(n_env, 4))
        del env
        gc.collect()
        held.append(int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 2**20)
    return held[-1] - held[2]


# ----------------------------------------------------------------------------------------------------- damage

_NUMBERS = (0, 1, 0x7F, 0xFF, 1 << 15, 1 << 31, (1 << 32) - 1, 1 << 62, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)
_WORDS = (
    *(b"1e999", b"-1e308", b"NaN", b"Infinity", b"9" * 400, b"null", b"[" * 5000, b"{" * 5000),
    *(b"\xff\xfe", b"&a", b"!!x", b"<a>" * 500),
)


def _mutated(content: bytes, generator: random.Random) -> bytes:
    """One to four changes: bits, cuts, ranges doubled, deleted, exchanged, lengths and numbers beyond all
    bounds."""
    data = bytearray(content)
    for _ in range(generator.choice((1, 1, 2, 4))):
        at, long = generator.randrange(len(data) + 1), generator.choice((1, 8, 64, 4096))
        match generator.randrange(7):
            case 0:
                for place in generator.sample(range(len(data)), min(len(data), generator.choice((1, 8)))):
                    data[place] ^= 1 << generator.randrange(8)
            case 1:
                del data[at:]
            case 2:
                data[at:at] = data[at : at + long] * generator.choice((1, 2, 100))
            case 3:
                del data[at : at + long]
            case 4:
                data[at : at + 8] = struct.pack("<Q", generator.choice(_NUMBERS))
            case 5:
                data[at : at + long] = generator.randbytes(long)
            case _:
                data[at : at + generator.choice((0, 1, 8))] = generator.choice(_WORDS)
    return bytes(data)
