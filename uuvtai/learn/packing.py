"""Nested state as named tensors and plain JSON, and back to the last bit; big arrays as one compressed stream
of known size."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
import zstandard

from uuvtai.errors import UserError
from uuvtai.files import open_file, open_new

Layout = list[tuple[str, str, list[int]]]
"""(name, NumPy dtype, shape) of every array in a stream, in order"""

MAX_STREAM_BYTES = 1 << 40
"""[bytes] of a stream on disk, of which no more is read than its reader expects"""
_LEVEL = 1
"""of zstandard: higher ones save a few per cent of disk and take several times as long"""


class PackingError(UserError, ValueError):
    """Something that cannot be packed, or a packed state that does not fit together."""


def pack(state: Any, name: str = "state", copy: bool = True) -> tuple[Any, dict[str, torch.Tensor]]:
    """(plain, tensors): ``plain`` is JSON with references to ``tensors`` on the host, contiguous, by default
    copies apart from each other.

    Dictionaries, lists, tuples, tensors, NumPy arrays, numbers, texts, booleans and None are kept as they
    are; anything else is a PackingError that names the place.
    """
    tensors: dict[str, torch.Tensor] = {}
    return _packed(state, name, tensors, copy), tensors


def unpack(plain: Any, tensors: dict[str, torch.Tensor]) -> Any:
    """The state that ``pack`` was given. Raises PackingError."""
    try:
        return _unpacked(plain, tensors)
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise PackingError(f"the packed state does not fit together ({error!r})") from None


def _packed(node: Any, place: str, tensors: dict[str, torch.Tensor], copy: bool) -> Any:
    if isinstance(node, torch.Tensor | np.ndarray):
        if place in tensors:
            raise PackingError(f"{place}: two tensors have this name")
        is_array = isinstance(node, np.ndarray)
        tensor = torch.from_numpy(np.asarray(node, order="C")) if is_array else node.detach()
        tensors[place] = tensor.to("cpu", copy=copy).contiguous()
        return {"$array" if is_array else "$tensor": place}
    if isinstance(node, dict):
        if all(isinstance(key, str) and not key.startswith("$") for key in node):
            return {key: _packed(value, f"{place}.{key}", tensors, copy) for key, value in node.items()}
        return {
            "$items": [
                [_packed(key, place, tensors, copy), _packed(value, f"{place}.{key}", tensors, copy)]
                for key, value in node.items()
            ]
        }
    if isinstance(node, list | tuple):
        items = [_packed(value, f"{place}.{i}", tensors, copy) for i, value in enumerate(node)]
        return items if isinstance(node, list) else {"$tuple": items}
    if isinstance(node, float) and not math.isfinite(node):
        return {"$float": repr(float(node))}
    if node is None or type(node) in (bool, int, float, str):
        return node
    raise PackingError(f"{place}: a {type(node).__name__} cannot be kept in a checkpoint")


def _unpacked(node: Any, tensors: dict[str, torch.Tensor]) -> Any:
    if isinstance(node, list):
        return [_unpacked(value, tensors) for value in node]
    if not isinstance(node, dict):
        return node
    match list(node.items()):
        case [("$tensor", name)]:
            return tensors[name]
        case [("$array", name)]:
            return tensors[name].numpy()
        case [("$items", items)]:
            return {_unpacked(key, tensors): _unpacked(value, tensors) for key, value in items}
        case [("$tuple", items)]:
            return tuple(_unpacked(value, tensors) for value in items)
        case [("$float", text)]:
            return float(text)
        case items:
            return {key: _unpacked(value, tensors) for key, value in items}


# ---------------------------------------------------------------------------------------------------- streams


def layout_of(tensors: dict[str, torch.Tensor]) -> Layout:
    """Names, dtypes and shapes, in the order of ``tensors``."""
    return [(name, str(tensor.numpy().dtype), list(tensor.shape)) for name, tensor in tensors.items()]


def write_stream(path: Path, tensors: dict[str, torch.Tensor]) -> None:
    """Compress host tensors one after the other into a new file."""
    size = sum(tensor.nbytes for tensor in tensors.values())
    compressor = zstandard.ZstdCompressor(level=_LEVEL, write_checksum=True)
    with open_new(path) as file, compressor.stream_writer(file, size=size, closefd=False) as stream:
        for tensor in tensors.values():
            stream.write(_bytes_of(tensor.numpy()))


def read_stream(path: Path, layout: Layout) -> dict[str, torch.Tensor]:
    """Read exactly what ``layout`` says, so that a file cannot unfold to more than its reader expects. Raises
    PackingError."""
    tensors = {}
    try:
        with (
            open_file(path, MAX_STREAM_BYTES, path.parent) as file,
            zstandard.ZstdDecompressor().stream_reader(file) as stream,
        ):
            for name, dtype, shape in layout:
                array = np.empty(shape, dtype)
                _fill(_bytes_of(array), stream, name)
                tensors[name] = torch.from_numpy(array)
            if stream.read(1):
                raise PackingError("holds more than its layout says")
    except zstandard.ZstdError as error:
        raise PackingError(f"is not a whole zstandard stream ({error})") from None
    return tensors


def _bytes_of(array: np.ndarray) -> memoryview:
    return array.reshape(-1).view(np.uint8).data


def _fill(view: memoryview, stream: zstandard.ZstdDecompressionReader, name: str) -> None:
    filled = 0
    while filled < len(view):
        count = stream.readinto(view[filled:])
        if not count:
            raise PackingError(f"ends within {name}")
        filled += count
