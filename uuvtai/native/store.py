"""Machine code on disk: the user's own folder, one file a kernel, written whole or not at all."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
import re
import stat
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from uuvtai.files import FileError, open_file, open_new, parsed_json, unfinished

_MAGIC = b"UUVNATIVE1\n"
MOST_BYTES = 512 << 20
_MOST_FILE_BYTES = 64 << 20
_SUFFIX = ".kernel"
_OWN = re.compile(r"[0-9a-f]{64}\.kernel|\.[0-9a-f]{64}\.kernel\.[0-9a-f]{8}\.tmp|tmp\w{8}\.part")
"""names that are given here: whole, unfinished, and unfinished as they were called before"""
_MOST_NAMES = 16
"""ways through a kernel's source that are remembered: each depends on something else of the config"""
_STALE_S = 3600.0
"""age of an unfinished file whose writer is dead for sure [s]"""


class StoreError(Exception):
    """The folder or a file in it cannot be trusted or used: what, and what to do."""


@dataclass(frozen=True)
class MachineCode:
    """A kernel's machine code."""

    tasks: list[str]
    """names of its functions, in order"""
    machine: bytes
    """an object file"""
    numbers: list[Any] = dataclasses.field(default_factory=list)
    """what its last arguments are to be (``numbers.Sum``)"""


def default_folder() -> Path:
    """``UUV_NATIVE_CACHE``, or uuvtai/native in the user's cache folder."""
    if chosen := os.environ.get("UUV_NATIVE_CACHE"):
        return Path(chosen)
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache) / "uuvtai" / "native"


class Store:
    """Files by key in one folder that nobody else can write to."""

    def __init__(self, folder: Path) -> None:
        """Makes the folder if it is missing. Raises StoreError where it cannot be made or is not the user's
        own."""
        self.folder = folder
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            _refuse_foreign(folder, os.lstat(folder), stat.S_ISDIR)
        except OSError as error:
            raise StoreError(f"{folder}: {error.strerror}") from error

    def get(self, key: str) -> MachineCode | None:
        """What was put there, None where nothing was or it is damaged. Raises StoreError for a foreign
        file."""
        path = self.folder / (key + _SUFFIX)
        try:
            with open_file(path, _MOST_FILE_BYTES, self.folder) as file:
                _refuse_foreign(path, os.fstat(file.fileno()), stat.S_ISREG)
                content = file.read(_MOST_FILE_BYTES)
        except FileNotFoundError:
            return None
        except FileError as error:
            raise StoreError(str(error)) from error
        except OSError as error:
            raise StoreError(f"{path}: {error.strerror}") from error
        with contextlib.suppress(OSError):
            os.utime(path)  # what is used stays longest
        return _unpacked(content, key)

    def put(self, key: str, code: MachineCode) -> None:
        """Keep it. Raises StoreError where the disk refuses; nothing half is left."""
        head = json.dumps({"key": key, "tasks": code.tasks, "numbers": code.numbers}).encode() + b"\n"
        digest = hashlib.sha256(head + code.machine).hexdigest().encode()
        content = _MAGIC + digest + b"\n" + head + code.machine
        target = self.folder / (key + _SUFFIX)
        place = unfinished(target)
        try:
            with open_new(place, 0o600) as file:
                file.write(content)
            place.replace(target)
        except OSError as error:
            with contextlib.suppress(OSError):
                place.unlink()
            raise StoreError(f"{self.folder}: {error.strerror}") from error

    def names(self, key: str) -> list[list[str]]:
        """What was kept by ``put_names``, newest first: where code is to be looked for. Raises StoreError."""
        found = self.get(key)
        return found.numbers if found else []

    def put_names(self, key: str, names: list[str]) -> None:
        """Note that there is code of a kernel that depends on this of the config; another process may have
        noted something meanwhile, which is lost then: its code will be made anew. Raises StoreError."""
        others = [known for known in self.names(key) if known != names]
        self.put(key, MachineCode([], b"", [names, *others][:_MOST_NAMES]))

    def files(self) -> list[Path]:
        """What is kept; the folder may be one where others keep something too."""
        return [path for path in self.folder.iterdir() if _OWN.fullmatch(path.name)]

    def clear(self) -> int:
        """Delete all of them; how many."""
        return self.bound(0)

    def bound(self, most_bytes: int = MOST_BYTES) -> int:
        """Delete what killed processes left, then what was used longest ago until the rest fits; how many
        files of the latter."""
        files, now = [], time.time()
        for path in self.files():
            with contextlib.suppress(OSError):
                found = path.lstat()
                if path.suffix != _SUFFIX and now - found.st_mtime > _STALE_S:
                    path.unlink()
                    continue
                files.append((found.st_mtime, found.st_size, path))
        files.sort()  # longest ago first
        total, deleted = sum(size for _, size, _ in files), 0
        for _, size, path in files:
            if total <= most_bytes:
                break
            with contextlib.suppress(OSError):
                path.unlink()
                deleted += 1
            total -= size
        return deleted


def _refuse_foreign(path: Path, found: os.stat_result, is_kind: object) -> None:
    if not is_kind(found.st_mode):  # type: ignore[operator]
        raise StoreError(f"{path}: is a link or something else than expected; delete it")
    if found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise StoreError(
            f"{path}: others could have written it; delete it, or 'chmod go-w' it if it is yours"
        )


def _unpacked(content: bytes, key: str) -> MachineCode | None:
    if not content.startswith(_MAGIC):
        return None
    digest, _, rest = content[len(_MAGIC) :].partition(b"\n")
    if hashlib.sha256(rest).hexdigest().encode() != digest:
        return None
    head, _, machine = rest.partition(b"\n")
    known = parsed_json(head, key)
    return MachineCode(known["tasks"], machine, known["numbers"]) if known["key"] == key else None
