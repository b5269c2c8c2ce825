"""What a kernel's machine code depends on, as one key: the sources that kernels see, the processor, and of
arrays and config what the kernel reads. Nothing of it asks Taichi to read a kernel."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import inspect
import json
import linecache
import os
import re
import stat
import time
import types
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import taichi as ti

from uuvtai.common.files import FileError, open_file, open_new, parsed_json, unfinished
from uuvtai.common.version import BEGUN_NS
from uuvtai.compile.launch import VARIABLE, Number, Numbers, as_arguments, asked_shape, worked_out
from uuvtai.config import Section

# ------------------------------------------------------------------------------------------------------------
# What of a bundle a kernel's code depends on: what was read and decided while Taichi compiled it, and nothing
# else. So another horizon compiles the termination check anew, and not the sonar; a longer forecast moves
# arrays, and compiles nothing that does not touch them.


ALL = "*"
"""a whole section: something was done with it that cannot be followed"""
_ARRAY = "@"  # before the name of an array, whose place is told ('@tracks.pos_w')


@contextlib.contextmanager
def noted(bundle: Any, spare: int = 0) -> Iterator[tuple[set[str], Numbers]]:
    """Names of the values of this bundle's sections ('behavior_cfg.n_heading') and of its arrays
    ('@tracks.pos_w') that code depends on which Taichi compiles meanwhile, and the numbers that are its
    arguments."""
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

    structs: dict[int, list[str]] = {}
    kinds = set()
    for place, struct in structs_in(bundle):
        structs.setdefault(id(struct), []).append(place)
        kinds.add(type(struct))

    def noting_arrays(struct: Any, name: str) -> Any:
        value = object.__getattribute__(struct, name)
        read = list(value) if name == "__dict__" else [name] if isinstance(value, ti.Field) else []
        for place in structs.get(id(struct), []):
            names.update(f"{_ARRAY}{place}.{array}" for array in read)
        return value

    Section.__getattribute__ = noting  # type: ignore[method-assign]
    for kind in kinds:
        kind.__getattribute__ = noting_arrays
    try:
        with as_arguments(numbers):
            yield names, numbers
    finally:
        del Section.__getattribute__
        for kind in kinds:
            del kind.__getattribute__


def structs_in(value: Any, place: str = "") -> list[tuple[str, Any]]:
    """Every dataclass of a bundle that has arrays, with its place there."""
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return []
    members = {member.name: getattr(value, member.name) for member in dataclasses.fields(value)}
    own = [(place, value)] if any(isinstance(member, ti.Field) for member in members.values()) else []
    inner = [structs_in(member, f"{place}.{name}".lstrip(".")) for name, member in members.items()]
    return sum(inner, own)


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


def values_of(names: Iterable[str], bundle: Any, tree: int) -> list[tuple[str, str]]:
    """(name, value) in the order of the names; a section that has parts of its own is told by its kind, an
    array, which must belong to ``tree``, by its place. Raises KeyNameError."""
    return [(name, _value(bundle, name, tree)) for name in sorted(names)]


def value_of(bundle: Any, name: str) -> Any:
    """What the config says; None where there is no such section."""
    for part in name.removesuffix(f".{ALL}").split("."):
        bundle = getattr(bundle, part, None)
    return bundle


def _value(bundle: Any, name: str, tree: int) -> str:
    if name.startswith(_ARRAY):
        return described(value_of(bundle, name.removeprefix(_ARRAY)), tree)
    if name == json.dumps(VARIABLE):
        return asked_shape()
    if name.startswith("["):
        # of another config, which goes another way before
        with contextlib.suppress(ArithmeticError, TypeError):
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


# ------------------------------------------------------------------------------------------------------------
# Machine code on disk: the user's own folder, one file a kernel, written whole or not at all.


_MAGIC = b"UUVNATIVE1\n"
MOST_BYTES = 512 << 20
_MOST_FILE_BYTES = 64 << 20
_SUFFIX = ".kernel"
_OWN = re.compile(r"[0-9a-f]{64}\.kernel|\.[0-9a-f]{64}\.kernel\.[0-9a-f]{8}\.tmp|tmp\w{8}\.part")
"""names that are given here: whole, unfinished, and unfinished as they were called before"""
_MOST_NAMES = 16
"""ways through a kernel's source that are remembered: each depends on something else of the config"""
_STALE_S = 3600.0  # age of an unfinished file whose writer is dead for sure [s]


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


