"""MCAP container written so that a killed process loses almost nothing.

A chunk goes to disk while it grows: its header stands in the file with a length that has not been reached
yet, behind it the zstd frame block by block; when the chunk is full the header is completed in place. So
chunks have a useful size from the first byte on, and what was written of an unfinished one can be unpacked
again (``repair.py``). Other readers see an unfinished chunk as a file that ends early. A signal interrupts
between two calls of this file, never within one: half a block would make the rest of its frame unreadable.

Format: https://mcap.dev/spec
"""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from pathlib import Path
from typing import BinaryIO

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from uuvtai import signals
from uuvtai.version import __version__

signals.never_within(__file__)
MAGIC = b"\x89MCAP0\r\n"
CHUNK_MIN, CHUNK_MAX = 64 * 1024, 256 * 1024
"""[bytes] uncompressed; a chunk is closed above the first and never grows beyond the second unless a single
message does"""
LOSS_SHARE = 0.01
"""messages that may be in memory only, as a share of those written"""
OPEN_LENGTH = 1 << 26
"""[bytes] length of an unfinished chunk: beyond the end of the file, so that it reads as cut off"""

_MESSAGE = struct.Struct("<BQHIQQ")
_CHUNK = struct.Struct("<BQQQQII4sQ")
"""opcode, record length, first and last time, size, CRC, length and name of the compression, length of the
data"""
CHUNK_HEAD = _CHUNK.size - 9
"""[bytes] of a chunk record's content before its data"""


