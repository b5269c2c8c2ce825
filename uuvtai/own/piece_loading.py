"""The one place where Python of the user's is imported: from the file that she named, never from one that a
file names."""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import sys
from collections.abc import Callable
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType
from typing import Any, cast

from uuvtai.files import read_bytes
from uuvtai.own.piece_errors import PieceError, failed
from uuvtai.own.piece_spec import PieceSpec
from uuvtai.own.protocol import About

MAX_BYTES = 1 << 20
"""of a Python file"""
FACTORY = "load"
"""a function of this name is called once; what it returns drives"""

_loaded: dict[tuple[str, str], ModuleType] = {}


class _OwnSource(SourceFileLoader):
    """Reads as everything is read, and leaves no bytecode beside the user's file."""

    def get_data(self, path: str) -> bytes:
        return read_bytes(Path(path), MAX_BYTES)

    def path_stats(self, path: str) -> Any:
        raise OSError

    def set_data(self, *_given: Any, **_others: Any) -> None:
        pass


def content_of(spec: PieceSpec, limit: int) -> bytes:
    """The piece's file. Raises PieceError where there is none, FileError for what is no plain file."""
    try:
        return read_bytes(spec.path, limit)
    except OSError as error:
        raise PieceError(f"{spec.option}: {spec.path} cannot be read ({error.strerror})") from None


def object_of(spec: PieceSpec) -> Any:
    """The object that the piece names, its file imported once per content. Raises PieceError, FileError."""
    module = _module(spec)
    if not hasattr(module, spec.name):
        there = [name for name, value in vars(module).items() if _is_own(value, module)]
        raise PieceError(
            f"{spec.option}: {spec.path} has no {spec.name!r}; it has {', '.join(there) or 'no function'}"
        )
    return getattr(module, spec.name)


def _module(spec: PieceSpec) -> ModuleType:
    digest = hashlib.sha256(content_of(spec, MAX_BYTES)).hexdigest()
    key = str(spec.path.resolve()), digest
    if key not in _loaded:
        name = f"uuv_own_{spec.path.stem}_{digest[:8]}"
        found = importlib.util.spec_from_loader(name, _OwnSource(name, str(spec.path)))
        assert found is not None  # a loader was given
        module = importlib.util.module_from_spec(found)
        folder = str(spec.path.resolve().parent)
        if folder not in sys.path:  # what lies beside it can be imported, as for 'python mine.py'
            sys.path.insert(0, folder)
        sys.modules[name] = module  # dataclasses and pickles look for it
        try:
            _OwnSource(name, str(spec.path)).exec_module(module)
        except (Exception, SystemExit) as error:
            del sys.modules[name]
            raise failed(error, spec.path, f"while {spec.option} was imported") from error
        _loaded[key] = module
    return _loaded[key]


def _is_own(value: Any, module: ModuleType) -> bool:
    return callable(value) and getattr(value, "__module__", "") == module.__name__


def made(found: Any, spec: PieceSpec, about: About) -> Any:
    """What drives: the object itself, an instance of a class, or what a function named ``load`` returns.
    Raises PieceError."""
    is_class, make = inspect.isclass(found), cast("Callable[..., Any]", found)
    if not is_class and not (spec.name == FACTORY and inspect.isroutine(found)):
        return found
    takes = _parameters(found)
    if takes > 1:
        raise PieceError(
            f"{place_of(found, spec)}: {spec.name} needs {takes} arguments; it gets one (about) or none"
        )
    try:
        made_one = make(about) if takes or _may_take(found) else make()
    except (Exception, SystemExit) as error:
        raise failed(error, spec.path, f"while {spec.option} was made") from error
    for name in ("rows", "arrays", "hold_steps"):  # a decorated ``load`` says it for what it returns
        if not is_class and hasattr(found, name) and not hasattr(made_one, name):
            return _Marked(made_one, {n: getattr(found, n) for n in ("rows", "arrays", "hold_steps")})
    return made_one


class _Marked:
    """An object of somebody else's library with the marks of ``piece``."""

    def __init__(self, inner: Any, marks: dict[str, Any]) -> None:
        self.inner, self.rows, self.arrays, self.hold_steps = (
            inner,
            marks["rows"],
            marks["arrays"],
            marks["hold_steps"],
        )


def inner_of(found: Any) -> Any:
    """The object below the marks."""
    return found.inner if isinstance(found, _Marked) else found


def _parameters(found: Any) -> int:
    """How many arguments it needs at least."""
    try:
        given = inspect.signature(found).parameters.values()
    except (TypeError, ValueError):  # of compiled code
        return 0
    return sum(p.default is p.empty and p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD) for p in given)


def _may_take(found: Any) -> bool:
    """Whether its first argument is called ``about``, though it may be left out."""
    try:
        return next(iter(inspect.signature(found).parameters), "") == "about"
    except (TypeError, ValueError):
        return False


def method_of(
    found: Any, names: tuple[str, ...], spec: PieceSpec, usage: str, count: int
) -> Callable[..., Any]:
    """The function to call: the first method of ``names`` that the object has, or the object itself. Raises
    PieceError where there is none, or where it takes other than ``count`` arguments."""
    inner = inner_of(found)
    method = next((getattr(inner, name) for name in names if callable(getattr(inner, name, None))), inner)
    if not callable(method):
        raise PieceError(
            f"{spec.option}: {spec.name} is {type(inner).__name__}, which cannot be called and has no "
            f"{' or '.join(names)}; {usage}"
        )
    try:
        taken = inspect.signature(method)
        taken.bind(*range(count), **({"row": 0} if "row" in taken.parameters else {}))
    except TypeError as error:
        raise PieceError(f"{place_of(method, spec)}: {error}; {usage}") from None
    except ValueError:  # of compiled code
        pass
    return method


def place_of(found: Any, spec: PieceSpec) -> str:
    """FILE:LINE where a function or a class begins, as far as it is known."""
    code = getattr(inspect.unwrap(found) if inspect.isroutine(found) else found, "__code__", None)
    if code is not None and code.co_filename == str(spec.path):
        return f"{spec.path}:{code.co_firstlineno}"
    return str(spec.path)
