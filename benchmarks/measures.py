"""The measures of the whole, in counts, beside the limits of ``tests/measures.json``.

``--against COMMIT`` counts that commit as well. ``python -m benchmarks.measures --lower`` lowers the limits
to what is there; no command raises one.
"""

from __future__ import annotations

import ast
import contextlib
import functools
import json
import os
import subprocess
import sys
import tempfile
import typing
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LIMITS = ROOT / "tests" / "measures.json"
"""``whole``: what is there, lowered by each commit that cuts; ``parts``: limits that stay as they are"""

if typing.TYPE_CHECKING:
    from benchmarks.common import Job, Row


def measure(job: Job) -> list[Row]:
    """A row for each measure: ours, the commit's, the limit."""
    from benchmarks.before import checked_out
    from benchmarks.common import Row

    with contextlib.ExitStack() as stack:
        commit, theirs = "", {}
        if job.against:
            place = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "tree"
            commit, tree = stack.enter_context(checked_out(job.against, place))
            theirs = counts(tree)
    top = limits()
    return [
        Row(what, count, "", theirs.get(what), commit, less_is_better=True, floor=top.get(what))
        for what, count in counts(ROOT).items()
    ]


def counts(tree: Path) -> dict[str, int]:
    """Every measure of a checkout."""
    return of_files(tree) | _of_commands(tree)


def limits() -> dict[str, int]:
    """The most that each measure may be."""
    table = json.loads(LIMITS.read_text(encoding="utf-8"))
    return table["whole"] | table["parts"]


def over(found: dict[str, int], most: dict[str, int]) -> dict[str, tuple[int, int]]:
    """Measures above their limits: (measured, limit)."""
    return {what: (found[what], top) for what, top in most.items() if found[what] > top}


def lowered(found: dict[str, int], most: dict[str, int]) -> dict[str, int]:
    """Limits, none of them higher than what is there nor than it was."""
    return {what: min(found[what], top) for what, top in most.items()}


# ---------------------------------------------------------------------------------------------------- files


def of_files(tree: Path) -> dict[str, int]:
    """What text and file sizes say."""
    package = tree / "uuvtai"
    sources = {path: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(package.rglob("*.py"))}
    lengths = {path: _lines(path) for path in sources}
    pages = [p for p in (tree / "docs").rglob("*.md") if not {"reference", "research"} & {*p.parts}]
    kept = ("docs/data", "benchmarks/results", "research")
    data = [p for folder in kept for p in (tree / folder).rglob("*")]
    readme = (tree / "README.md").read_text(encoding="utf-8")
    functions = [
        (node.end_lineno or 0) - node.lineno + 1
        for module in sources.values()
        for node in ast.walk(module)
        if isinstance(node, ast.FunctionDef)
    ]
    return {
        "package: lines": sum(lengths.values()),
        "package: files with code": sum(length > 3 for length in lengths.values()),
        "package: files under 60 lines, those without code too": sum(n < 60 for n in lengths.values()),
        "package: files with code under 60 lines": sum(3 < n < 60 for n in lengths.values()),
        "package: folders and loose files at its top": len({_box(path, package) for path in sources}),
        "package: floors": _floors(sources, package),
        "package: lines of JavaScript": _lines_below(package, "*.mjs"),
        "package: preset files": sum(path.is_file() for path in (package / "presets").rglob("*")),
        "docs: pages": len(pages),
        "docs: words": sum(len(page.read_text(encoding="utf-8").split()) for page in pages),
        "docs: lines of Python": _lines_below(tree / "docs", "*.py"),
        "README: lines": len(readme.splitlines()),
        "README: words": len(readme.split()),
        "tests: lines of Python and JavaScript": _lines_below(tree / "tests", "*.py", "js/*.mjs"),
        "benchmarks: lines": _lines_below(tree / "benchmarks", "*.py"),
        "results and data: bytes": sum(p.stat().st_size for p in data if p.is_file() and p.suffix != ".md"),
        "longest function": max(functions, default=0),
        "longest file but cli.py": max(n for path, n in lengths.items() if path != package / "cli.py"),
        "cli.py": lengths.get(package / "cli.py", 0),
    }


def _lines(path: Path) -> int:
    return len(path.read_text(encoding="utf-8").splitlines())


def _lines_below(folder: Path, *patterns: str) -> int:
    return sum(_lines(path) for pattern in patterns for path in folder.rglob(pattern))


def _box(path: Path, package: Path) -> str:
    """The folder or loose file at the package's top that a file lies in."""
    return path.relative_to(package).parts[0].removesuffix(".py")


def _floors(sources: dict[Path, ast.Module], package: Path) -> int:
    """Boxes along the longest chain of imports; those inside functions and under conditions do not count."""
    below: dict[str, set[str]] = {}
    for path, module in sources.items():
        boxes = {
            name.split(".")[1] if "." in name else "__init__"
            for node in module.body
            for name in _imported(node)
            if name.split(".")[0] == "uuvtai"
        }
        below.setdefault(_box(path, package), set()).update(boxes)

    @functools.cache
    def floor(box: str) -> int:
        return 1 + max((floor(other) for other in below.get(box, set()) - {box}), default=0)

    return max(map(floor, below))


def _imported(node: ast.stmt) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        module = node.module or ""
        yield from (f"uuvtai.{alias.name}" for alias in node.names) if module == "uuvtai" else (module,)


# ------------------------------------------------------------------------------------------ commands and keys


def _of_commands(tree: Path) -> dict[str, int]:
    """What the package of a checkout says of itself, in a process of its own."""
    command = [sys.executable, str(Path(__file__).resolve()), "--commands"]
    environment = os.environ | {"PYTHONPATH": str(tree)}
    done = subprocess.run(command, env=environment, cwd=tree, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def _commands() -> dict[str, int]:
    import typer

    from uuvtai.cli import app
    from uuvtai.config.learning import LearningConfig

    found, groups = [], [typer.main.get_command(app)]
    while groups:
        for command in groups.pop().commands.values():  # type: ignore[attr-defined]
            (groups if hasattr(command, "commands") else found).append(command)
    return {
        "commands": len(found),
        "options and arguments": sum(len(command.params) for command in found),
        "config keys": _keys(LearningConfig),
    }


def _keys(section: typing.Any) -> int:
    """Keys of a section that hold no section of their own; those of a list's items count."""
    return sum(
        sum(map(_keys, inner)) if (inner := list(_sections(field.annotation))) else 1
        for field in section.model_fields.values()
    )


def _sections(annotation: typing.Any) -> Iterator[typing.Any]:
    if hasattr(annotation, "model_fields"):
        yield annotation
    for part in typing.get_args(annotation):
        yield from _sections(part)


def _lower() -> None:
    table = json.loads(LIMITS.read_text(encoding="utf-8"))
    table["whole"] = lowered(counts(ROOT), table["whole"])
    LIMITS.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    if sys.argv[1:] == ["--commands"]:
        del sys.path[0]  # this folder: its names must not hide others
        print(json.dumps(_commands()))
    elif sys.argv[1:] == ["--lower"]:
        _lower()
    else:
        sys.exit("python -m benchmarks.measures --lower")
