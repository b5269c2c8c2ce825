"""Make a readable log of one whose writing was cut off or that was damaged later."""

from __future__ import annotations

import contextlib
import itertools
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader

from uuvtai.files import refuse_output
from uuvtai.logs.container import McapFile
from uuvtai.logs.log_errors import LogError
from uuvtai.logs.reader import DAMAGE, MAX_RECORD, opened, records


@dataclass(frozen=True)
class Repair:
    """What was saved."""

    path: Path
    messages: int
    last_time_s: float
    complete: bool
    """nothing was wrong with the file"""
    damages: tuple[str, ...]
    """what was wrong, with the byte"""


_PART = re.compile(r"(\.[0-9a-f]{8})?\.part$")
"""what an unfinished recording's name ends in, today or before"""
MAX_DAMAGES = 100
"""that are told one by one"""


def repair(path: Path, out: Path | None = None, force: bool = False) -> Repair:
    """Write every message that can still be read to ``out``, with indexes and summary; the input is never
    changed.

    Default for ``out``: NAME.repaired.mcap. The new file says in its metadata ``uuv.repair`` what was found.
    Raises LogError, also where nothing at all can be recovered, and FileError where ``out`` is the input, or
    exists and ``force`` is not set.
    """
    path = Path(path)
    out = (
        path.with_name(_PART.sub("", path.name).removesuffix(".mcap") + ".repaired.mcap")
        if out is None
        else Path(out)
    )
    declared = _declared(path)
    refuse_output(out, [path], force)
    try:
        return _copied(path, declared, out)
    except OSError as error:
        raise LogError(
            f"{out}: cannot write the repaired log ({error.strerror}); choose another place with --out FILE"
        ) from error


def _copied(path: Path, declared: list[Any], out: Path) -> Repair:
    damages: list[str] = []
    copy = _Copy(McapFile(out))
    try:
        for record in itertools.chain(declared, records(path, damages=damages)):
            copy.add(record)
        if not copy.messages:
            reason = damages[0] if damages else "it holds no messages"
            raise LogError(
                f"{path}: nothing can be recovered: {reason}; record the episode again with uuv eval --record"
            )
        more = len(damages) - MAX_DAMAGES
        listed = damages[:MAX_DAMAGES] + ([f"and {more} more"] if more > 0 else [])
        if listed:
            copy.file.add_metadata(
                "uuv.repair", {"messages": str(copy.messages), "damages": json.dumps(listed)}
            )
        copy.file.finish()
    except BaseException:
        copy.file.discard()
        raise
    return Repair(out, copy.messages, copy.last_ns / 1e9, not listed, tuple(listed))


def _declared(path: Path) -> list[Any]:
    """Schemas and channels outside of chunks: the summary repeats those of the chunk that may be damaged."""
    found: list[Any] = []
    with opened(path) as file, contextlib.suppress(*DAMAGE):
        for record in StreamReader(file, emit_chunks=True, record_size_limit=MAX_RECORD).records:
            if isinstance(record, Schema | Channel):
                found.append(record)
    return found


class _Copy:
    """Records on their way into a new file, where their ids may be others."""

    def __init__(self, file: McapFile) -> None:
        self.file = file
        self.messages, self.last_ns = 0, 0
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, int] = {}

    def add(self, record: Any) -> None:
        if isinstance(record, Metadata):
            self.file.add_metadata(record.name, record.metadata)
        elif isinstance(record, Attachment):
            self.file.add_attachment(record.name, record.media_type, record.data)
        elif isinstance(record, Schema) and record.id not in self._schemas:
            self._schemas[record.id] = self.file.add_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in self._channels:
            schema = self._schemas.get(record.schema_id, 0)
            self._channels[record.id] = self.file.add_channel(
                record.topic, schema, record.message_encoding, record.metadata
            )
        elif isinstance(record, Message) and record.channel_id in self._channels:
            channel = self._channels[record.channel_id]
            self.file.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
            self.messages += 1
            self.last_ns = max(self.last_ns, record.log_time)
