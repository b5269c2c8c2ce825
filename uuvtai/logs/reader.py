"""Read logs, whole or damaged, by the package ``mcap`` and without trusting them: no record and no chunk
takes more memory than it may, and every error says what to do."""

from __future__ import annotations

import dataclasses
import io
import json
import math
import struct
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from shlex import quote
from typing import Any

import lz4.frame
import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Attachment, Channel, Chunk, DataEnd, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC

from uuvtai.common.files import open_file, refusing
from uuvtai.logs.encode import LogError

MAX_RECORD = 64 << 20  # [bytes] of a record, and of an unpacked chunk: six times the map of 200 x 100 m
IMPORTED = "uuv.import"  # metadata of a log that ``uuv log import`` wrote
ZSTD = b"\x28\xb5\x2f\xfd"  # what a frame of zstd begins with
DAMAGE = (McapError, struct.error, ValueError, OverflowError, RuntimeError, zstandard.ZstdError)
"""what the package, zstandard and lz4 raise for bytes that are none of theirs"""


@dataclass(frozen=True)
class LogMessage:
    topic: str
    time_s: float
    data: dict[str, Any]


@dataclass
class LogHead:
    """What a log says about itself."""

    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)

    @property
    def scenario(self) -> dict[str, Any]:
        """scenario.json; raises LogError where it is missing."""
        return json_attachment(self, "scenario.json")


def read_messages(path: Path, topics: Collection[str] | None = None) -> Iterator[LogMessage]:
    """Messages in file order, decoded; all topics or these. Raises LogError."""
    channels: dict[int, Channel] = {}
    for record in records(path):
        if isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Message):
            channel = channels.get(record.channel_id)
            if channel is None:
                raise _unreadable(path, f"a message of channel {record.channel_id}, which was never declared")
            if topics is None or channel.topic in topics:
                yield LogMessage(
                    channel.topic, record.log_time / 1e9, _decoded(path, channel.topic, record.data)
                )


def read_head(path: Path) -> LogHead:
    """Metadata and attachments. Raises LogError."""
    head = LogHead()
    for record in records(path, skip_chunks=True):
        if isinstance(record, Metadata):
            head.metadata[record.name] = record.metadata
        elif isinstance(record, Attachment):
            head.attachments[record.name] = record.data
    return head


def json_attachment(head: LogHead, name: str) -> Any:
    """An attachment as JSON. Raises LogError where it is missing or broken."""
    if name not in head.attachments:
        raise LogError(f"the log has no attachment {name}: it was not written by uuv eval --record")
    try:
        return json.loads(head.attachments[name])
    except (ValueError, RecursionError) as error:
        raise LogError(f"the log's attachment {name} is not JSON ({error})") from None


def info(path: Path) -> dict[str, Any]:
    """What is in a log: topics with schema, messages and rate; duration, metadata, attachments, outcome (None
    = it was cut off, or ``is_eval`` says that it is none of uuv eval's). Raises LogError.
    """
    path = Path(path)
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    counts: Counter[int] = Counter()
    head, first, last = LogHead(), math.inf, -math.inf
    for record in records(path):
        if isinstance(record, Message):
            counts[record.channel_id] += 1
            first, last = min(first, record.log_time), max(last, record.log_time)
        elif isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Metadata):
            head.metadata[record.name] = record.metadata
        elif isinstance(record, Attachment):
            head.attachments[record.name] = record.data
    duration = max(last - first, 0) / 1e9
    topics = [
        {
            "topic": channel.topic,
            "schema": schemas[channel.schema_id].name if channel.schema_id in schemas else "",
            "messages": counts[channel.id],
            "rate_hz": round(counts[channel.id] / duration, 3) if duration > 0 else None,
        }
        for channel in channels.values()
    ]
    result = head.metadata.get("uuv.result", {})
    return {
        "path": str(path),
        "bytes": path.stat().st_size,
        "duration_s": round(duration, 9),
        "messages": sum(counts.values()),
        "topics": topics,
        "metadata": head.metadata,
        "attachments": {name: len(data) for name, data in head.attachments.items()},
        "is_eval": "uuv.run" in head.metadata,
        "outcome": result.get("outcome"),
    }


