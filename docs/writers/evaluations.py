"""Play every evaluation that README and docs show: ``python -m docs.writers.evaluations --seeds 90007``.

Each row is one ``uuv eval`` (or ``uuv sweep``) on one thread, two of them at a time. A row is in
``docs/data/evaluations_SEED.json`` as soon as it is played; a second start plays what is missing (same seed,
same episodes, same last commit of ``uuvtai/``). ``--beside best`` plays one more pilot in the rows of the
table and leaves the others as they are. Whoever changes the default pilot writes ``"older": true``
into the rows that it has not played: the tables mark them. Afterwards ``python -m docs.writers.figures
--evaluations evaluations_SEED.json`` renews the text.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from docs.writers import sweeps
from docs.writers.figure_sources import ROOT
from uuvtai.run_folder import hardware, write_atomic

EPISODES = 1000
USUAL = "--controller straight --controller planner --controller bt --controller capped"
"""methods of a row"""
ONE_THREAD = {
    "UUV_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
}


@dataclass(frozen=True)
class Row:
    """One condition of README's table. A new row is a new entry of ``ROWS``."""

    name: str
    title: str
    """as the table has it, Markdown"""
    options: str
    """of ``uuv eval``"""
    methods: str = USUAL
    shows: str = "bt"
    """the method whose counts stand in the table's row"""


_MOVING = "-S 8 -D 6 -v 0.6"
_FAST = "-S 8 -D 9 -v 1.5"
_LOCAL = "--controller " + " --controller ".join(
    ("bt", "capped", "mppi", "dwa", "potential_field", "velocity_obstacle")
)
_KNOWN = "--set sensors.localization=truth"
ROWS = (
    Row("pool_0", "`pool` (0)", "--world pool -S 8 -D 0"),
    Row("pool_6", "`pool` (6, 0.6)", f"--world pool {_MOVING}"),
    Row("pool_9_fast", "`pool` (9, 1.5)", f"--world pool {_FAST}"),
    Row("gauntlet_6", "`gauntlet` (6, 0.4)", "--world gauntlet -S 8 -D 6 -v 0.4"),
    Row("gauntlet_9_fast", "`gauntlet` (9, 1.5)", f"--world gauntlet {_FAST}"),
    Row("maze_0", "`maze` (0)", "--world maze -S 8 -D 0"),
    Row("maze_6", "`maze` (6, 0.6)", f"--world maze {_MOVING}"),
    Row("column_9_fast", "`column` (9, 1.5)", f"--world column {_FAST}"),
    Row("netpen", "`netpen` (its own D, v)", "--world netpen"),
    Row("transfer", "`transfer` (its own D, v), position estimated", "--world transfer"),
    Row(
        "pool_6_nominal",
        "`pool` (6, 0.6), nominal sensing, position known",
        f"--world pool {_MOVING} --sensors nominal {_KNOWN}",
    ),
    Row(
        "pool_6_nominal_estimated",
        "`pool` (6, 0.6), nominal sensing, position estimated",
        f"--world pool {_MOVING} --sensors nominal",
    ),
    Row(
        "pool_6_harsh",
        "`pool` (6, 0.6), harsh sensing, position known",
        f"--world pool {_MOVING} --sensors harsh {_KNOWN}",
    ),
    Row(
        "pool_6_harsh_estimated",
        "`pool` (6, 0.6), harsh sensing, position estimated",
        f"--world pool {_MOVING} --sensors harsh",
    ),
    Row(
        "pool_6_harsh_dead_reckoning",
        "`pool` (6, 0.6), harsh sensing, dead reckoning",
        f"--world pool {_MOVING} --sensors harsh --set sensors.localization=dead_reckoning",
    ),
    Row(
        "pool_6_paper",
        "`pool` (6, 0.6), the paper's classical stack",
        f"--world pool {_MOVING}",
        "--controller bt --controller paper",
        "paper",
    ),
    Row("pool_6_local", "`pool` (6, 0.6)", f"--world pool {_MOVING}", _LOCAL),
    Row("pool_9_fast_local", "`pool` (9, 1.5)", f"--world pool {_FAST}", _LOCAL),
    Row("gauntlet_9_fast_local", "`gauntlet` (9, 1.5)", f"--world gauntlet {_FAST}", _LOCAL),
)
"""Local planners of the literature have rows of their own, which ``docs/baselines.md`` shows."""

SWEEPS = {
    "pool": "--controller best --controller bt --controller capped --grid paper --episodes 64",
    "gauntlet": "--controller best --controller bt --grid paper --world gauntlet --episodes 32",
    "caution": "--controller bt --grid caution --episodes 16",
    "robustness": "--controller best --controller bt --grid robustness --episodes 100",
    "dead_reckoning": "--controller best --controller bt --grid dead_reckoning --episodes 100",
}
"""options of ``uuv sweep`` by the name of its file; ``pool`` is played by default, the others by
``--only``"""
BY_DEFAULT = (*(row.name for row in ROWS), "sweep/pool")