# ------------------------------------------------------------------------------------------------------------


_SEEN_BY_KERNELS = (
    "kernels", "config", "state", "compile", "common/enums.py", "common/tree_codes.py",
)  # fmt: skip
"""files and folders of the package that a kernel's code can depend on (a test compares them with what the
kernels import)"""


class KeyNameError(Exception):
    """An argument of a kind that no key can name: Taichi launches this kernel itself."""


_ROOT = Path(__file__).parents[1]


@functools.cache
def digest_of_sources() -> str:
    """Of every source that a kernel can see, as this process imported it and as Taichi reads it from now on,
    whatever becomes of the files. Raises StoreError where one has changed since the process began."""
    digest, texts = hashlib.sha256(), {}
    for name in _SEEN_BY_KERNELS:
        for path in sorted((_ROOT / name).rglob("*.py")) if (_ROOT / name).is_dir() else [_ROOT / name]:
            texts[str(path)] = content = path.read_bytes()
            if path.stat().st_ctime_ns > BEGUN_NS:
                raise StoreError(f"{path}: has changed since this process began")
            digest.update(f"{path.relative_to(_ROOT)}\0".encode() + content + b"\0")
    for file, content in texts.items():  # no time of change: the entry is never looked at again
        linecache.cache[file] = (len(content), None, content.decode().splitlines(keepends=True), file)
    return digest.hexdigest()


def key_of(kernel: Any, arguments: tuple, surroundings: list) -> str:
    """64 hexadecimal digits that name ``kernel`` for these arguments whatever their config says and wherever
    their arrays lie; ``surroundings`` say which processor, compilers and runtime it is for. Raises
    KeyNameError."""
    function = kernel.func
    given = [
        "" if declared.annotation in (int, float) else described(value)
        for declared, value in zip(kernel.arguments, arguments, strict=True)
    ]
    parts = [digest_of_sources(), surroundings, function.__module__, function.__qualname__, given]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def key_with(key: str, names: Iterable[str], bundle: Any, tree: int) -> str:
    """64 hexadecimal digits that name a kernel's machine code: its ``key_of``, and what of its bundle it
    depends on (``noted``), whose arrays belong to ``tree``. Raises KeyNameError."""
    return hashlib.sha256(json.dumps([key, values_of(names, bundle, tree)]).encode()).hexdigest()


def described(value: Any, tree: int | None = None) -> str:
    """All of an argument that its kernel's code can depend on, but for values of the config; where arrays lie
    in ``tree``, if it is given. Raises KeyNameError."""
    if isinstance(value, Section):
        return type(value).__name__
    if isinstance(value, bool | int | str | None):
        return f"{type(value).__name__} {value!r}"
    if isinstance(value, ti.Field):
        return "array" if tree is None else _place(value, tree)
    if hasattr(value, "data_ptr"):
        return f"tensor {value.dtype} {value.ndim} {value.device.type} {value.is_contiguous()}"
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        members = [f"{m.name}: {described(getattr(value, m.name), tree)}" for m in dataclasses.fields(value)]
        return f"{type(value).__name__}({'; '.join(members)})"
    raise KeyNameError(type(value).__name__)


def _place(field: ti.Field, tree: int) -> str:
    """Type, shape and place of a field: the sizes of the nodes from it up to the root of its tree. How large
    the root is, whatever lies behind the field, does not matter."""
    node, path, found = field.vars[0].ptr.snode(), [], -1
    while node is not None:
        size = node.cell_size_bytes if node.parent is not None else 0
        path.append((str(node.type), size, node.offset_bytes_in_parent_cell))
        found, node = node.get_snode_tree_id(), node.parent
    if found != tree:
        raise KeyNameError(f"a field of tree {found} among those of tree {tree}")
    return f"{field.dtype} {field.shape} {len(field.vars)} {path}"
