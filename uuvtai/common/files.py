"""The one way in for files that a stranger brings: regular, bounded in size, no link elsewhere."""

from __future__ import annotations

import errno
import json
import math
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import Any, BinaryIO

from uuvtai.common import signals
from uuvtai.common.errors import UserError

MAX_BYTES = 1 << 30  # [bytes] most that any file may bring into memory
MAX_JSON_BYTES = 64 << 20  # [bytes] most that a JSON document may have
_MAX_JSON_CONTAINERS, _MAX_JSON_VALUES = 1_000_000, 8_000_000
"""of one document: in memory an empty list takes thirty times the two bytes that it is written with"""
_MAX_INTEGER = 1 << 128  # what the state of a random generator takes; a float holds it too
_MAX_ENTRIES = 1_000_000  # files and folders of one run folder: more are not counted

_NO_FOLLOW = getattr(
    os, "O_NOFOLLOW", 0
)  # absent on Windows, where making a link takes rights that a stranger does not have
_ALWAYS = (
    getattr(os, "O_CLOEXEC", 0)
    | getattr(os, "O_BINARY", 0)
    | getattr(os, "O_NONBLOCK", 0)
    | getattr(os, "O_NOCTTY", 0)
)
_OPEN, _CHANGE = os.O_RDONLY | _ALWAYS, os.O_RDWR | _ALWAYS
_CREATE = os.O_WRONLY | os.O_CREAT | _NO_FOLLOW | _ALWAYS
_FOLDER = os.O_RDONLY | getattr(os, "O_DIRECTORY", 0) | getattr(os, "O_CLOEXEC", 0)
_NO_FILE = (errno.ENXIO, errno.ENODEV, errno.EISDIR)
"""what opening a socket, a pipe that nobody reads or a folder may say"""
UNFINISHED = re.compile(r"\..+\.[0-9a-f]{8}\.tmp(\.\w+)?")  # names by ``unfinished`` that go with the writer
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")


class FileError(UserError):
    """A file that is not read: what it is, why not, what to do."""


@contextmanager
def refusing(
    kind: type[Exception], what: str, instead: str = "", refused: str | None = None
) -> Iterator[None]:
    """What the system refuses inside (OSError) is told as ``kind``: ``what``, why, what to do ``instead``.
    ``refused``: what to do about a FileError, which becomes such an error too; None = it stays one."""
    try:
        yield
    except OSError as error:
        raise kind(f"{what} ({error.strerror or error}){instead and f'; {instead}'}") from None
    except FileError as error:
        if refused is None:
            raise
        raise kind(f"{error}{refused and f'; {refused}'}") from None


def open_file(path: Path, limit: int = MAX_BYTES, folder: Path | None = None) -> BufferedReader:
    """Open a regular file of at most ``limit`` bytes for reading; neither a FIFO nor a device is waited for.

    ``folder``: the file must lie below it, with no link among the names in between; without it a link counts
    as the user's own, who typed the path. Raises FileError for what is refused, OSError (FileNotFoundError,
    PermissionError, ...) for what cannot be opened.
    """
    handle = _open(path, folder, _OPEN)
    try:
        found = os.fstat(handle)
        if not stat.S_ISREG(found.st_mode):
            raise FileError(f"{path}: is {_kind(found.st_mode)}; give a plain file")
        if found.st_size > limit:
            raise FileError(
                f"{path}: has {found.st_size:,} bytes, more than the {limit:,} that such a file may have"
            )
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def read_bytes(path: Path, limit: int = MAX_BYTES, folder: Path | None = None) -> bytes:
    """Content of a file, as ``open_file`` opens it; never more than ``limit`` bytes, even if it grows."""
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


def read_json(path: Path, limit: int = MAX_JSON_BYTES, folder: Path | None = None) -> Any:
    """Value of a JSON file, as ``read_bytes`` reads it and ``parsed_json`` understands it."""
    return parsed_json(read_bytes(path, limit, folder), str(path))