# ---------------------------------------------------------------------------------------------------- records


def records(path: Path, skip_chunks: bool = False, damages: list[str] | None = None) -> Iterator[Any]:
    """Schema, Channel, Message, Metadata and Attachment records of a whole file.

    Raises LogError at the first damage; where ``damages`` are asked for, they are added there, and all is
    given that can still be read.
    """
    path = Path(path)
    with opened(path) as file:
        if (magic := file.peek(len(MCAP0_MAGIC))[: len(MCAP0_MAGIC)]) != MCAP0_MAGIC:
            if magic.startswith(ZSTD):
                plain = path.with_suffix("" if path.stem.endswith(".mcap") else ".mcap")
                raise LogError(
                    f"{path}: is compressed as a whole, which is not read; first: zstd -d {quote(str(path))} "
                    f"-o {quote(str(plain))}"
                )
            raise LogError(
                f"{path}: is not an MCAP file (no magic bytes); give a log that uuv eval --record wrote"
            )
        try:
            for record in StreamReader(file, emit_chunks=True, record_size_limit=MAX_RECORD).records:
                if isinstance(record, DataEnd):
                    return
                if isinstance(record, Chunk) and not skip_chunks:
                    yield from _unpacked(record, file, damages)
                elif isinstance(record, Schema | Channel | Message | Metadata | Attachment):
                    yield record
            reason = "it has no end mark"
        except EndOfFile:
            reason = f"it ends at byte {file.tell()} without the end mark: its writing was cut off"
        except DAMAGE as error:
            reason = f"{str(error) or type(error).__name__} (before byte {file.tell()})"
        if damages is None:
            raise _unreadable(path, reason)
        damages.append(reason)


class WholeReads(io.BufferedReader):
    """A file for the package's readers: refused is what is longer than any record, or than the file."""

    def read(self, size: int | None = -1, /) -> bytes:
        """Exactly so many bytes. Raises McapError."""
        if size is None or not 0 <= size <= MAX_RECORD:
            raise McapError(f"a record holds {size} bytes, more than {MAX_RECORD >> 20} MiB")
        data = super().read(size)
        if len(data) < size:
            raise EndOfFile
        return data


def opened(path: Path) -> WholeReads:
    """The file, open for reading. Raises LogError where it cannot be opened, FileError for no plain file."""
    with refusing(LogError, f"{path}: cannot open the log", "see uuv log --help"):
        return WholeReads(open_file(path).detach())


def _unpacked(chunk: Chunk, file: WholeReads, damages: list[str] | None) -> list[Any]:
    """Records of a chunk. What fails its checksum is not evidence of anything."""
    try:
        plain = dataclasses.replace(chunk, compression="", data=_plain(chunk))
        return breakup_chunk(plain, validate_crc=True)
    except DAMAGE as error:
        reason = f"a chunk is damaged: {str(error) or type(error).__name__}"
        if damages is None:
            raise McapError(reason) from None
        damages.append(f"{reason} (before byte {file.tell()})")
        return []


def _plain(chunk: Chunk) -> bytes:
    """What a chunk unpacks to. Raises DAMAGE, before it takes more memory than the chunk may."""
    size, data = chunk.uncompressed_size, chunk.data
    if size > MAX_RECORD:
        raise McapError(f"it would unpack to {size:,} bytes, more than {MAX_RECORD >> 20} MiB")
    if chunk.compression == "zstd" and zstandard.frame_content_size(data) in (-1, size):
        data = zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    elif chunk.compression not in ("", "zstd"):
        raise McapError(f"it has the unknown compression {chunk.compression!r}")
    if len(data) != size:
        raise McapError(f"it does not unpack to {size:,} bytes, as it says")
    return data


def _decoded(path: Path, topic: str, data: bytes) -> dict[str, Any]:
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        raise _unreadable(path, f"a message on {topic} is not JSON ({error})") from None


def _unreadable(path: Path, reason: str) -> LogError:
    return LogError(
        f"{path}: the log cannot be read: {reason}. Recover what is in it with: uuv log repair {path}"
    )
