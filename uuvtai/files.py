"""The one way in for files that a run folder or a stranger brings: regular files only, bounded in size, no link that leads elsewhere."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

from uuvtai.errors import UserError

MAX_BYTES = 1 << 30
"""[bytes] most that any file may bring into memory"""

_NO_FOLLOW = getattr(os, "O_NOFOLLOW", 0)  # absent on Windows, where making a link takes rights that a stranger does not have
_OPEN = os.O_RDONLY | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0)


class FileError(UserError):
    """A file that is not read: what it is, why not, what to do."""


def open_file(path: Path, limit: int = MAX_BYTES, folder: Path | None = None) -> BinaryIO:
    """Open a regular file of at most ``limit`` bytes for reading; neither a FIFO nor a device is waited for.

    ``folder``: the file must lie below it, with no link among the names in between; without it a link counts as the user's own, who typed
    the path. Raises FileError for what is refused, OSError (FileNotFoundError, PermissionError, ...) for what cannot be opened.
    """
    handle = os.open(path, _OPEN) if folder is None else _open_below(folder, path)
    try:
        found = os.fstat(handle)
        if not stat.S_ISREG(found.st_mode):
            raise FileError(f"{path}: is {_kind(found.st_mode)}; give a plain file")
        if found.st_size > limit:
            raise FileError(f"{path}: has {found.st_size:,} bytes, more than the {limit:,} that such a file may have")
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def read_bytes(path: Path, limit: int = MAX_BYTES, folder: Path | None = None) -> bytes:
    """Content of a file, as ``open_file`` opens it; never more than ``limit`` bytes, also where the file grows meanwhile."""
    with open_file(path, limit, folder) as file:
        content = file.read(limit + 1)
    if len(content) > limit:
        raise FileError(f"{path}: has more than the {limit:,} bytes that such a file may have")
    return content


def read_text(path: Path, limit: int = MAX_BYTES, folder: Path | None = None) -> str:
    """Text of a UTF-8 file, as ``read_bytes`` reads it. Raises FileError for another encoding."""
    try:
        return read_bytes(path, limit, folder).decode("utf-8")
    except UnicodeDecodeError as error:
        raise FileError(f"{path}: is not UTF-8 text (byte {error.start}); save it as UTF-8") from None


def refuse_links(folder: Path, path: Path) -> None:
    """Raise FileError where ``path``, which lies below ``folder``, is a link or lies behind one; what does not exist is no link."""
    place = folder
    for part in _parts_below(folder, path):
        place = place / part
        if place.is_symlink():
            raise FileError(f"{place}: is a link; what a link leads to is not ours to read, write or delete: remove the link")


def refuse_output(out: Path, inputs: Iterable[Path], force: bool) -> None:
    """Raise FileError where ``out`` must not be written: one of ``inputs``, or already there and ``force`` is not set.

    A link, a folder or a device there is refused with ``force`` too, and so is an input by another name.
    """
    for given in inputs:
        if _same(out, given):
            raise FileError(f"{out}: is what is read here ({given}); give --out another name")
    try:
        found = os.lstat(out)
    except (FileNotFoundError, NotADirectoryError):
        return
    if stat.S_ISLNK(found.st_mode):
        raise FileError(f"{out}: is a link; give --out the name of a new file")
    if not stat.S_ISREG(found.st_mode):
        raise FileError(f"{out}: is {_kind(found.st_mode)}; give --out the name of a new file")
    if not force:
        raise FileError(f"{out}: is already there; give another --out, or --force to replace it")


def _same(one: Path, other: Path) -> bool:
    """Whether two paths name one file, by whatever links; a name that nothing has yet counts by where it would lie."""
    try:
        return one.samefile(other)
    except OSError:
        return os.path.realpath(one) == os.path.realpath(other)


def _open_below(folder: Path, path: Path) -> int:
    """File descriptor of ``path``, opened name by name from ``folder`` on, so that no name can turn into a link meanwhile."""
    parts = _parts_below(folder, path)
    if os.open not in os.supports_dir_fd:
        refuse_links(folder, path)
        return os.open(path, _OPEN)
    place = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        for i, part in enumerate(parts):
            flags = _OPEN | _NO_FOLLOW | (os.O_DIRECTORY if i < len(parts) - 1 else 0)
            try:
                inner = os.open(part, flags, dir_fd=place)
            except OSError:
                refuse_links(folder, path)  # the likely reason, in words
                raise
            os.close(place)
            place = inner
    except OSError as error:
        os.close(place)
        if error.filename is not None:
            error.filename = str(path)
        raise
    except BaseException:
        os.close(place)
        raise
    return place


def _parts_below(folder: Path, path: Path) -> tuple[str, ...]:
    try:
        parts = path.relative_to(folder).parts
    except ValueError:
        parts = ()
    if not parts or ".." in parts:
        raise FileError(f"{path}: does not lie in {folder}")
    return parts


def _kind(mode: int) -> str:
    kinds = {
        stat.S_IFDIR: "a folder",
        stat.S_IFIFO: "a pipe",
        stat.S_IFSOCK: "a socket",
        stat.S_IFCHR: "a device",
        stat.S_IFBLK: "a device",
    }
    return kinds.get(stat.S_IFMT(mode), "no plain file")
