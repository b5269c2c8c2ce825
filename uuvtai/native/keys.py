"""What a kernel's machine code depends on, as one key: the sources that kernels see, the arrays' places, the
processor, and the values of the config that the kernel reads. Nothing of it asks Taichi to read a kernel."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import linecache
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import taichi as ti

from uuvtai.config import Section
from uuvtai.native.reads import values_of
from uuvtai.native.store import StoreError
from uuvtai.version import BEGUN_NS

_SEEN_BY_KERNELS = (
    "kernels", "config", "state", "native", "taichi_patches",
    "forecast_codes.py", "multibeam.py", "outcomes.py", "plan_codes.py", "tree_codes.py", "truth.py",
    "tuned_numbers.py",
)  # fmt: skip
"""files and folders of the package that a kernel's code can depend on (``tests/test_native.py`` compares them
with what the kernels import)"""


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


def key_of(kernel: Any, arguments: tuple, tree: int, surroundings: list) -> str:
    """64 hexadecimal digits that name ``kernel`` for these arguments whatever their config says;
    ``surroundings`` say which processor, compilers and runtime it is for. Raises KeyNameError."""
    function = kernel.func
    given = [
        "" if declared.annotation in (int, float) else described(value, tree)
        for declared, value in zip(kernel.arguments, arguments, strict=True)
    ]
    parts = [digest_of_sources(), surroundings, function.__module__, function.__qualname__, given]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def key_with(key: str, names: Iterable[str], bundle: Any) -> str:
    """64 hexadecimal digits that name a kernel's machine code: its ``key_of``, and what of its bundle's
    config it depends on (``reads.noted``)."""
    return hashlib.sha256(json.dumps([key, values_of(names, bundle)]).encode()).hexdigest()


def described(value: Any, tree: int) -> str:
    """All of an argument that its kernel's code can depend on, but for values of the config; fields must
    belong to ``tree``. Raises KeyNameError."""
    if isinstance(value, Section):
        return type(value).__name__
    if isinstance(value, bool | int | str | None):
        return f"{type(value).__name__} {value!r}"
    if isinstance(value, ti.Field):
        return _place(value, tree)
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
