"""Digest of the code that a benchmark times, so that a result says whether it is today's."""

from __future__ import annotations

import ast
import functools
import hashlib
import io
import tokenize
from collections.abc import Iterator
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parent.parent
_BEGINNING = (tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)
"""tokens that come before a statement"""


@functools.cache
def digest(name: str, root: Path = ROOT) -> str:
    """Of a benchmark and all that it imports of this repository, in turn, at the tops of modules; of the
    presets where they are read; of the whole package where none of it is imported, but run as a command.
    Comments, docstrings and empty lines do not count."""
    package, found, left = root / "uuvtai", dict[Path, str](), [root / "benchmarks" / f"{name}.py"]
    while left:
        path = left.pop()
        if path not in found:
            found[path], imported = _read(path)
            left += [place for name in imported for place in _places(root, name)]
            if not left and not any(package in each.parents for each in found):
                left += package.rglob("*.py")
    if package / "config/loader.py" in found:
        found |= {path: _preset(path) for path in (package / "presets").rglob("*.*")}
    text = "\n".join(f"{path.relative_to(root).as_posix()}\n{found[path]}" for path in sorted(found))
    return hashlib.sha256(text.encode()).hexdigest()[:12]


@functools.cache
def _read(path: Path) -> tuple[str, list[str]]:
    """A module's code, and the names that it imports."""
    text, before = path.read_text(encoding="utf-8"), tokenize.NEWLINE
    lines = text.split("\n")
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        (row, column), (last, _) = token.start, token.end
        if token.type == tokenize.COMMENT:
            lines[row - 1] = lines[row - 1][:column]
        elif token.type == tokenize.STRING and before in _BEGINNING:  # a docstring
            lines[row - 1 : last] = [""] * (last - row + 1)
        if token.type not in (tokenize.COMMENT, tokenize.NL):
            before = token.type
    code = "\n".join(line.rstrip() for line in lines if line.strip())
    return code, [name for node in ast.parse(text).body for name in _imported(node)]


def _imported(node: ast.stmt) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom) and node.module:
        yield from (f"{node.module}.{alias.name}" for alias in node.names)
    elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "CODE":
        yield from ast.literal_eval(node.value)


@functools.cache
def _places(root: Path, name: str) -> list[Path]:
    """Files of this repository that an import runs."""
    places = (root.joinpath(*name.split(".")[: n + 1]) for n in range(name.count(".") + 1))
    files = (file for place in places for file in (place.with_suffix(".py"), place / "__init__.py"))
    return [file for file in files if file.is_file()]


@functools.cache
def _preset(path: Path) -> str:
    content = path.read_bytes()
    return str(yaml.safe_load(content)) if path.suffix == ".yaml" else hashlib.sha256(content).hexdigest()
