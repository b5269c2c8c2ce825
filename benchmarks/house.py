"""How the source reads, in counts: arguments, signatures, long lines, long functions, nesting, second names,
import circles."""

from __future__ import annotations

import ast
import functools
import io
import statistics
import tokenize
from pathlib import Path

from benchmarks.common import Job, Row

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "uuvtai"
MANY_ARGUMENTS, LONG_LINE, LONG_FUNCTION, DEEP = 9, 110, 60, 4
_NESTS = (ast.For, ast.While, ast.If, ast.With, ast.Try)


def measure(job: Job) -> list[Row]:
    """The table."""
    return rows()


def rows() -> list[Row]:
    """Every figure; a floor is what we want of it."""
    trees = _trees()
    functions = [
        (path, node)
        for path, tree in trees.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
    ]
    kernels = [(path, node) for path, node in functions if _is_taichi(node)]
    counts = sorted(_arguments(node) for _, node in kernels)
    places = [(PACKAGE / "kernels", "*/*.py"), (PACKAGE, "sim.py")]
    counted = {path for folder, pattern in places for path in folder.glob(pattern)}
    many = {
        f"{path.stem}.{node.name}": _arguments(node)
        for path, node in functions
        if _arguments(node) > MANY_ARGUMENTS
    }
    lines = {path: path.read_text(encoding="utf-8").splitlines() for path in trees}
    bodies = {f"{path.stem}.{node.name}": _length(node) for path, node in functions}
    deep = {f"{path.stem}.{node.name}": _depth(node) for path, node in functions}
    return [
        _row(f"functions with more than {MANY_ARGUMENTS} arguments", len(many), 12, many),
        _row("arguments of Taichi functions, median", statistics.median(counts), 3),
        _row("arguments of Taichi functions, 90th percentile", counts[int(0.9 * len(counts))], 7),
        _row(
            "signature lines in kernels and sim.py",
            sum(_signature(node) for path, node in functions if path in counted),
            850,
        ),
        _row(
            "lines of a signature there, mean",
            round(statistics.mean(_signature(node) for path, node in functions if path in counted), 2),
            1.3,
        ),
        _row(
            f"lines of more than {LONG_LINE} characters",
            sum(len(line) > LONG_LINE for text in lines.values() for line in text),
            0,
        ),
        _row(f"functions of more than {LONG_FUNCTION} lines", *_over(bodies, LONG_FUNCTION)),
        _row(f"functions nested deeper than {DEEP}", *_over(deep, DEEP)),
        _row("lines of the package", sum(map(len, lines.values())), 31_000),
        _row("lines of sim.py", len(lines[PACKAGE / "sim.py"]), 220),
        _row("lines of cli.py", len(lines[PACKAGE / "cli.py"]), 700),
        _row("lines of README", len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()), 120),
        Row(
            "comment lines in kernels",
            round(100 * _comments([p for p in lines if PACKAGE / "kernels" in p.parents]), 1),
            "% of lines",
        ),
    ]


@functools.cache
def _trees() -> dict[Path, ast.Module]:
    """The package's syntax trees by file."""
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(PACKAGE.rglob("*.py"))}


def _row(what: str, count: float, wanted: float, details: dict[str, int] | None = None) -> Row:
    return Row(
        what, count, "", less_is_better=True, floor=wanted, details={"which": details} if details else {}
    )


def _over(values: dict[str, int], limit: int) -> tuple[int, float, dict[str, int]]:
    """How many are over the limit, how many of them are wanted, and which they are."""
    found = {name: value for name, value in values.items() if value > limit}
    return len(found), 0, found


def _is_taichi(node: ast.FunctionDef) -> bool:
    return any(ast.unparse(decorator) in ("ti.kernel", "ti.func") for decorator in node.decorator_list)


def _arguments(node: ast.FunctionDef) -> int:
    """All that a caller may give; a method's own object is none of them."""
    given = [a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
    return len(given) - (given[:1] in (["self"], ["cls"]))


def _signature(node: ast.FunctionDef) -> int:
    """Lines from ``def`` to the colon."""
    return node.body[0].lineno - node.lineno if node.body[0].lineno > node.lineno else 1


def _length(node: ast.FunctionDef) -> int:
    return (node.end_lineno or node.lineno) - node.lineno + 1


def _depth(node: ast.AST, depth: int = 0) -> int:
    """How deep the deepest block of a function lies; ``elif`` is no deeper than its ``if``."""
    deepest = depth
    for name in ("body", "orelse", "handlers", "finalbody"):
        inner = getattr(node, name, [])
        is_elif = name == "orelse" and len(inner) == 1 and isinstance(inner[0], ast.If)
        for child in inner if isinstance(inner, list) else []:
            if isinstance(child, ast.FunctionDef | ast.ClassDef):
                continue
            deepest = max(deepest, _depth(child, depth + (isinstance(child, _NESTS) and not is_elif)))
    return deepest


def _comments(paths: list[Path]) -> float:
    """Share of lines that are, or end in, a comment."""
    found = total = 0
    for path in paths:
        text = path.read_text(encoding="utf-8")
        found += sum(
            token.type == tokenize.COMMENT for token in tokenize.generate_tokens(io.StringIO(text).readline)
        )
        total += text.count("\n")
    return found / total
