"""What of the config a kernel's code depends on: what was read and decided while Taichi compiled it, and
nothing else. So another horizon compiles the referee anew, and not the sonar."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import inspect
import json
import types
from collections.abc import Iterable, Iterator
from typing import Any

from uuvtai.config import Section
from uuvtai.native.numbers import Number, Numbers, as_arguments, worked_out

ALL = "*"
"""a whole section: something was done with it that cannot be followed"""


@contextlib.contextmanager
def noted(bundle: Any, spare: int = 0) -> Iterator[tuple[set[str], Numbers]]:
    """Names of the values of this bundle's sections that code depends on which Taichi compiles meanwhile
    ('teacher_cfg.n_heading'), and the numbers that are its arguments."""
    names: set[str] = set()
    numbers = Numbers(names.add, spare)
    places: dict[int, list[str]] = {}
    for place, section in sections_in(bundle):
        places.setdefault(id(section), []).append(place)
    plain = Section.__getattribute__

    def noting(section: Section, name: str) -> Any:
        value, leaf, found = plain(section, name), _leaf(type(section), name), places.get(id(section), [])
        if leaf and found and type(value) is float and leaf == name:
            return Number(numbers, f"{found[0]}.{leaf}", value)
        if leaf:
            names.update(f"{place}.{leaf}" for place in found)
        return value

    Section.__getattribute__ = noting  # type: ignore[method-assign]
    try:
        with as_arguments(numbers):
            yield names, numbers
    finally:
        del Section.__getattribute__


def sections_in(value: Any, place: str = "") -> list[tuple[str, Section]]:
    """Every section of a bundle and of its parts, with its place there: 'sensors_cfg', 'sensors_cfg.dvl'."""
    if isinstance(value, Section):
        names = list(type(value).model_fields)
    elif dataclasses.is_dataclass(value):
        names = [member.name for member in dataclasses.fields(value)]
    else:
        return []
    own = [(place, value)] if isinstance(value, Section) else []
    inner = [sections_in(getattr(value, name), f"{place}.{name}".lstrip(".")) for name in names]
    return sum(inner, own)


def values_of(names: Iterable[str], bundle: Any) -> list[tuple[str, str]]:
    """(name, value) in the order of the names; a section that has parts of its own is told by its kind."""
    return [(name, _value(bundle, name)) for name in sorted(names)]


def value_of(bundle: Any, name: str) -> Any:
    """What the config says; None where there is no such section."""
    for part in name.removesuffix(f".{ALL}").split("."):
        bundle = getattr(bundle, part, None)
    return bundle


def _value(bundle: Any, name: str) -> str:
    if name.startswith("["):
        with contextlib.suppress(
            ArithmeticError, TypeError
        ):  # of another config, which goes another way before
            return repr(worked_out(json.loads(name), lambda leaf: value_of(bundle, leaf)))
        return ""
    value, leaf = value_of(bundle, name), name.rpartition(".")[2]
    return type(value).__name__ if leaf != ALL and isinstance(value, Section) else repr(value)


@functools.cache
def _leaf(kind: type[Section], name: str) -> str:
    """What is read of a section by asking for an attribute: a value by its name, nothing for code of ours,
    which asks for values itself, and everything for whatever else there is."""
    if name in kind.model_fields:
        return name
    found = inspect.getattr_static(kind, name, None)
    code = found.fget if isinstance(found, property) else found
    ours = isinstance(code, types.FunctionType) and code.__module__.startswith("uuvtai.")
    return "" if found is None or ours or name == "__class__" else ALL
