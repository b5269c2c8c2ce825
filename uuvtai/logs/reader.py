"""Read logs, whole or damaged, without trusting them: every length is checked against the file and a bound before it is used."""

from __future__ import annotations

import io
import json
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema

from uuvtai.logs.container import MAGIC
from uuvtai.logs.errors import LogError

MAX_RECORD = 256 << 20
"""[bytes] longest record that is looked at"""
MAX_CHUNK = 64 << 20
"""[bytes] most that a chunk may unpack to: 256 times what we write, far below what would fill a memory"""
MAX_UNPACKED = 4 << 30
"""[bytes] most that all chunks of a file may unpack to: 30 times the longest log that was seen, and what an export may take of a disk"""

_READ = 64 * 1024
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_PARSED: dict[int, Callable[[ReadDataStream], Any]] = {
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.METADATA: Metadata.read,
}


class DamageError(Exception):
    """A place where a file stops making sense. ``records`` are the whole ones of a chunk that is cut off there; ``can_go_on``: the next
    record starts at a known place."""

    def __init__(self, reason: str, records: list[Any] | None = None, can_go_on: bool = False) -> None:
        super().__init__(reason)
        self.reason, self.records, self.can_go_on = reason, records or [], can_go_on


@dataclass(frozen=True)
class LogMessage:
    """One message."""

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
    channels: dict[int, str] = {}
    for record in records(path):
        if isinstance(record, Channel):
            channels[record.id] = record.topic
        elif isinstance(record, Message):
            topic = channels.get(record.channel_id)
            if topic is None:
                raise _unreadable(path, f"a message of channel {record.channel_id}, which was never declared")
            if topics is None or topic in topics:
                yield LogMessage(topic, record.log_time / 1e9, _decoded(path, topic, record.data))


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
    """What is in a log: topics with schema, messages and rate; duration, metadata, attachments, outcome. Raises LogError."""
    path = Path(path)
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    counts: Counter[int] = Counter()
    head, last = LogHead(), None
    for record in records(path):
        if isinstance(record, Message):
            counts[record.channel_id] += 1
            last = record.log_time if last is None else max(last, record.log_time)
        elif isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Metadata):
            head.metadata[record.name] = record.metadata
        elif isinstance(record, Attachment):
            head.attachments[record.name] = record.data
    duration = (last or 0) / 1e9
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
        "outcome": result.get("outcome"),
    }


# ---------------------------------------------------------------------------------------------------------------- records


def records(path: Path, skip_chunks: bool = False) -> Iterator[Any]:
    """Schema, Channel, Message, Metadata and Attachment records of a whole file. Raises LogError at the first damage."""
    path = Path(path)
    with opened(path) as file:
        scanner = Scanner(file)
        try:
            yield from scanner.records(skip_chunks)
        except DamageError as damage:
            if scanner.at == 0:
                raise LogError(f"{path}: is not an MCAP file (no magic bytes); give a log that uuv eval --record wrote") from None
            raise _unreadable(path, f"{damage.reason} at byte {scanner.at}") from None
        if not scanner.finished:
            raise _unreadable(path, f"it ends at byte {scanner.at} without the end mark: its writing was cut off")


def opened(path: Path) -> BinaryIO:
    """The file, open for reading. Raises LogError."""
    try:
        return open(path, "rb")
    except OSError as error:
        raise LogError(f"{path}: cannot open the log ({error.strerror}); see uuv log --help") from None


