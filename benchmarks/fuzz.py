"""Thousands of damaged files of every kind that uuv opens: how many end in anything but an answer or a
refusal within 30 s and 1 GiB."""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from benchmarks.common import Job, Row

LONGEST_S = 14400
"""the whole of it, on two cores"""
_LONGEST_S, _MOST_BYTES = 30.0, 1 << 30
_SEED = 20261122
_COUNTS = {
    "mcap": 2000,
    "yaml": 250,
    "xml": 150,
    "json": 200,
    "safetensors": 150,
    "onnx": 150,
    "npz": 100,
    "command line": 500,
}
_QUICK = {
    "mcap": 20,
    "yaml": 4,
    "xml": 4,
    "json": 4,
    "safetensors": 4,
    "onnx": 2,
    "npz": 4,
    "command line": 4,
}
_EXTREMES = (
    0,
    1,
    0x7F,
    0xFF,
    1 << 15,
    1 << 31,
    (1 << 32) - 1,
    1 << 62,
    (1 << 63) - 1,
    1 << 63,
    (1 << 64) - 1,
)
_WORDS = (
    b"1e999",
    b"-1e308",
    b"NaN",
    b"Infinity",
    b"9" * 400,
    b"null",
    b"[" * 5000,
    b"{" * 5000,
    b"\xff\xfe",
    b"&a",
    b"!!x",
    b"<a>" * 500,
)
_BAD = ("bug", "hang", "memory", "wrote outside")
_REPORT = "fuzz_findings"
"""folder in the temporary folder that keeps every file that was not answered as it should be"""


def measure(job: Job) -> list[Row]:
    """Counts by kind of file and by end; every file that ended badly is kept."""
    counts, found = (_QUICK if job.quick else _COUNTS), {}
    kept = Path(tempfile.gettempdir()) / _REPORT
    with tempfile.TemporaryDirectory() as folder:
        samples = _samples(Path(folder))
        worker = _Worker()
        for kind, number in counts.items():
            ends: Counter[str] = Counter()
            for i in range(number):
                generator = random.Random(f"{_SEED} {kind} {i}")
                end, output = (_by_command if kind == "command line" else worker.judged)(
                    kind, samples, generator, Path(folder)
                )
                ends[end] += 1
                if end in _BAD:
                    job.say(f"{kind} {i}: {end}: {output[-300:]}")
                    _keep(kept, Path(folder) / "case", f"{kind.replace(' ', '_')}_{i}", output)
            found[kind] = dict(ends)
            job.say(f"{kind}: {dict(ends)}")
        worker.stop()
    rows = []
    for kind, ends in found.items():
        bad = sum(ends.get(end, 0) for end in _BAD)
        note = ", ".join(f"{end} {n}" for end, n in sorted(ends.items()))
        rows.append(
            Row(
                f"{kind}: ended badly",
                bad,
                f"of {counts[kind]}",
                less_is_better=True,
                floor=0,
                note=note,
                details={"seed": _SEED},
            )
        )
    return rows


# ---------------------------------------------------------------------------------------------------- samples


def _samples(folder: Path) -> dict[str, list[bytes]]:
    """Whole files of every kind."""
    from tests import test_deploy as deployed
    from tests.reference import logs as episode
    from uuvtai.loader import preset_path
    from uuvtai.logs.mcap_log import McapEpisodeLog

    with McapEpisodeLog(folder / "a.mcap", episode.header(), depth_images=True) as log:
        for snap in episode.snapshots(20):
            log.write(snap)
        log.close(episode.result(20))
    saved = deployed.saved(folder / "run")
    deployed.exported(saved, folder / "exported")
    exported, presets = folder / "exported", preset_path("world", "pool").parents[1]
    found = {
        "mcap": [(folder / "a.mcap").read_bytes()],
        "yaml": [path.read_bytes() for path in sorted(presets.rglob("*.yaml"))],
        "xml": [path.read_bytes() for path in sorted(presets.rglob("*.xml"))],
        "json": [(exported / "policy_spec.json").read_bytes()],
        "safetensors": [(exported / "policy.safetensors").read_bytes()],
        "npz": [(exported / "golden.npz").read_bytes()],
    }
    found["onnx"] = (
        [(exported / "policy.onnx").read_bytes()] if (exported / "policy.onnx").exists() else [b""]
    )
    return found


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
                data[at : at + 8] = struct.pack("<Q", generator.choice(_EXTREMES))
            case 5:
                data[at : at + long] = generator.randbytes(long)
            case _:
                data[at : at + generator.choice((0, 1, 8))] = generator.choice(_WORDS)
    return bytes(data)


# ------------------------------------------------------------------------------------------------ in a worker


def _open(kind: str, path: Path, exported: Path) -> None:
    """What uuv does with such a file, as far as nothing is simulated."""
    from uuvtai.deploy import run_policy
    from uuvtai.deploy.agreement import of_onnx
    from uuvtai.loader import load_config
    from uuvtai.logs import log_export, reader, recording, repair
    from uuvtai.tree import read_tree

    golden = exported / "golden.npz"
    jobs = {
        "yaml": [lambda: load_config(str(path))],
        "xml": [lambda: read_tree(str(path))],
        "json": [
            lambda: run_policy.Policy(
                run_policy.read_spec(path.parent),
                run_policy.read_safetensors(exported / "policy.safetensors"),
            )
        ],
        "safetensors": [
            lambda: run_policy.Policy(run_policy.read_spec(exported), run_policy.read_safetensors(path))
        ],
        "onnx": [lambda: of_onnx(path.read_bytes(), run_policy.read_golden(golden))],
        "npz": [lambda: run_policy.replayed(run_policy.load(exported), run_policy.read_golden(path))],
        "mcap": [
            lambda: reader.info(path),
            lambda: recording.load_recording(path),
            lambda: repair.repair(path, path.parent / "repaired.mcap", force=True),
            *(
                lambda fmt=fmt: log_export.export(path, path.parent / f"out_{fmt}", fmt=fmt)
                for fmt in ("json", "csv", "npz")
            ),
        ],
    }
    refused = None
    for work in jobs[kind]:
        try:
            work()
        except Exception as error:
            if not _is_refusal(error):
                raise
            refused = error
    if refused is not None:
        raise refused


