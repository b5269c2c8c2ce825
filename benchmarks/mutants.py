"""Wrong changes made one by one in a copy of the tree: which test notices each? None may survive. Resumes
where it was stopped."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import queue
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from benchmarks.common import Job, Row
from benchmarks.mutations import ALL, QUICK, Mutation

LONGEST_S = 14400
ROOT = Path(__file__).resolve().parent.parent
_DONE = ROOT / "build" / "mutants.jsonl"
"""one finished mutant a line; valid while the code and the tests that it is about are as they were"""
_PARTS = ("uuvtai", "tests", "benchmarks", "examples", "docs", "pyproject.toml", "README.md", "LICENSE")
_LEFT_OUT = shutil.ignore_patterns("__pycache__", ".git", "node_modules", "results")
_WORKERS = 2
_TEST_S = 900
"""a mutant that takes so long is not caught by any test"""
_CAUGHT, _SURVIVED = 1, 0
"""exit codes of pytest"""


def measure(job: Job) -> list[Row]:
    """A row for every mutant, and the count of those that were caught. Raises ValueError where a text to be
    changed is not there once."""
    chosen = [m for m in ALL if m.name in QUICK] if job.quick else list(ALL)
    check_texts(chosen)
    done = {} if job.quick else _finished()
    keys = {m.name: _key(m) for m in chosen}  # now: the copy is made now, and files may change meanwhile
    results = {name: done[key] for name, key in keys.items() if key in done}
    todo = [m for m in chosen if m.name not in results]
    job.say(f"{len(results)} known from an earlier run, {len(todo)} to do")
    with contextlib.ExitStack() as stack:
        copies: queue.Queue[Path] = queue.Queue()
        workers = min(_WORKERS, len(os.sched_getaffinity(0)), max(1, len(todo)))
        for _ in range(workers):
            copies.put(stack.enter_context(_copied()))
        with ThreadPoolExecutor(workers) as pool:
            futures = {pool.submit(_tried, mutation, copies): mutation for mutation in todo}
            for future in as_completed(futures):
                mutation, found = futures[future], future.result()
                results[mutation.name] = found
                job.say(
                    f"{len(results)}/{len(chosen)} {mutation.name}: {found['by'] or found['said']} "
                    f"({found['seconds']:.0f} s)"
                )
                if not job.quick:
                    _keep({"key": keys[mutation.name], "name": mutation.name, **found})
        wrong = _fail_without_mutants(
            {found["by"] for found in results.values() if found["by"]}, copies.get()
        )
    return _rows(chosen, results, wrong)


def check_texts(mutations: list[Mutation] | tuple[Mutation, ...]) -> None:
    """Raise ValueError unless every text that is to be changed occurs exactly once, and the change is one."""
    for mutation in mutations:
        count = (ROOT / mutation.path).read_text().count(mutation.old)
        if count != 1 or mutation.old == mutation.new:
            raise ValueError(
                f"mutant {mutation.name}: its text occurs {count} times in {mutation.path}: write it anew"
            )


def _rows(chosen: list[Mutation], results: dict[str, dict[str, Any]], wrong: set[str]) -> list[Row]:
    rows, caught = [], 0
    for mutation in chosen:
        found = results[mutation.name]
        good = bool(found["by"]) and found["by"] not in wrong
        caught += good
        note = found["by"] or f"SURVIVED: {found['said']}"
        if found["by"] in wrong:
            note = f"SURVIVED: {found['by']} fails without it too"
        rows.append(
            Row(
                mutation.name,
                found["seconds"],
                "s",
                less_is_better=True,
                note=note,
                details={"path": mutation.path},
            )
        )
    return [*rows, Row("mutants caught", caught, f"of {len(chosen)}", floor=len(chosen))]


# ------------------------------------------------------------------------------------------------- one mutant


def _tried(mutation: Mutation, copies: queue.Queue[Path]) -> dict[str, Any]:
    """Test that failed ('by', empty: none), what pytest said, and the seconds it took; in a copy that nobody
    else uses meanwhile."""
    copy, begun = copies.get(), time.perf_counter()
    place = copy / mutation.path
    whole = place.read_text()
    try:
        place.write_text(whole.replace(mutation.old, mutation.new))
        code, out = _tests(copy, [mutation.tests, *(["-k", mutation.only] if mutation.only else [])])
    finally:
        place.write_text(whole)
        copies.put(copy)
    failed = [line.split()[1] for line in out.splitlines() if line.startswith(("FAILED ", "ERROR "))]
    said = {_SURVIVED: "all tests passed", _CAUGHT: "tests failed"}.get(
        code, f"pytest ended with {code}: {out[-300:]}"
    )
    return {
        "by": failed[0] if code == _CAUGHT and failed else "",
        "said": said,
        "seconds": time.perf_counter() - begun,
    }


def _tests(copy: Path, arguments: list[str]) -> tuple[int, str]:
    """Exit code and output of pytest in the copy; -1 where it took too long."""
    environment = {
        **os.environ,
        "PYTHONPATH": str(copy),
        "PYTHONDONTWRITEBYTECODE": "1",
        "UUV_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
    }
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-x",
        "-q",
        "-rfE",
        "-p",
        "no:cacheprovider",
        "-p",
        "no:xdist",
        "--no-header",
        *arguments,
    ]
    try:
        done = subprocess.run(
            command, cwd=copy, env=environment, capture_output=True, text=True, check=False, timeout=_TEST_S
        )
    except subprocess.TimeoutExpired:
        return -1, f"not done after {_TEST_S} s"
    return done.returncode, done.stdout + done.stderr[-300:]


def _fail_without_mutants(tests: set[str], copy: Path) -> set[str]:
    """Those of the tests that noticed something which fail in the tree as it is: they notice nothing."""
    if not tests:
        return set()
    code, out = _tests(copy, [*sorted(tests), "--maxfail", "1000"])
    if code not in (_CAUGHT, _SURVIVED):
        raise RuntimeError(f"the tests cannot be run without a mutant: {out[-600:]}")
    return {line.split()[1] for line in out.splitlines() if line.startswith(("FAILED ", "ERROR "))}


@contextlib.contextmanager
def _copied() -> Iterator[Path]:
    """A copy of the tree in a folder that is gone afterwards."""
    with tempfile.TemporaryDirectory(prefix="uuvtai-mutants-") as folder:
        for part in _PARTS:
            source, target = ROOT / part, Path(folder) / part
            if source.is_dir():
                shutil.copytree(source, target, ignore=_LEFT_OUT)
            elif source.exists():
                shutil.copy2(source, target)
        yield Path(folder)


# --------------------------------------------------------------------------------------------------- resuming


def _key(mutation: Mutation) -> str:
    """Changes with the mutant, the file that it changes and the tests that must notice it."""
    texts = [repr(mutation), (ROOT / mutation.path).read_text(), (ROOT / mutation.tests).read_text()]
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()


def _finished() -> dict[str, dict[str, Any]]:
    """Results of earlier runs by key; survivors are tried again."""
    lines = _DONE.read_text().splitlines() if _DONE.exists() else []
    rows = []
    for line in lines:
        with contextlib.suppress(ValueError):  # a run that was killed may have left half a line
            rows.append(json.loads(line))
    return {row["key"]: row for row in rows if row["by"]}


def _keep(row: dict[str, Any]) -> None:
    _DONE.parent.mkdir(exist_ok=True)
    with _DONE.open("a") as file:
        file.write(json.dumps(row) + "\n")
