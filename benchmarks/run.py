"""Run benchmarks, print a table, keep results/<date>_<device>_<what>.json with machine, versions, commit,
digest of what was timed, and command.

python benchmarks/run.py                          all of them
python benchmarks/run.py dynamics tick            some
python benchmarks/run.py --quick                  small sizes and short times: does everything run?
python benchmarks/run.py scale --device cuda --num-envs 1024,4096,16384,65536

Every benchmark runs in a process of its own. Exit code: 0 when all of them ran (floors that were not met are
marked, not errors), 1 when one failed, 2 for unknown names.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import subprocess
import sys
import tempfile
import time
from importlib import metadata
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
if sys.path[0] == str(HERE):
    sys.path[0] = str(HERE.parent)  # modules here are benchmarks.*: their names must not hide others

from benchmarks.common import Job, Row  # noqa: E402
from benchmarks.digest import digest  # noqa: E402

NOT_BENCHMARKS = ("__init__", "common", "digest", "played", "run")
NEED_POLICY = ("parity",)
"""left out of a run of all where no --policy is given"""
PEERS = (
    "mujoco", "embreex", "opencv-python-headless", "scipy", "ompl", "pyastar2d", "py_trees", "behaviortreepy",
    "quadrants", "numpy", "torch",
)  # fmt: skip
_LONGEST_S = 1200
"""of a benchmark that names no LONGEST_S of its own"""
_THREAD_VARIABLES = ("UUV_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


def main() -> int:
    """Parse, run each benchmark in its own process, print and keep the rows."""
    names = sorted(path.stem for path in HERE.glob("*.py") if path.stem not in NOT_BENCHMARKS)
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", nargs="*", help=f"benchmarks to run (default: all): {', '.join(names)}")
    parser.add_argument(
        "--quick", action="store_true", help="small sizes, short times; nothing is kept unless --out is given"
    )
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--num-envs", default="", help="batch sizes for scale, separated by commas")
    parser.add_argument(
        "--seconds", type=float, help="measured time per side of a comparison [s] (default 4)"
    )
    parser.add_argument("--against", default="", help="commit to compare with (default: HEAD)")
    parser.add_argument("--policy", default="", help="run folder for parity (uuv train policy)")
    parser.add_argument("--out", type=Path, help="folder of the results (default benchmarks/results)")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if unknown := sorted(set(chosen.what) - set(names)):
        print(f"unknown: {', '.join(unknown)}; there are: {', '.join(names)}", file=sys.stderr)
        return 2
    if chosen.worker:
        return _work(chosen)
    failed, started = [], time.perf_counter()
    for name in chosen.what or [each for each in names if chosen.policy or each not in NEED_POLICY]:
        devices, threads, longest_s = _traits(name)
        if chosen.device not in devices:
            if chosen.what:
                print(f"{name}: runs on {', '.join(devices)} only", file=sys.stderr)
                failed.append(name)
            continue
        print(f"{name} ...", file=sys.stderr, flush=True)
        document, error = _measured(name, threads, longest_s)
        if document is None:
            print(f"{name}: failed\n{error}", file=sys.stderr)
            failed.append(name)
            continue
        _show(name, document)
        if chosen.out or not chosen.quick:
            print(_kept(name, chosen, document))
        print(flush=True)
    print(f"{time.perf_counter() - started:.0f} s" + (f"; failed: {', '.join(failed)}" if failed else ""))
    return 1 if failed else 0


def _traits(name: str) -> tuple[tuple[str, ...], int | None, int]:
    """DEVICES, THREADS and LONGEST_S of a benchmark, read from its source: importing it could start what it
    measures."""
    devices: tuple[str, ...] = ("cpu",)
    threads, longest_s = None, _LONGEST_S
    for line in (HERE / f"{name}.py").read_text().splitlines():
        value = line.partition("=")[2]
        if line.startswith("DEVICES = "):
            devices = tuple(
                part.strip("\"' ") for part in value.strip(" ()").split(",") if part.strip("\"' )")
            )
        if line.startswith("THREADS = "):
            threads = int(value)
        if line.startswith("LONGEST_S = "):
            longest_s = int(value)
    return devices, threads, longest_s


# --------------------------------------------------------------------------------------- one process for each


def _measured(name: str, threads: int | None, longest_s: int) -> tuple[dict[str, Any] | None, str]:
    """(what the worker found, '') or (None, what went wrong)."""
    environment = dict(os.environ)
    if threads:
        environment |= {variable: str(threads) for variable in _THREAD_VARIABLES}
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "rows.json"
        command = [sys.executable, str(HERE / "run.py"), *sys.argv[1:], "--worker", f"{name}:{target}"]
        try:
            done = subprocess.run(command, env=environment, stdout=sys.stderr, check=False, timeout=longest_s)
        except subprocess.TimeoutExpired:
            return None, f"not done after {longest_s} s"
        if done.returncode or not target.exists():
            return None, f"exit code {done.returncode} (its message is above)"
        return json.loads(target.read_text()), ""


def _work(chosen: argparse.Namespace) -> int:
    """Measure one benchmark; its rows go to the file named by ``--worker name:file``."""
    name, _, target = chosen.worker.partition(":")
    sizes = tuple(int(n) for n in chosen.num_envs.split(",") if n)
    seconds = chosen.seconds or (0.3 if chosen.quick else 4.0)
    job = Job(
        chosen.device, chosen.quick, sizes, seconds, chosen.against, chosen.policy,
        say=lambda text: print(f"  {text}", file=sys.stderr, flush=True),
    )  # fmt: skip
    module = importlib.import_module(f"benchmarks.{name}")
    begun = time.perf_counter()
    rows: list[Row] = module.measure(job)
    document = {
        "about": " ".join((module.__doc__ or "").split("\n\n")[0].split()),
        "machine": _machine(chosen.device),
        "seconds": time.perf_counter() - begun,
    }
    Path(target).write_text(json.dumps({**document, "rows": [row.document() for row in rows]}))
    return 0


def _machine(device: str) -> dict[str, Any]:
    from uuvtai.logs.run_folder import hardware, versions

    found = {**versions()}
    for name in PEERS:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "missing"
    out = {**hardware(), "device": device, "memory_gib": _memory_gib(), "versions": found}
    out["threads"] = os.environ.get("UUV_NUM_THREADS", "all")
    if device == "cuda":
        import torch

        out["gpu"] = torch.cuda.get_device_name(0)
    return out


def _memory_gib() -> float | None:
    try:
        return round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30, 1)
    except (AttributeError, ValueError, OSError):
        return None


def _commit() -> str | None:
    """Commit of the checkout, with '+' where files of the package or the benchmarks differ from it."""
    from uuvtai.logs.run_folder import git_sha

    sha = git_sha()
    if sha is None:
        return None
    status = ["git", "-C", str(HERE.parent), "status", "--porcelain", "--untracked-files=no"]
    status += ["uuvtai", "benchmarks/*.py"]
    changed = subprocess.run(status, capture_output=True, text=True, check=False)
    return sha + ("+" if changed.stdout.strip() else "")


# ---------------------------------------------------------------------------------------------- show and keep


def _kept(name: str, chosen: argparse.Namespace, document: dict[str, Any]) -> Path:
    folder = chosen.out or HERE / "results"
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"{time.strftime('%Y-%m-%d')}_{chosen.device}_{name}.json"
    head = {
        "schema": 1,
        "command": " ".join(["python", "benchmarks/run.py", *sys.argv[1:]]),
        "date": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "commit": _commit(),
        "digest": digest(name),
    }
    rows = ",\n ".join(json.dumps(_six_digits(row)) for row in document.pop("rows"))
    text = json.dumps({**head, **document, "rows": []}, indent=1)
    target.write_text(text.replace('"rows": []', f'"rows": [\n {rows}]') + "\n")
    return target


def _six_digits(value: Any) -> Any:
    """As it is kept: nothing is measured to more, and results are small."""
    if isinstance(value, dict):
        return {key: _six_digits(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_six_digits(part) for part in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _show(name: str, document: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console(width=None if sys.stdout.isatty() else 150)
    table = Table(title=f"{name}: {document['about']}", title_justify="left", caption_justify="left")
    for head in ("what", "ours", "peer", "ratio", "unit", "floor", ""):
        table.add_column(head, justify="left" if head in ("what", "unit", "") else "right")
    for row in document["rows"]:
        peer = f"{_number(row['peer'])} {row['peer_name']}" if row["peer"] is not None else ""
        ratio = f"{row['ratio']:.3g} x" if row["ratio"] is not None else ""
        mark = {None: "", True: "met", False: "[bold red]NOT MET[/]"}[row["met"]]
        table.add_row(
            row["what"], _number(row["ours"]), peer, ratio, row["unit"], _floor(row),
            " ".join(filter(None, (mark, escape(row["note"])))),
        )  # fmt: skip
    console.print(table)
    for row in document["rows"]:
        if columns := row["details"].get("table"):
            console.print(_details(row["what"], columns, Table))


def _details(what: str, columns: dict[str, dict[str, float]], table_class: Any) -> Any:
    table = table_class(title=what, title_justify="left")
    table.add_column("")
    for head in columns:
        table.add_column(head, justify="right")
    for line in next(iter(columns.values())):
        table.add_row(line, *[_number(column.get(line)) for column in columns.values()])
    return table


def _number(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def _floor(row: dict[str, Any]) -> str:
    if row["floor"] is None:
        return ""
    if row["floor_on"] == "ratio":
        return f">= {_number(row['floor'])} x"
    return f"{'<=' if row['less_is_better'] else '>='} {_number(row['floor'])}"


if __name__ == "__main__":
    sys.exit(main())