def parsed_json(content: bytes | str, where: str) -> Any:
    """Value of a JSON text from elsewhere: finite numbers, integers of 128 bits, no more than fits 1 GiB of
    memory.

    Raises FileError, which names ``where``.
    """
    try:
        text = content.decode("utf-8") if isinstance(content, bytes) else content
        if text.count("{") + text.count("[") > _MAX_JSON_CONTAINERS or text.count(",") > _MAX_JSON_VALUES:
            raise FileError(
                f"{where}: holds more than {_MAX_JSON_CONTAINERS:,} lists and objects or "
                f"{_MAX_JSON_VALUES:,} values"
            )
        value = json.loads(text, parse_constant=_no_constant, parse_float=_finite, parse_int=_whole)
        if _SURROGATE.search(text):
            json.dumps(
                value, ensure_ascii=False
            ).encode()  # half a character cannot be written anywhere again
    except (ValueError, RecursionError) as error:
        raise FileError(f"{where}: is not valid JSON ({error})") from None
    return value


def json_object(content: bytes | str) -> dict[str, Any] | None:
    """The object of a JSON text that ``parsed_json`` takes; None for anything else."""
    try:
        value = parsed_json(content, "")
    except FileError:
        return None
    return value if isinstance(value, dict) else None


def read_lines(
    path: Path, limit: int = MAX_BYTES, folder: Path | None = None, longest: int = 1 << 20
) -> Iterator[bytes]:
    """Lines of a file one by one, with their ends; FileError for one of more than ``longest`` bytes."""
    with open_file(path, limit, folder) as file:
        left = limit
        while line := file.readline(longest + 1):
            left -= len(line)
            if len(line) > longest or left < 0:
                raise FileError(
                    f"{path}: has a line of more than {longest:,} bytes, or more than {limit:,} in all"
                )
            yield line


def refuse_links(folder: Path, path: Path) -> None:
    """Raise FileError where ``path``, below ``folder``, is a link or behind one; absence is no link."""
    place = folder
    for part in _parts_below(folder, path):
        place = place / part
        if place.is_symlink():
            raise FileError(
                f"{place}: is a link; what a link leads to is not ours to read, write or delete: remove the "
                "link"
            )


def refuse_links_in(folder: Path) -> None:
    """Raise FileError for any link below ``folder``: all there may be read and deleted. Raises OSError."""
    waiting, count = [str(folder)], 0
    while waiting:
        with os.scandir(waiting.pop()) as entries:
            for entry in entries:
                count += 1
                if entry.is_symlink() or _is_junction(entry):
                    raise FileError(
                        f"{entry.path}: is a link; what a link leads to is not ours to read, write or "
                        "delete: give a run folder, without links"
                    )
                if count > _MAX_ENTRIES:
                    raise FileError(f"{folder}: holds more than {_MAX_ENTRIES:,} files; no run folder does")
                if entry.is_dir(follow_symlinks=False):
                    waiting.append(entry.path)


def open_new(path: Path, mode: int = 0o666) -> BinaryIO:
    """Open a new file for writing; whatever is there, a link too, is a FileExistsError. Raises OSError."""
    return os.fdopen(os.open(path, _CREATE | os.O_EXCL, mode), "wb")


def unfinished(target: Path, ending: str = ".tmp") -> Path:
    """A name beside ``target`` that nobody can have taken, or made a link of, before. What is to stay where
    its writer is killed, a recording, ends in '.part' and is not hidden."""
    hidden = "" if ending == ".part" else "."
    return target.with_name(f"{hidden}{target.name}.{secrets.token_hex(4)}{ending}")


@contextmanager
def whole_file(target: Path, ending: str = ".tmp") -> Iterator[tuple[BinaryIO, Path]]:
    """A new file and its name meanwhile; it becomes ``target`` when on the disk, or goes. OSError."""
    signals.engage()
    place = unfinished(target, ending)
    opened = open_new(place)
    try:
        with opened as file:
            yield file, place
            file.flush()
            os.fsync(file.fileno())
        place.replace(target)
    except BaseException:
        place.unlink(missing_ok=True)
        raise