# ---------------------------------------------------------------------------------------------------- results


def file_of(seed: int, root: Path = ROOT) -> Path:
    """Where the rows of a seed are kept."""
    return root / f"docs/data/evaluations_{seed}.json"


def read(path: Path, seed: int, episodes: int) -> dict[str, Any]:
    """What was played so far; an empty document where nothing was. Raises ValueError for a file of another
    seed or number of episodes."""
    if not path.exists():
        return {"schema": 1, "seed": seed, "episodes": episodes, "rows": []}
    document = json.loads(path.read_text(encoding="utf-8"))
    if (document["seed"], document["episodes"]) != (seed, episodes):
        raise ValueError(
            f"{path}: holds {document['episodes']} episodes of seed {document['seed']}; give another --out"
        )
    return document


def missing(document: dict[str, Any], rows: tuple[Row, ...], commit: str) -> list[Row]:
    """Rows that were not played with this code; what another commit played is played again."""
    done = {entry["name"] for entry in document["rows"] if entry["commit"] == commit}
    return [row for row in rows if row.name not in done]


def entry_of(row: Row, command: str, result: dict[str, Any], commit: str, date: str) -> dict[str, Any]:
    """What is kept of a ``uuv eval --json`` document: counts by ending, times, causes of failure, pairs."""
    return {
        "name": row.name,
        "title": row.title,
        "shows": row.shows,
        "command": command,
        "commit": commit,
        "date": date,
        "machine": hardware(),
        "methods": {method["name"]: _method(method) for method in result["methods"]},
        "paired": [_pair(pair) for pair in result["paired"]],
    }


def _method(method: dict[str, Any]) -> dict[str, Any]:
    kept = {name: method[name] for name in ("episodes", "outcomes", "time_mean_s", "time_to_success_mean_s")}
    return kept | {
        "causes": [{"label": cause["label"], "count": cause["count"]} for cause in method.get("causes", [])]
    }


def _pair(pair: dict[str, Any]) -> dict[str, Any]:
    kept = {
        name: pair[name]
        for name in ("a", "b", "both", "only_a", "only_b", "mcnemar_p", "time_difference_mean_s")
    }
    a, b = pair["time_a_mean_s"], pair["time_b_mean_s"]
    return kept | {"time_ratio": b / a if a and b else None}


def add(path: Path, document: dict[str, Any], entry: dict[str, Any]) -> None:
    """Put an entry in its place in the order of ``ROWS`` and write the file whole."""
    order = {row.name: i for i, row in enumerate(ROWS)}
    rows = [old for old in document["rows"] if old["name"] != entry["name"]] + [entry]
    document["rows"] = sorted(rows, key=lambda found: order.get(found["name"], len(order)))
    write_atomic(path, (json.dumps(document, indent=1) + "\n").encode())


def commit_of_package(root: Path = ROOT) -> str:
    """The last commit that changed ``uuvtai/``, with '+' where files of it differ from that: documents may be
    committed in between."""
    commit = _git(root, "log", "-1", "--format=%H", "--", "uuvtai")
    return commit + ("+" if _git(root, "status", "--porcelain", "--untracked-files=no", "uuvtai") else "")


def _git(root: Path, *arguments: str) -> str:
    return subprocess.run(
        ["git", "-C", str(root), *arguments], capture_output=True, text=True, check=True
    ).stdout.strip()


# ---------------------------------------------------------------------------------------------------- playing


def command_of(row: Row, seed: int, episodes: int) -> list[str]:
    """Arguments of ``uuv`` for a row."""
    return [
        "eval",
        *row.methods.split(),
        *row.options.split(),
        "--seeds",
        str(seed),
        "--episodes",
        str(episodes),
    ]


def lacking(document: dict[str, Any], rows: list[Row], pilot: str, commit: str) -> list[Row]:
    """Rows of README's table in which this pilot was not played with this code, with it as their one
    method."""
    played = {
        entry["name"]: entry["methods"].get(pilot, {}).get("commit") == commit for entry in document["rows"]
    }
    return [
        replace(row, methods=f"--controller {pilot}", shows=pilot)
        for row in rows
        if row.methods == USUAL and not played.get(row.name, True)
    ]


def add_beside(path: Path, document: dict[str, Any], entry: dict[str, Any]) -> None:
    """Put the one method of an entry into the row that is there, with the command that played it."""
    (row,) = (old for old in document["rows"] if old["name"] == entry["name"])
    how = {name: entry[name] for name in ("command", "commit", "date", "machine")}
    row["methods"] |= {entry["shows"]: entry["methods"][entry["shows"]] | how}
    write_atomic(path, (json.dumps(document, indent=1) + "\n").encode())


