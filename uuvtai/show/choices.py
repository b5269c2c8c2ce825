"""What may be typed where: values beside an option, names that the shell completes, refusals that say what
was meant."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import typer

from uuvtai.endings import UsageError
from uuvtai.shipped import KINDS, preset_names

DEVICES = ("auto", "cpu", "cuda")
_MEANT = {"gpu": "cuda", "nvidia": "cuda"}
"""what people type for a device, and what they mean by it"""

Complete = Callable[[str], list[str]]
"""From what is typed so far to what it may become."""


def choice(option: str, values: tuple[str, ...], help_text: str, meant: dict[str, str] | None = None) -> Any:
    """Option whose values are listed in the help, completed by the shell, and checked as soon as the command
    line is read."""

    def check(value: str | None) -> str | None:
        if value is not None and value not in values:
            close = (meant or {}).get(value) or next(
                iter(difflib.get_close_matches(value, values, n=1, cutoff=0.5)), None
            )
            hint = f"; did you mean '{close}'?" if close else ""
            raise UsageError(f"{option} {value}: use {', '.join(values[:-1])} or {values[-1]}{hint}")
        return value

    return typer.Option(
        option, metavar="|".join(values), help=help_text, callback=check, autocompletion=_among(values)
    )


def device() -> Any:
    """``--device``."""
    return choice("--device", DEVICES, "Where to compute; auto takes a GPU if there is one.", _MEANT)


def names(kind: str) -> str:
    """'gauntlet, maze, ...': the presets of a kind, for a help text."""
    return ", ".join(preset_names(kind))


def presets(kind: str, *more: str, suffix: str = ".yaml") -> Complete:
    """Names of the presets of a kind, ``more`` words, and files."""

    def complete(incomplete: str) -> list[str]:
        return _starting([*preset_names(kind), *more], incomplete) + _paths(
            incomplete, lambda path: path.suffix == suffix
        )

    return complete


def controllers(incomplete: str) -> list[str]:
    """Trees, stacks, yardsticks that know the truth, and files of trees and stacks; after a comma the
    next one."""
    before, comma, last = incomplete.rpartition(",")
    trees = preset_names("tree")
    found = _starting(
        [*trees, *preset_names("stack"), *(f"{tree}+truth" for tree in trees), "oracle", "none"], last
    ) + _paths(last, lambda path: path.suffix in (".xml", ".yaml", ".py"))
    return [f"{before}{comma}{name}" for name in found]


def files(*suffixes: str) -> Complete:
    """Files with these endings."""

    def complete(incomplete: str) -> list[str]:
        return _paths(incomplete, lambda path: path.suffix in suffixes)

    return complete


def grids(incomplete: str) -> list[str]:
    """Presets of grids, and the axes that have short names."""
    return _starting([*preset_names("grid"), "S=", "D=", "v=", "sensors=", "vehicle="], incomplete)


def policies(incomplete: str) -> list[str]:
    """Run folders with checkpoints."""
    return _runs(incomplete, "checkpoints")


def runs(incomplete: str) -> list[str]:
    """Run folders."""
    return _runs(incomplete, "run.json")


def evaluations(incomplete: str) -> list[str]:
    """Run folders of evaluations."""
    return _runs(incomplete, "eval/tree.json")


def shown(incomplete: str) -> list[str]:
    """Every preset, and KIND/NAME of it."""
    found = {name: None for kind in KINDS for name in preset_names(kind)}
    kind, slash, _rest = incomplete.partition("/")
    if slash and kind in KINDS:
        return _starting([f"{kind}/{name}" for name in preset_names(kind)], incomplete)
    return _starting([*found, *(f"{kind}/" for kind in KINDS)], incomplete)


def _among(values: Iterable[str]) -> Complete:
    def complete(incomplete: str) -> list[str]:
        return _starting(values, incomplete)

    return complete


def _starting(words: Iterable[str], incomplete: str) -> list[str]:
    return [word for word in words if word.startswith(incomplete)]


def _runs(incomplete: str, holds: str) -> list[str]:
    """Folders below the one that is typed, or below ``runs``, that hold this file or folder."""
    typed = _paths(incomplete, lambda path: (path / holds).exists())
    below = [] if incomplete else _paths("runs/", lambda path: (path / holds).exists())
    return list(dict.fromkeys([*below, *typed]))


def _paths(incomplete: str, wanted: Callable[[Path], bool]) -> list[str]:
    """Paths that begin like this: those that are ``wanted``, and folders with a slash, to be typed
    further."""
    folder, slash, start = incomplete.rpartition("/")
    try:
        entries = sorted(Path(folder or slash or ".").iterdir())
    except OSError:
        return []
    found = [path for path in entries if path.name.startswith(start) and (start or path.name[0] != ".")]
    texts = {path: f"{folder}{slash}{path.name}" for path in found}
    return [
        text if wanted(path) else f"{text}/" for path, text in texts.items() if wanted(path) or path.is_dir()
    ]
