"""What an entry is made of as sha256: the package's sources, the config, the episodes, the pilot's own
files."""

from __future__ import annotations

import hashlib
import itertools
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from uuvtai.config import Config
from uuvtai.files import FileError, read_bytes
from uuvtai.own.piece_spec import PieceSpec

PACKAGE = Path(__file__).resolve().parents[2]
_NO_SOURCE = {"__pycache__"}
_MAX_FILES, _MAX_BYTES = 200, 256 << 20
"""of a pilot: more are not looked into"""


def canonical(document: Any) -> bytes:
    """One text for one value: keys sorted, no spaces, numbers as Python writes them."""
    return json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def digest_of(document: Any) -> str:
    """sha256 of a JSON document."""
    return hashlib.sha256(canonical(document)).hexdigest()


def sealed(entry: dict[str, Any]) -> dict[str, Any]:
    """An entry with the sha256 of all the rest. It shows that a file was damaged or changed by hand; it
    proves nothing about who wrote it, for everybody can compute it."""
    whole = {key: value for key, value in entry.items() if key != "seal"}
    return whole | {"seal": digest_of(whole)}


def sources_sha256() -> str:
    """Of every file of the package: name and content."""
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*")):
        if path.is_file() and not _NO_SOURCE & set(path.parts):
            content = hashlib.sha256(read_bytes(path)).hexdigest()
            digest.update(f"{path.relative_to(PACKAGE).as_posix()} {content}\n".encode())
    return digest.hexdigest()


def condition_sha256(config: Config) -> str:
    """Of a scene's config; how it is computed (``runtime``) is no part of it."""
    return digest_of(config.model_dump(mode="json", exclude={"runtime"}))


def piece_files(spec: PieceSpec) -> dict[str, str]:
    """sha256 of a piece's own files, by their names beside it: its file, the modules there that it has
    imported, and what its argument names. Raises FileError where these are too many or too large."""
    folder = spec.path.resolve().parent
    argument = [Path(spec.argument).resolve()] if spec.argument and Path(spec.argument).exists() else []
    paths = {spec.path.resolve(), *_modules_below(folder)}
    paths |= {path for place in argument for path in ([place] if place.is_file() else _files_in(place))}
    found, left = {}, _MAX_BYTES
    for path in sorted(paths):
        if len(found) >= _MAX_FILES:
            raise FileError(
                f"{spec.path}: brings more than {_MAX_FILES} files; put it into a folder of its own"
            )
        content = read_bytes(path, left)
        left -= len(content)
        name = path.relative_to(folder) if path.is_relative_to(folder) else Path(path.name)
        found[name.as_posix()] = hashlib.sha256(content).hexdigest()
    return found


def _modules_below(folder: Path) -> Iterator[Path]:
    """Files of the modules that were imported from a folder as a Python beside the piece is: FOLDER/name.py
    or FOLDER/name/..., not what happens to be installed somewhere below."""
    for module in list(sys.modules.values()):
        name = getattr(module, "__file__", None)
        path = Path(name).resolve() if isinstance(name, str) and name.endswith(".py") else None
        if path is None or not path.is_relative_to(folder) or path.is_relative_to(PACKAGE):
            continue
        parts = path.relative_to(folder).parts
        if path.is_file() and (len(parts) == 1 or module.__name__.split(".")[0] == parts[0]):
            yield path


def _files_in(folder: Path) -> Iterator[Path]:
    """As many files of a folder as there may be, and one more."""
    there = (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    return itertools.islice(there, _MAX_FILES + 1)