def _play(row: Row, seed: int, episodes: int, commit: str) -> dict[str, Any]:
    """The entry of one row. Raises RuntimeError where the command fails; its messages went to stderr."""
    command = command_of(row, seed, episodes)
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        _run([*command, "--explain", "--explain-record", "0", "--run-dir", str(run)])
        result = json.loads((run / "eval/result.json").read_text(encoding="utf-8"))
    return entry_of(row, "uuv " + " ".join(command), result, commit, time.strftime("%Y-%m-%dT%H:%M:%S%z"))


def _sweep(name: str, seed: int) -> None:
    """Play a sweep and write its CSV; a sweep of this seed that was cut off goes on where it was."""
    run = ROOT / f"runs/evaluations_{seed}_sweep_{name}"
    begun = (run / "sweep_request.json").exists()
    options = (
        ["--resume", str(run)]
        if begun
        else [*SWEEPS[name].split(), "--seeds", str(seed), "--run-dir", str(run)]
    )
    if not (run / "sweep.json").exists():
        _run(["sweep", *options])
    sweeps.keep(run, name)


_running: set[subprocess.Popen[bytes]] = set()
_lock = threading.Lock()


def _run(arguments: list[str]) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "uuvtai", *arguments],
        cwd=ROOT,
        env={**os.environ, **ONE_THREAD},
        stdout=subprocess.DEVNULL,
    )
    with _lock:
        _running.add(process)
    code = process.wait()
    with _lock:
        _running.discard(process)
    if code:
        raise RuntimeError(f"'uuv {' '.join(arguments)}' ended with {code}; its message is above")


def play_all(
    rows: list[Row],
    sweep_names: list[str],
    seed: int,
    document: dict[str, Any],
    path: Path,
    commit: str,
    jobs: int,
    keep: Callable[[Path, dict[str, Any], dict[str, Any]], None] = add,
) -> list[str]:
    """Play rows and sweeps, ``jobs`` at a time, and keep each by ``keep``; what went wrong, in words. The
    others are played and kept all the same."""
    failed: list[str] = []
    with ThreadPoolExecutor(jobs) as pool:
        waiting: dict[Future[Any], str] = {
            pool.submit(_play, row, seed, document["episodes"], commit): row.name for row in rows
        }
        waiting |= {pool.submit(_sweep, name, seed): f"sweep/{name}" for name in sweep_names}
        try:
            for future in as_completed(waiting):
                try:
                    entry = future.result()
                except (RuntimeError, OSError, ValueError, KeyError) as error:
                    failed.append(f"{waiting[future]}: {error}")
                    continue
                if entry is not None:
                    keep(path, document, entry)
                print(f"{waiting[future]}: done", file=sys.stderr, flush=True)
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in list(_running):
                process.terminate()
            raise
    return failed


def main(arguments: list[str] | None = None) -> int:
    """Play what is missing; 1 where a row failed, 130 where it was interrupted, 2 for an unknown name."""
    parser = argparse.ArgumentParser(
        prog="python -m docs.writers.evaluations", description=(__doc__ or "").split("\n\n")[0]
    )
    parser.add_argument("--seeds", type=int, required=True, help="the one seed of every row")
    parser.add_argument(
        "--episodes", type=int, default=EPISODES, help=f"per row and method (default {EPISODES})"
    )
    parser.add_argument(
        "--only",
        default="",
        help=f"names, parted by commas (default: {', '.join(BY_DEFAULT)}; also sweep/NAME)",
    )
    parser.add_argument(
        "--jobs", type=int, default=2, help="rows played at a time, one thread each (default 2)"
    )
    parser.add_argument("--beside", default="", help="a pilot to play beside those that the rows have")
    parser.add_argument("--out", type=Path, help="results file (default docs/data/evaluations_SEED.json)")
    chosen = parser.parse_args(arguments)
    names = chosen.only.split(",") if chosen.only else list(BY_DEFAULT)
    known = {row.name for row in ROWS} | {f"sweep/{name}" for name in SWEEPS}
    if unknown := sorted(set(names) - known):
        print(f"unknown: {', '.join(unknown)}; there are: {', '.join(sorted(known))}", file=sys.stderr)
        return 2
    path, commit = chosen.out or file_of(chosen.seeds), commit_of_package()
    try:
        document = read(path, chosen.seeds, chosen.episodes)
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    named = [row for row in ROWS if row.name in names]
    rows = missing(document, tuple(named), commit)
    wanted = [name.removeprefix("sweep/") for name in names if name.startswith("sweep/")]
    if chosen.beside:
        rows, wanted = lacking(document, named, chosen.beside, commit), []
    print(
        f"{len(rows)} rows and {len(wanted)} sweeps to play, {chosen.jobs} at a time",
        file=sys.stderr,
        flush=True,
    )
    try:
        keep = add_beside if chosen.beside else add
        failed = play_all(rows, wanted, chosen.seeds, document, path, commit, chosen.jobs, keep)
    except KeyboardInterrupt:
        print("interrupted; what is played is kept: give the same command again", file=sys.stderr)
        return 130
    print(
        "\n".join(failed)
        or f"all played; show them: python -m docs.writers.figures --evaluations {path.name}",
        file=sys.stderr,
    )
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