@contextmanager
def whole_folder(target: Path) -> Iterator[Path]:
    """A new folder to fill; it becomes ``target``, which may be empty by then, or goes. Raises OSError."""
    signals.engage()
    place = unfinished(target)
    place.mkdir(parents=True)
    try:
        yield place
        if target.is_dir() and not target.is_symlink():
            target.rmdir()  # only where it is empty
        place.rename(target)
    finally:
        shutil.rmtree(place, ignore_errors=True)


def open_to_append(path: Path, folder: Path) -> BinaryIO:
    """Open a file below ``folder`` for writing at its end, made if it is missing. Raises FileError for what
    is not ours, OSError.

    A file with a second name (hard link) is refused: what is written would turn up under the other name too.
    """
    return os.fdopen(_open_to_change(path, folder, _CREATE | os.O_APPEND), "ab")


def truncate(path: Path, size: int, folder: Path) -> None:
    """Cut a file below ``folder`` to its first ``size`` bytes. Raises as ``open_to_append``."""
    handle = _open_to_change(path, folder, _CHANGE)
    try:
        os.ftruncate(handle, size)
    finally:
        os.close(handle)


def flush(path: Path) -> None:
    """See a file, or the names in a folder, on the disk. Raises OSError."""
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_CLOEXEC", 0))
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def output_beside(sources: Sequence[Path], out: Path | None, suffix: str, force: bool) -> Path:
    """Where to write: ``out``, or the first file with another ending. Raises as ``refuse_output``."""
    target = out or sources[0].with_suffix(suffix)
    refuse_output(target, sources, force)
    return target


def refuse_output(out: Path, inputs: Iterable[Path], force: bool | None) -> None:
    """Raise FileError where ``out`` must not be written: one of ``inputs``, or already there and ``force`` is
    not set.

    A link, a folder or a device there is refused with ``force`` too, and so is an input by another name.
    None: the command knows no --force.
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
        more = "" if force is None else ", or --force to replace it"
        raise FileError(f"{out}: is already there; give another --out{more}")


def _no_constant(text: str) -> float:
    raise ValueError(f"{text} is no number of JSON")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:40]} is beyond what a number holds")
    return value


def _whole(text: str) -> int:
    value = int(text) if len(text) <= len(str(-_MAX_INTEGER)) else _MAX_INTEGER + 1
    if abs(value) > _MAX_INTEGER:
        raise ValueError(f"{text[:40]} is beyond 128 bits")
    return value


def _is_junction(entry: os.DirEntry[str]) -> bool:
    """A folder elsewhere under a name here, as Windows has them."""
    return os.name == "nt" and bool(os.lstat(entry.path).st_reparse_tag)  # type: ignore[attr-defined]


def _same(one: Path, other: Path) -> bool:
    """Whether two paths name one file, by whatever links; a name without a file counts by its place."""
    try:
        return one.samefile(other)
    except OSError:
        return os.path.realpath(one) == os.path.realpath(other)


def _open_to_change(path: Path, folder: Path, flags: int) -> int:
    handle = _open(path, folder, flags)
    try:
        found = os.fstat(handle)
        if not stat.S_ISREG(found.st_mode):
            raise FileError(f"{path}: is {_kind(found.st_mode)}; a run folder holds plain files: remove it")
        if found.st_nlink > 1:
            raise FileError(
                f"{path}: has a second name (a hard link), which would change too; put a copy in its place"
            )
    except BaseException:
        os.close(handle)
        raise
    return handle


def _open(path: Path, folder: Path | None, flags: int) -> int:
    try:
        return os.open(path, flags) if folder is None else _open_below(folder, path, flags)
    except OSError as error:
        if error.errno in _NO_FILE:
            raise FileError(f"{path}: is no plain file ({error.strerror})") from None
        raise


def _open_below(folder: Path, path: Path, flags: int) -> int:
    """File descriptor of ``path``, opened name by name from ``folder`` on: no name can become a link."""
    parts = _parts_below(folder, path)
    if os.open not in os.supports_dir_fd:
        refuse_links(folder, path)
        return os.open(path, flags, 0o666)
    place = os.open(folder, _FOLDER)
    try:
        for i, part in enumerate(parts):
            try:
                inner = os.open(
                    part, _NO_FOLLOW | (flags if i == len(parts) - 1 else _FOLDER), 0o666, dir_fd=place
                )
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