class McapFile:
    """One MCAP file under way as ``<path>.part``; ``finish`` makes it whole, durable and gives it its
    name."""

    def __init__(self, path: Path, suffix: str = ".part", profile: str = "") -> None:
        """``profile``: what the file says it keeps to, such as 'ros2'. Raises OSError."""
        self.path = path
        self.part = path.with_name(path.name + suffix)
        self._file: BinaryIO = open(self.part, "wb")  # noqa: SIM115 - lives as long as the object
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._chunks: list[ChunkIndex] = []
        self._counts: dict[int, int] = {}
        self._first_time, self._last_time = 0, 0
        self._messages, self._unsettled = 0, 0
        self._chunk: _OpenChunk | None = None
        self._file.write(MAGIC)
        self._put(Header(profile=profile, library=f"uuvtai {__version__}"))

    def add_metadata(self, name: str, entries: dict[str, str]) -> None:
        """Named pairs of strings. Lies between chunks."""
        self._close_chunk()
        offset, length = self._put(Metadata(name=name, metadata=entries))
        self._metadata.append(MetadataIndex(offset=offset, length=length, name=name))

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """A file within the file. Lies between chunks."""
        self._close_chunk()
        offset, length = self._put(
            Attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=data)
        )
        self._attachments.append(AttachmentIndex(offset, length, 0, 0, len(data), name, media_type))

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Its id, from 1 on."""
        self._close_chunk()
        self._schemas.append(Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name))
        self._put(self._schemas[-1])
        return len(self._schemas)

    def add_channel(
        self, topic: str, schema_id: int, encoding: str = "json", metadata: dict[str, str] | None = None
    ) -> int:
        """Its id, from 1 on. Schemas and channels stand before the chunks, so that every chunk can be read
        alone."""
        self._close_chunk()
        channel = Channel(len(self._channels) + 1, topic, encoding, metadata or {}, schema_id)
        self._channels.append(channel)
        self._put(channel)
        self._counts[channel.id] = 0
        return channel.id

    def add_message(
        self,
        channel_id: int,
        time_ns: int,
        data: bytes,
        publish_ns: int | None = None,
        sequence: int | None = None,
    ) -> None:
        """One message; it may stay in memory until ``settle``."""
        number = self._counts[channel_id] if sequence is None else sequence
        publish = time_ns if publish_ns is None else publish_ns
        record = _MESSAGE.pack(Opcode.MESSAGE, 22 + len(data), channel_id, number, time_ns, publish) + data
        if self._chunk and self._chunk.size + len(record) > CHUNK_MAX:
            self._close_chunk()
        if self._chunk is None:
            self._chunk = _OpenChunk(self._file, time_ns)
        self._chunk.add(record, channel_id, time_ns)
        self._first_time = time_ns if self._messages == 0 else min(self._first_time, time_ns)
        self._last_time = max(self._last_time, time_ns)
        self._counts[channel_id] += 1
        self._messages += 1
        self._unsettled += 1
        if self._chunk.size >= CHUNK_MIN:
            self._close_chunk()

    def settle(self) -> None:
        """Hand over what is in memory when it has become more than its share: call it once per control
        step."""
        if self._chunk and self._unsettled > LOSS_SHARE * self._messages:
            self._chunk.flush()
            self._unsettled = 0

    def finish(self) -> None:
        """Indexes, fsync, rename. Raises OSError."""
        self._close_chunk()
        self._put(DataEnd(0))
        self._write_summary()
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        os.replace(self.part, self.path)
        sync_folder(self.path.parent)

    def leave(self) -> None:
        """Close without finishing: the ``.part`` file stays and can be repaired."""
        if not self._file.closed:
            self._close_chunk()
            self._file.close()

    def discard(self) -> None:
        """Close and remove the ``.part`` file, whatever state it is in."""
        self._chunk = None
        with contextlib.suppress(OSError):
            self._file.close()
        self.part.unlink(missing_ok=True)

    # ------------------------------------------------------------------------------------------------- inside

    def _put(self, record) -> tuple[int, int]:
        offset = self._file.tell()
        data = _bytes_of(record)
        self._file.write(data)
        return offset, len(data)

    def _close_chunk(self) -> None:
        if self._chunk is None:
            return
        self._chunks.append(self._chunk.close())
        self._chunk, self._unsettled = None, 0
        self._file.flush()

    def _write_summary(self) -> None:
        start = self._file.tell()
        groups = [
            self._schemas,
            self._channels,
            [self._statistics()],
            self._chunks,
            self._attachments,
            self._metadata,
        ]
        codes = [
            Opcode.SCHEMA,
            Opcode.CHANNEL,
            Opcode.STATISTICS,
            Opcode.CHUNK_INDEX,
            Opcode.ATTACHMENT_INDEX,
            Opcode.METADATA_INDEX,
        ]
        summary, offsets = b"", b""
        for code, group in zip(codes, groups, strict=True):
            data = b"".join(_bytes_of(record) for record in group)
            offsets += _bytes_of(SummaryOffset(code, start + len(summary), len(data))) if group else b""
            summary += data
        offset_start = start + len(summary)
        footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offset_start)
        crc = zlib.crc32(footer, zlib.crc32(summary + offsets))
        self._file.write(summary + offsets + _bytes_of(Footer(start, offset_start, crc)) + MAGIC)

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts={channel: count for channel, count in self._counts.items() if count},
            chunk_count=len(self._chunks),
            message_count=self._messages,
            message_end_time=self._last_time,
            message_start_time=self._first_time,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )


class _OpenChunk:
    """A chunk being written in place."""

    def __init__(self, file: BinaryIO, time_ns: int) -> None:
        self._file, self._begin = file, file.tell()
        self._zstd = zstandard.ZstdCompressor(level=3).compressobj()
        self._pending: list[bytes] = []
        self._indexes: dict[int, list[tuple[int, int]]] = {}
        self._crc, self._compressed = 0, 0
        self._first_time, self._last_time = time_ns, time_ns
        self.size = 0
        file.write(
            _CHUNK.pack(
                Opcode.CHUNK,
                OPEN_LENGTH + CHUNK_HEAD,
                time_ns,
                time_ns,
                OPEN_LENGTH,
                0,
                4,
                b"zstd",
                OPEN_LENGTH,
            )
        )

    def add(self, record: bytes, channel_id: int, time_ns: int) -> None:
        self._indexes.setdefault(channel_id, []).append((time_ns, self.size))
        self._pending.append(record)
        self.size += len(record)
        self._first_time, self._last_time = min(self._first_time, time_ns), max(self._last_time, time_ns)

    def flush(self) -> None:
        """All messages so far can be unpacked from what is on disk."""
        self._write(zstandard.COMPRESSOBJ_FLUSH_BLOCK)
        self._file.flush()

    def close(self) -> ChunkIndex:
        self._write(zstandard.COMPRESSOBJ_FLUSH_FINISH)
        end = self._file.tell()
        length = CHUNK_HEAD + self._compressed
        header = _CHUNK.pack(
            Opcode.CHUNK,
            length,
            self._first_time,
            self._last_time,
            self.size,
            self._crc,
            4,
            b"zstd",
            self._compressed,
        )
        self._file.seek(self._begin)
        self._file.write(header)
        self._file.seek(end)
        offsets = {}
        for channel, entries in self._indexes.items():
            offsets[channel] = self._file.tell()
            self._file.write(_bytes_of(MessageIndex(channel, entries)))
        return ChunkIndex(
            chunk_length=length + 9,
            chunk_start_offset=self._begin,
            compression="zstd",
            compressed_size=self._compressed,
            message_end_time=self._last_time,
            message_index_length=self._file.tell() - end,
            message_index_offsets=offsets,
            message_start_time=self._first_time,
            uncompressed_size=self.size,
        )

    def _write(self, mode: int) -> None:
        data = b"".join(self._pending)
        self._pending.clear()
        self._crc = zlib.crc32(data, self._crc)
        packed = self._zstd.compress(data) + self._zstd.flush(mode)
        self._compressed += len(packed)
        self._file.write(packed)


def sync_folder(folder: Path) -> None:
    """Make a rename in this folder durable, where the system can."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _bytes_of(record) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()
