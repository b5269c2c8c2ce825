"""Reading a run folder: what is wrong with a file is said, and nothing that stands in one is executed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from uuvtai import files
from uuvtai.files import FileError, parsed_json
from uuvtai.loader import MAX_BYTES as MAX_YAML_BYTES
from uuvtai.loader import ConfigError

_MAX_LINES = 1_000_000
_MOST = {
    "methods": 200,
    "cells": 20_000,
    "rows": 200,
    "paper_latency": 1000,
    "paper_density": 1000,
    "sections": 200,
}
"""entries of a result's lists that a page has room for: each is drawn, and drawing takes time"""
_MOST_VALUES = 10_000
"""of an axis of a sweep"""


def read_json(run: Path, name: str) -> dict[str, Any] | None:
    """The document ``name`` of a run folder, or None where there is no such file. Raises ConfigError for one
    that is no JSON object."""
    path = run / name
    try:
        document = files.read_json(path, folder=run)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except FileError as error:
        raise ConfigError(f"{error}; write it again with the command in run.json") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    if not isinstance(document, dict):
        raise ConfigError(f"{path}: is no JSON object; write it again with the command in run.json")
    _refuse_many(document, path)
    return document


def _refuse_many(document: dict[str, Any], path: Path) -> None:
    """Raise ConfigError for a document that would be drawn for hours."""
    axes = document.get("axes")
    lists = [(name, document.get(name), most) for name, most in _MOST.items()]
    lists += (
        [(f"axes.{name:.40}", values, _MOST_VALUES) for name, values in axes.items()]
        if isinstance(axes, dict)
        else []
    )
    for name, entries, most in [*lists, ("axes", axes, _MOST["methods"])]:
        if isinstance(entries, list | dict) and len(entries) > most:
            raise ConfigError(
                f"{path}: {name} has {len(entries):,} entries, more than the {most:,} that a page has room "
                "for"
            )


def read_lines(run: Path, name: str) -> list[dict[str, Any]]:
    """Objects of a JSONL file, [] where there is none; a last line that a kill cut off is left out. Raises
    ConfigError."""
    path, found, damaged = run / name, [], 0
    try:
        for i, line in enumerate(files.read_lines(path, files.MAX_JSON_BYTES, run), start=1):
            if damaged or i > _MAX_LINES:
                why = (
                    "is no JSON object; take that line out to go on without it"
                    if damaged
                    else f"is one of more than {_MAX_LINES:,}"
                )
                raise ConfigError(f"{path}, line {damaged or i}: {why}")
            row = _object(line)
            if row is None:
                damaged = i
            else:
                found.append(row)
    except FileNotFoundError:
        return []
    except FileError as error:
        raise ConfigError(str(error)) from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    return found


def _object(line: bytes) -> dict[str, Any] | None:
    try:
        row = parsed_json(line, "a line")
    except FileError:
        return None
    if not isinstance(row, dict):
        return None
    return {
        key: value for key, value in row.items() if not isinstance(value, list | dict)
    }  # a record of figures


def read_config(run: Path) -> str | None:
    """Text of config.yaml, or None where there is none. Raises ConfigError for what is no small text."""
    path = run / "config.yaml"
    try:
        return files.read_text(path, MAX_YAML_BYTES, run)
    except FileNotFoundError:
        return None
    except FileError as error:
        raise ConfigError(str(error)) from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