def _is_refusal(error: BaseException) -> bool:
    from uuvtai.deploy.run_policy import PolicyError
    from uuvtai.errors import UserError

    return isinstance(error, UserError | PolicyError)


def _serve(pipe: Connection) -> None:
    import traceback

    while (task := pipe.recv()) is not None:
        try:
            _open(*task)
            pipe.send(("accepted", ""))
        except Exception as error:
            refusal = _is_refusal(error) and len(str(error)) < 5000
            pipe.send(("refused", "") if refusal else ("bug", traceback.format_exc()))


class _Worker:
    """A process that opens files; it is replaced when one hangs."""

    def __init__(self) -> None:
        self._start()

    def judged(
        self, kind: str, samples: dict[str, list[bytes]], generator: random.Random, folder: Path
    ) -> tuple[str, str]:
        """(how it ended, what was told) of one mutated file."""
        case = _fresh(folder / "case")
        path = case / ("policy_spec.json" if kind == "json" else f"file.{kind}")
        path.write_bytes(_mutated(generator.choice(samples[kind]), generator))
        before, outside = self._peak(reset=True), _tree(folder, case)
        self._pipe.send((kind, path, folder / "exported"))
        try:
            end, output = self._pipe.recv() if self._pipe.poll(_LONGEST_S) else ("hang", "")
        except EOFError:
            end, output = "memory", "the process died"
        if end in ("hang", "memory"):
            self.stop(kill=True)
            self._start()
            return end, output
        if self._peak() - before > _MOST_BYTES:
            return "memory", f"{self._peak() - before} bytes"
        return ("wrote outside", str(path)) if _tree(folder, case) != outside else (end, output)

    def stop(self, kill: bool = False) -> None:
        """End the process."""
        if kill:
            self._process.kill()
        else:
            self._pipe.send(None)
        self._process.join()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs,), daemon=True)
        self._process.start()
        theirs.close()

    def _peak(self, reset: bool = False) -> int:
        """[bytes] resident at most since the last reset (Linux)."""
        place = Path(f"/proc/{self._process.pid}")
        if reset:
            (place / "clear_refs").write_text("5")
        line = next(
            (line for line in (place / "status").read_text().splitlines() if line.startswith("VmHWM")),
            "VmHWM: 0 kB",
        )
        return int(line.split()[1]) * 1024


# ---------------------------------------------------------------------------------------- by the command line

_COMMANDS: dict[str, list[list[str]]] = {
    "mcap": [
        ["log", name, "FILE", *rest]
        for name, *rest in (["info"], ["export", "--out", "out"], ["repair"], ["picture"], ["convert"])
    ],
    "xml": [["tree", "--controller", "FILE"]],
    "yaml": [["eval", "--world", "FILE", "--controller", "nobody"], ["presets", "show", "FILE"]],
    "json": [["export", "--check", "."], ["report", "."], ["train", "--resume", "."]],
    "safetensors": [["export", "--check", "."]],
}


def _by_command(
    _kind: str, samples: dict[str, list[bytes]], generator: random.Random, folder: Path
) -> tuple[str, str]:
    kind = generator.choice(sorted(_COMMANDS))
    command, case = generator.choice(_COMMANDS[kind]), _fresh(folder / "case")
    names = {"json": ["policy_spec.json", "run.json"], "safetensors": ["policy.safetensors"]}.get(
        kind, [f"file.{kind}"]
    )
    for name in names:
        (case / name).write_bytes(_mutated(generator.choice(samples[kind]), generator))
    outside, begun = _tree(folder, case), time.monotonic()
    words = [names[0] if word == "FILE" else word for word in command]
    try:
        done = subprocess.run(
            [sys.executable, "-m", "uuvtai", *words],
            cwd=case,
            env=os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parent.parent), "UUV_DEBUG": ""},
            capture_output=True,
            text=True,
            errors="replace",
            timeout=2 * _LONGEST_S,  # the imports of a start included
            check=False,
        )
    except subprocess.TimeoutExpired:
        return "hang", json.dumps(words)
    output = json.dumps([words, done.returncode, round(time.monotonic() - begun, 1), done.stderr[-2000:]])
    if _tree(folder, case) != outside:
        return "wrote outside", output
    if done.returncode not in (0, 2, 3) or "Traceback" in done.stderr:
        return "bug", output
    return ("accepted" if done.returncode == 0 else "refused"), output


# ---------------------------------------------------------------------------------------------------- folders


def _fresh(case: Path) -> Path:
    import shutil

    shutil.rmtree(case, ignore_errors=True)
    case.mkdir()
    return case


def _tree(folder: Path, without: Path) -> dict[Path, tuple[int, int]]:
    """Size and time of change of every file below ``folder`` that does not lie in ``without``."""
    files: dict[Path, Any] = {
        path: path.lstat() for path in folder.rglob("*") if path.is_file() and without not in path.parents
    }
    return {path: (found.st_size, found.st_mtime_ns) for path, found in files.items()}


def _keep(kept: Path, case: Path, name: str, output: str) -> None:
    import shutil

    shutil.copytree(case, kept / name, dirs_exist_ok=True)
    (kept / name / "told.txt").write_text(output)
