"""Read logs, whole or damaged, without trusting them: every length is checked against the file and a bound
before it is used."""

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

from uuvtai.files import open_file
from uuvtai.logs.budget import MAX_MESSAGE, LogBudget
from uuvtai.logs.container import MAGIC
from uuvtai.logs.log_errors import LogError
from uuvtai.logs.search import next_chunk, true_length

MAX_RECORD = 64 << 20
"""[bytes] longest record that is looked at"""
MAX_CHUNK = 16 << 20
"""[bytes] most that a chunk may unpack to: 64 times what we write; other writers stay below 4 MiB"""

_READ = 64 * 1024
_MAX_WINDOW = 1 << 24
"""[bytes] memory that a zstd frame may ask for"""
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_PARSED: dict[int, Callable[[ReadDataStream], Any]] = {
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.METADATA: Metadata.read,
}


class DamageError(Exception):
    """A place where a file stops making sense. ``records`` are the whole ones of a chunk that is cut off
    there; ``can_go_on``: the next record starts at a known place."""

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
    content = head.attachments[name]
    if len(content) > MAX_MESSAGE:
        raise LogError(
            f"the log's attachment {name} has {len(content):,} bytes; a log of ours has fewer, and more "
            "cannot be drawn"
        )
    try:
        return json.loads(content)
    except (ValueError, RecursionError) as error:
        raise LogError(f"the log's attachment {name} is not JSON ({error})") from None


def info(path: Path) -> dict[str, Any]:
    """What is in a log: topics with schema, messages and rate; duration, metadata, attachments, outcome.
    Raises LogError.
    """
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


# ---------------------------------------------------------------------------------------------------- records


def records(path: Path, skip_chunks: bool = False) -> Iterator[Any]:
    """Schema, Channel, Message, Metadata and Attachment records of a whole file. Raises LogError at the first
    damage, and for more than a log may ask of its reader."""
    path = Path(path)
    with opened(path) as file:
        scanner = Scanner(file, str(path))
        try:
            yield from scanner.records(skip_chunks)
        except DamageError as damage:
            if scanner.at == 0:
                raise LogError(
                    f"{path}: is not an MCAP file (no magic bytes); give a log that uuv eval --record wrote"
                ) from None
            raise _unreadable(path, f"{damage.reason} at byte {scanner.at}") from None
        if not scanner.finished:
            raise _unreadable(
                path, f"it ends at byte {scanner.at} without the end mark: its writing was cut off"
            )


def opened(path: Path) -> BinaryIO:
    """The file, open for reading. Raises LogError for what cannot be opened, FileError for what is no plain
    file."""
    try:
        return open_file(path)
    except OSError as error:
        raise LogError(f"{path}: cannot open the log ({error.strerror}); see uuv log --help") from None