class Scanner:
    """Walks through a file's records; ``at`` is the place of the newest, ``finished`` says whether the end mark was met."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.size = file.seek(0, 2)
        file.seek(0)
        self.at = 0
        self.finished = False
        self._unpacked = 0

    def records(self, skip_chunks: bool = False) -> Iterator[Any]:
        """Records up to the end of the data section. Raises DamageError; iterate again to go on behind it where it ``can_go_on``."""
        if self.at == 0:
            if self._file.read(len(MAGIC)) != MAGIC:
                raise DamageError("it is not an MCAP file (no magic bytes)")
            self.at = len(MAGIC)
        while not self.finished:
            self._file.seek(self.at)
            head = self._file.read(9)
            if len(head) < 9:
                return
            opcode, length = struct.unpack("<BQ", head)
            rest = self.size - self.at - 9
            if opcode == Opcode.DATA_END:
                self.finished = True
            elif opcode == Opcode.CHUNK and not (skip_chunks and length <= rest):
                found = self._chunk(length, rest)
                self.at += 9 + length
                yield from found
            elif length > rest:
                raise DamageError(f"a record of {length} bytes is cut off after {rest}")
            elif opcode in _PARSED or opcode == Opcode.MESSAGE:
                record = self._parsed(opcode, length)
                self.at += 9 + length
                yield record
            elif 0 < opcode <= Opcode.DATA_END or opcode >= 0x80:
                self.at += 9 + length
            else:
                raise DamageError(f"no record of MCAP begins with byte {opcode}")

    def _parsed(self, opcode: int, length: int) -> Any:
        if length > MAX_RECORD:
            raise DamageError(f"a record of {length} bytes is longer than any we write")
        body = self._file.read(length)
        try:
            return _message(body) if opcode == Opcode.MESSAGE else _PARSED[opcode](ReadDataStream(io.BytesIO(body)))
        except (EndOfFile, struct.error, UnicodeDecodeError) as error:
            raise self._behind(length, f"a record cannot be read ({error or type(error).__name__})") from None

    def _chunk(self, length: int, rest: int) -> list[Any]:
        """Records of a chunk. What fails its checksum is not evidence of anything: only a chunk that is cut off is used in part."""
        cut = length > rest
        body = self._file.read(min(length, rest, MAX_RECORD))
        try:
            chunk = Chunk.read(ReadDataStream(io.BytesIO(body)))
        except (EndOfFile, struct.error, UnicodeDecodeError):
            chunk = None
        if chunk is None or (not chunk.data and chunk.uncompressed_size):
            raise DamageError("a chunk is cut off before its data") if cut else self._behind(length, "a chunk without data")
        if chunk.uncompressed_size > MAX_CHUNK:
            raise self._behind(length, f"a chunk claims to unpack to {chunk.uncompressed_size} bytes")
        plain, trouble = unpacked(chunk.data, chunk.compression)
        self._unpacked += len(plain)
        if self._unpacked > MAX_UNPACKED:
            raise DamageError(f"its chunks unpack to more than {MAX_UNPACKED >> 20} MiB")
        found, used = split_records(plain)
        if cut:
            raise DamageError("a chunk is cut off", found)
        if trouble is None and (used != len(plain) or len(plain) != chunk.uncompressed_size):
            trouble = f"it unpacks to {len(plain)} bytes instead of {chunk.uncompressed_size}"
        if trouble is None and chunk.uncompressed_crc and zlib.crc32(plain) != chunk.uncompressed_crc:
            trouble = "its checksum is wrong"
        if trouble:
            raise self._behind(length, f"a chunk is damaged: {trouble}")
        return found

    def _behind(self, length: int, reason: str) -> DamageError:
        """DamageError of one record; the next begins behind it."""
        self.at += 9 + length
        return DamageError(reason, can_go_on=True)


def unpacked(data: bytes, compression: str) -> tuple[bytes, str | None]:
    """(what can be unpacked, what went wrong); of a frame that is cut off, all that was written before. Never more than MAX_CHUNK."""
    if compression == "":
        return data, None
    if compression != "zstd":
        return b"", f"unknown compression {compression!r}"
    pieces, size = [], 0
    with zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(io.BytesIO(data)) as stream:
        while True:
            try:
                piece = stream.read(_READ)
            except zstandard.ZstdError as error:
                return b"".join(pieces), str(error)
            if not piece:
                return b"".join(pieces), None
            size += len(piece)
            if size > MAX_CHUNK:
                return b"", f"it unpacks to more than {MAX_CHUNK} bytes"
            pieces.append(piece)


def _message(body: bytes) -> Message:
    channel, sequence, log_time, publish_time = _MESSAGE_HEAD.unpack_from(body)
    return Message(channel, log_time, body[_MESSAGE_HEAD.size :], publish_time, sequence)


def split_records(plain: bytes) -> tuple[list[Any], int]:
    """(whole records of a chunk's content, bytes they take)."""
    found: list[Any] = []
    at = 0
    while at + 9 <= len(plain):
        opcode, length = struct.unpack_from("<BQ", plain, at)
        if at + 9 + length > len(plain):
            break
        body = plain[at + 9 : at + 9 + length]
        if opcode == Opcode.MESSAGE and length >= _MESSAGE_HEAD.size:
            found.append(_message(body))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            try:
                found.append(_PARSED[opcode](ReadDataStream(io.BytesIO(body))))
            except (EndOfFile, struct.error, UnicodeDecodeError):
                break
        at += 9 + length
    return found, at


def _decoded(path: Path, topic: str, data: bytes) -> dict[str, Any]:
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        raise _unreadable(path, f"a message on {topic} is not JSON ({error})") from None


def _unreadable(path: Path, reason: str) -> LogError:
    return LogError(f"{path}: the log cannot be read: {reason}. Recover what is in it with: uuv log repair {path}")
