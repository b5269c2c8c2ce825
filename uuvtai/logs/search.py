"""Where the next whole chunk of a damaged log begins: lengths that lie cannot be followed, so its bytes are
searched."""

from __future__ import annotations

import struct
from typing import BinaryIO

from mcap.opcode import Opcode

from uuvtai.logs.container import CHUNK_HEAD

_HEAD = struct.Struct("<BQQQQII4sQ")
"""opcode, record length, first and last time, size, CRC, length and name of the compression, length of the
data"""
_MARK = struct.pack("<I4s", 4, b"zstd")
_MARK_AT = 37
"""[bytes] from the beginning of a chunk record to the mark"""
_BLOCK = 1 << 20


def next_chunk(file: BinaryIO, start: int, size: int) -> int | None:
    """Place of the first zstd chunk at or behind ``start`` that fits the file of ``size`` bytes and whose two
    lengths agree; or None."""
    at = start + _MARK_AT
    while at < size:
        file.seek(at)
        block = file.read(_BLOCK + len(_MARK) - 1)
        found = block.find(_MARK)
        while found >= 0:
            place = at + found - _MARK_AT
            if _is_chunk(file, place, size):
                return place
            found = block.find(_MARK, found + 1)
        at += _BLOCK
    return None


def true_length(file: BinaryIO, place: int, size: int) -> int | None:
    """Length that a chunk record at ``place`` should have by the length of its data; None where no zstd chunk
    begins or it does not fit."""
    head = _head(file, place)
    if head is None:
        return None
    length = CHUNK_HEAD + head[-1]
    return length if place + 9 + length <= size else None


def _is_chunk(file: BinaryIO, place: int, size: int) -> bool:
    head = _head(file, place)
    return head is not None and head[1] == true_length(file, place, size)


def _head(file: BinaryIO, place: int) -> tuple | None:
    file.seek(place)
    content = file.read(_HEAD.size)
    if len(content) < _HEAD.size:
        return None
    head = _HEAD.unpack(content)
    return head if head[0] == Opcode.CHUNK and content[_MARK_AT : _MARK_AT + len(_MARK)] == _MARK else None
