"""Names of the user's pieces on a command line: ``mine.py:plan``, ``mine.py:load=FOLDER``, ``model.onnx``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from uuvtai.errors import SettingError

PLANNER, CONTROLLER, POLICY = "planner", "controller", "policy"
_DEFAULT = {PLANNER: "plan", CONTROLLER: "act", POLICY: "load"}
"""what is meant where no object is named"""
_PYTHON = re.compile(r"(?P<file>.+?\.py)(?::(?P<name>[^=:/\\]*))?(?:=(?P<argument>.*))?")
_EXAMPLE = {
    PLANNER: "--planner mine.py:plan",
    CONTROLLER: "--controller mine.py:act",
    POLICY: "--policy model.onnx or --policy mine.py:load",
}


@dataclass(frozen=True)
class PieceSpec:
    """A piece as it was named."""

    kind: str
    path: Path
    name: str = ""
    """of the object in a Python file; empty for an ONNX graph"""
    argument: str = ""
    """what stands after ="""

    @property
    def text(self) -> str:
        """As a request keeps it: ``piece_spec`` reads it."""
        return f"{self.kind}:{self.typed}"

    @property
    def typed(self) -> str:
        """As it is typed behind the option."""
        return (
            f"{self.path}{f':{self.name}' if self.name else ''}{f'={self.argument}' if self.argument else ''}"
        )

    @property
    def option(self) -> str:
        """As it is typed, with its option."""
        return f"--{self.kind} {self.typed}"

    @property
    def label(self) -> str:
        """What it is called in tables and files: file, object (if it is not ``load``) and argument."""
        parts = [self.path.stem]
        if self.name and self.name != _DEFAULT[POLICY]:
            parts.append(self.name)
        if self.argument:
            parts.append(Path(self.argument).name)
        return re.sub(r"[^\w.-]+", "_", "-".join(parts))

    @property
    def is_code(self) -> bool:
        """Whether using it runs Python of the user's."""
        return self.path.suffix == ".py"

    def located(self, folder: Path) -> PieceSpec:
        """The same with its file, and an argument that is a path, looked for in ``folder`` where they are not
        here."""
        argument = folder / self.argument
        moved = self.argument and not Path(self.argument).exists() and argument.exists()
        path = self.path if self.path.exists() else folder / self.path
        return replace(self, path=path, argument=str(argument) if moved else self.argument)

    def absolute(self) -> PieceSpec:
        """The same from any folder."""
        argument = Path(self.argument)
        found = str(argument.resolve()) if self.argument and argument.exists() else self.argument
        return replace(self, path=self.path.resolve(), argument=found)


def is_piece(text: str) -> bool:
    """Whether a controller's name is that of a piece of the user's."""
    kind, colon, _rest = text.partition(":")
    return (kind in _DEFAULT and bool(colon)) or bool(_PYTHON.fullmatch(text)) or text.endswith(".onnx")


def piece_spec(text: str, kind: str = CONTROLLER) -> PieceSpec:
    """The piece of a text; ``kind`` where it does not begin with one. SettingError."""
    first, colon, rest = text.partition(":")
    if first in _DEFAULT and colon:
        kind, text = first, rest
    if kind == POLICY and text.endswith(".onnx"):
        return PieceSpec(kind, Path(text))
    found = _PYTHON.fullmatch(text)
    if found is None:
        raise SettingError(f"--{kind} {text!r}: names no piece; for example {_EXAMPLE[kind]}")
    name = found["name"] or _DEFAULT[kind]
    if not name.isidentifier():
        raise SettingError(f"--{kind} {text!r}: {name!r} is no name of Python; for example {_EXAMPLE[kind]}")
    return PieceSpec(kind, Path(found["file"]), name, found["argument"] or "")


def refuse_code(place: Path, names: Sequence[str], allowed: bool) -> None:
    """SettingError where going on with a run folder would run Python that the folder names, unless the user
    said that it is hers: a folder may come from anybody."""
    code = [spec.path for name in names if is_piece(name) and (spec := piece_spec(name)).is_code]
    if code and not allowed:
        files = ", ".join(map(str, dict.fromkeys(code)))
        raise SettingError(
            f"{place}: goes on by running the Python code of {files}; look at it, and add --allow-code if "
            "you trust it"
        )