class Scanner:
    """Walks through a file's records; ``at`` is the place of the newest, ``sure`` that of the last one before
    it that was whole, ``finished`` says whether the end mark was met."""

    def __init__(self, file: BinaryIO, name: str) -> None:
        self._file = file
        self.size = file.seek(0, 2)
        file.seek(0)
        self.at = self.sure = self._searched = 0
        self._corrected = -1, 0
        """place of a chunk whose length lies, and its true length"""
        self.finished = False
        self.budget = LogBudget(name, self.size)

    def records(self, skip_chunks: bool = False) -> Iterator[Any]:
        """Records up to the end of the data section. Raises DamageError; iterate again to go on behind it
        where it ``can_go_on``.

        Raises BudgetError where the file asks for too much.
        """
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
            if self._corrected[0] == self.at:
                length = self._corrected[1]
            rest = self.size - self.at - 9
            if opcode != Opcode.CHUNK and length > rest:
                raise DamageError(f"a record of {length} bytes is cut off after {rest}")
            self.budget.take_record(opcode, length)
            if opcode == Opcode.DATA_END:
                if length != 4:
                    raise DamageError(f"an end mark of {length} bytes")
                self.finished = True
            elif opcode == Opcode.CHUNK and not (skip_chunks and length <= rest):
                found = self._chunk(length, rest)
                self._pass(length)
                yield from found
            elif opcode in _PARSED or opcode == Opcode.MESSAGE:
                record = self._parsed(opcode, length)
                self._pass(length)
                yield record
            elif 0 < opcode <= Opcode.DATA_END or opcode >= 0x80:
                self._pass(length)
            else:
                raise DamageError(f"no record of MCAP begins with byte {opcode}")

    def resume(self) -> bool:
        """After damage whose end is unknown: go on at the next place that can be trusted; False where there
        is none.

        A chunk whose own length lies is read once more with the length that its data says. Otherwise the next
        whole chunk is searched, from behind the last record that was passed: its length may have been the
        lie.
        """
        if self.at == 0:
            return False
        length = true_length(self._file, self.at, self.size)
        if length is not None and self._corrected[0] != self.at:
            self._corrected = self.at, length
            return True
        place = next_chunk(self._file, max(self.sure, self._searched) + 1, self.size)
        if place is not None:
            self._searched = self.at = place
        return place is not None

    def _pass(self, length: int) -> None:
        """Go behind a record of this length."""
        self.sure = self.at
        self.at += 9 + length

    def _parsed(self, opcode: int, length: int) -> Any:
        if length > MAX_RECORD:
            raise DamageError(f"a record of {length} bytes is longer than any we write")
        body = self._file.read(length)
        try:
            return (
                _message(body)
                if opcode == Opcode.MESSAGE
                else _PARSED[opcode](ReadDataStream(io.BytesIO(body)))
            )
        except (EndOfFile, OverflowError, struct.error, UnicodeDecodeError) as error:
            raise self._behind(length, f"a record cannot be read ({error or type(error).__name__})") from None

    def _chunk(self, length: int, rest: int) -> list[Any]:
        """Records of a chunk. What fails its checksum is not evidence of anything: only a chunk that is cut
        off is used in part."""
        cut, true = length > rest, true_length(self._file, self.at, self.size)
        if true is not None and true != length:
            raise DamageError(f"a chunk of {true} bytes claims to have {length}")
        if not cut and length > MAX_RECORD:
            raise DamageError(f"a chunk of {length} bytes is longer than any we write")
        self._file.seek(self.at + 9)
        body = self._file.read(min(length, rest, MAX_RECORD))
        try:
            chunk = Chunk.read(ReadDataStream(io.BytesIO(body)))
        except (EndOfFile, OverflowError, struct.error, UnicodeDecodeError):
            chunk = None
        if chunk is None or (not chunk.data and chunk.uncompressed_size):
            raise (
                DamageError("a chunk is cut off before its data")
                if cut
                else self._behind(length, "a chunk without data")
            )
        if not cut and chunk.uncompressed_size > MAX_CHUNK:
            raise self._behind(length, f"a chunk claims to unpack to {chunk.uncompressed_size} bytes")
        plain, trouble = unpacked(
            chunk.data, chunk.compression, MAX_CHUNK if cut else chunk.uncompressed_size, self.budget
        )
        found, used = split_records(plain, self.budget) if cut or trouble is None else ([], 0)
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
        """DamageError of one record; the next begins behind it, unless its length was a guess."""
        if self._corrected[0] == self.at:
            return DamageError(reason)
        self.sure = self.at
        self.at += 9 + length
        return DamageError(reason, can_go_on=True)


def unpacked(data: bytes, compression: str, limit: int, budget: LogBudget) -> tuple[bytes, str | None]:
    """(what can be unpacked, what went wrong); of a frame that is cut off, all that was written before. Never
    more than ``limit`` bytes."""
    if compression == "":
        budget.take_unpacked(len(data))
        return data, None
    if compression != "zstd":
        return b"", f"unknown compression {compression!r}"
    pieces, size = [], 0
    with zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW).stream_reader(io.BytesIO(data)) as stream:
        while True:
            try:
                piece = stream.read(_READ)
            except zstandard.ZstdError as error:
                return b"".join(pieces), str(error)
            if not piece:
                return b"".join(pieces), None
            size += len(piece)
            budget.take_unpacked(len(piece))
            if size > limit:
                return b"", f"it unpacks to more than {limit} bytes"
            pieces.append(piece)


def _message(body: bytes) -> Message:
    channel, sequence, log_time, publish_time = _MESSAGE_HEAD.unpack_from(body)
    return Message(channel, log_time, body[_MESSAGE_HEAD.size :], publish_time, sequence)


def split_records(plain: bytes, budget: LogBudget) -> tuple[list[Any], int]:
    """(whole records of a chunk's content, bytes they take). Raises BudgetError."""
    found: list[Any] = []
    at = 0
    while at + 9 <= len(plain):
        opcode, length = struct.unpack_from("<BQ", plain, at)
        if at + 9 + length > len(plain):
            break
        budget.take_record(opcode, length)
        body = plain[at + 9 : at + 9 + length]
        if opcode == Opcode.MESSAGE and length >= _MESSAGE_HEAD.size:
            found.append(_message(body))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            try:
                found.append(_PARSED[opcode](ReadDataStream(io.BytesIO(body))))
            except (EndOfFile, OverflowError, struct.error, UnicodeDecodeError):
                break
        at += 9 + length
    return found, at


def _decoded(path: Path, topic: str, data: bytes) -> dict[str, Any]:
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        raise _unreadable(path, f"a message on {topic} is not JSON ({error})") from None


def _unreadable(path: Path, reason: str) -> LogError:
    return LogError(
        f"{path}: the log cannot be read: {reason}. Recover what is in it with: uuv log repair {path}"
    )
