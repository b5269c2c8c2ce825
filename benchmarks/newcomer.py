"""The pages as a newcomer pastes them: the wheel in a fresh environment, an empty folder, an empty home, and
every shell line of these pages, with the seconds it took and what it left.

Needs a network (pip). A folder named by ``UUV_NEWCOMER`` is kept, and what was played there is not played
again; without it everything happens in a folder that is gone afterwards.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.common import Job, Row

LONGEST_S = 7200
_ROOT = Path(__file__).resolve().parent.parent
_PAGES = ("own_pieces", "viewers", "sonars")
_EXTRAS = "export,live,ros,sb3,skrl,torchrl,rsl-rl"
_TRAINERS = ("sb3", "skrl", "torchrl", "rsl_rl")
_CUSTOM = ("controller", "reward", "tree", "vehicle", "world")
_CHECKOUT_ONLY = ("python -m docs.", "python benchmarks/", "python3 bootstrap.py")
_LONG = ("examples/train_", "load=runs/", "uuv reproduce")
"""of lines that are played last: minutes of training and what plays that"""
_SHELL = re.compile(r"^```sh\n(.*?)^```", re.S | re.M)
_LONGEST_STEP_S = 3000


def measure(job: Job) -> list[Row]:
    """A row for each line, in the order of the pages."""
    kept = os.environ.get("UUV_NEWCOMER")
    if kept:
        return _walked(Path(kept).resolve(), job)
    with tempfile.TemporaryDirectory() as folder:
        return _walked(Path(folder), job)


def _walked(place: Path, job: Job) -> list[Row]:
    place.mkdir(parents=True, exist_ok=True)
    note = place.parent / f"{place.name}.steps.json"
    done: dict[str, dict[str, Any]] = json.loads(note.read_text()) if note.exists() else {}
    rows = []
    steps = list(dict.fromkeys(_steps(place, job.quick)))
    steps.sort(key=lambda step: any(part in step[1] for part in _LONG))
    for page, line in steps:
        if f"{page}: {line}" not in done:
            job.say(f"{page}: {line}")
            done[f"{page}: {line}"] = _step(place, line)
            note.write_text(json.dumps(done, indent=1))
        rows.append(_row(page, line, done[f"{page}: {line}"]))
    return rows


def _steps(place: Path, quick: bool) -> Iterator[tuple[str, str]]:
    """(page, shell line)."""
    wheels = place / "dist"
    yield "begin", f"pip wheel --quiet --no-deps --wheel-dir {wheels.name} uuvtai"
    yield "begin", "python3 -m venv .venv"
    yield "begin", 'pip install "torch>=2.10,<2.14"'
    yield "begin", "pip install uuvtai"
    yield "begin", "uuv doctor"
    if quick:
        return
    yield "begin", f"pip install 'uuvtai[{_EXTRAS}]'"
    for page in _PAGES:
        for line in shell_lines((_ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")):
            yield page, line
        if page == "own_pieces":
            for name in _CUSTOM:
                yield "examples", f"python examples/custom_{name}.py"
            for name in _TRAINERS:
                yield page, f"python examples/train_{name}.py --out runs/{name}"
                yield page, f"uuv eval --policy examples/own_{name}.py:load=runs/{name}"


def shell_lines(text: str) -> list[str]:
    """The shell lines of a page's fenced blocks, continued lines joined; without what needs a checkout."""
    joined = "\n".join(block.replace("\\\n", " ") for block in _SHELL.findall(text))
    lines = (" ".join(line.split()) for line in joined.splitlines())
    return [line for line in lines if line and not line.startswith(("#", *_CHECKOUT_ONLY))]


def _step(place: Path, line: str) -> dict[str, Any]:
    """Run it as a shell in the folder would; what came of it."""
    home, before = place / "home", _files(place)
    home.mkdir(exist_ok=True)
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    environment |= {
        "HOME": str(home),
        "PATH": f"{place / '.venv/bin'}:{environment['PATH']}",
        "COLUMNS": "160",
    }
    begun = time.perf_counter()
    try:
        done = subprocess.run(
            ["bash", "-c", _typed(place, line)], cwd=place, env=environment, stdin=subprocess.DEVNULL,
            capture_output=True, text=True, check=False, timeout=_LONGEST_STEP_S,
        )  # fmt: skip
        code, said = done.returncode, done.stdout + done.stderr
    except subprocess.TimeoutExpired:
        code, said = -1, f"not done after {_LONGEST_STEP_S} s"
    seconds = time.perf_counter() - begun
    number = len(list(place.glob("said/*.txt")))
    (place / "said").mkdir(exist_ok=True)
    (place / "said" / f"{number:02d}.txt").write_text(f"$ {line}\n{said}")
    made = sorted(set(_files(place)) - set(before))
    threads = os.environ.get("UUV_NUM_THREADS", "all")
    found = {"seconds": round(seconds, 1), "threads": threads, "code": code, "made": made}
    return found | {"last": said.strip()[-300:]}


def _typed(place: Path, line: str) -> str:
    """The line with the wheel of this checkout in place of the index's, and a pilot called mine.py."""
    wheel = next((str(path) for path in place.glob("dist/*.whl")), "")
    typed = line.replace("pip wheel", f"{sys.executable} -m pip wheel")
    typed = typed.replace("dist uuvtai", f"dist {_ROOT}")
    typed = re.sub(r"(?<=pip install )'?uuvtai(\[.*\])?'?$", lambda m: f"'{wheel}{m[1] or ''}'", typed)
    if "benchmark all" in typed:
        typed += " --quick"  # the sealed episodes are for entries
    if "mine.py" in typed:
        typed = f"cp -n examples/own_field.py mine.py; {typed}"
    return typed


def _files(place: Path) -> list[str]:
    """What lies there, but for the environment, caches and logs of ours."""
    mine = (".venv", "home", "said", "dist")
    found = (path.relative_to(place) for path in place.rglob("*") if path.is_file())
    return [str(path) for path in found if path.parts[0] not in mine and "__pycache__" not in path.parts]


def _row(page: str, line: str, found: dict[str, Any]) -> Row:
    ends = sorted({Path(name).suffix for name in found["made"] if Path(name).suffix})
    left = f"{len(found['made'])} files ({' '.join(ends)})" if found["made"] else ""
    note = left if found["code"] == 0 else f"exit code {found['code']}: {found['last']}"
    details = {"page": page, "line": line, "left": left, "code": found["code"], "threads": found["threads"]}
    return Row(f"{page}: {line}", found["seconds"], "s", less_is_better=True, note=note, details=details)
