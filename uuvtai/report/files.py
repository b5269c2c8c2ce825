"""Reading a run folder: what is wrong with a file is said, and nothing that stands in one is executed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from uuvtai.loader import ConfigError


def read_json(path: Path) -> dict[str, Any] | None:
    """The document, or None where there is no such file. Raises ConfigError for one that is no JSON object."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:
        raise ConfigError(f"{path}: is not valid JSON ({error}); write it again with the command in run.json") from None
    if not isinstance(document, dict):
        raise ConfigError(f"{path}: is no JSON object; write it again with the command in run.json")
    return document


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Objects of a JSONL file, [] where there is none; a last line that a kill cut off is left out. Raises ConfigError."""
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except FileNotFoundError:
        return []
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    found = []
    for i, line in enumerate(lines, start=1):
        try:
            found.append(dict(json.loads(line)))
        except (ValueError, TypeError):
            if i < len(lines):
                raise ConfigError(f"{path}, line {i}: is no JSON object; take that line out to go on without it") from None
    return found


def read_text(path: Path) -> str | None:
    """Text of a file, or None where there is none."""
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
