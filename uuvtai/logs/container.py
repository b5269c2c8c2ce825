"""An MCAP file under way, written by the package ``mcap`` so that a killed process loses next to nothing: a
chunk goes to disk before its messages are a hundredth of all, and ``export.py`` reads every chunk that is
whole. A signal interrupts between two calls of this file, never within one.
"""

from __future__ import annotations

import contextlib
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from mcap.writer import Writer

from uuvtai.common import signals
from uuvtai.common.files import flush, open_new, unfinished
from uuvtai.common.version import __version__
from uuvtai.logs.encode import LogError
from uuvtai.logs.reader import MAX_RECORD

signals.never_within(__file__)
MAX_MESSAGE = MAX_RECORD - (2 << 20)
"""[bytes] of a message, which may share its chunk with one mebibyte of others"""
LOSS_SHARE = 0.01
"""messages that may be in memory only, as a share of those written; those of one control step always may"""


class McapFile:
    """An MCAP file under way as ``<path>.XXXXXXXX.part``; ``finish`` makes it whole and names it."""

    def __init__(self, path: Path, profile: str = "") -> None:
        """``profile``: what the file says it keeps to, such as 'ros2'. Raises OSError."""
        signals.engage()
        self.path = path
        self.part = unfinished(path, ".part")
        self._file = open_new(self.part)
        self._writer = Writer(self._file)
        self._writer.start(profile, f"uuvtai {__version__}")
        self._counts: Counter[int] = Counter()
        self._messages = self._before = self._on_disk = 0
        """in all, when ``settle`` was last called, in whole chunks"""

    def add_metadata(self, name: str, entries: dict[str, str]) -> None:
        """Named pairs of strings, behind the messages so far."""
        self._writer.flush()
        self._writer.add_metadata(name, entries)

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        self._writer.add_attachment(0, 0, name, media_type, data)

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Its id, from 1 on."""
        return self._writer.register_schema(name, encoding, data)

    def add_channel(
        self, topic: str, schema_id: int, encoding: str = "json", metadata: dict[str, str] | None = None
    ) -> int:
        """Its id, from 1 on."""
        return self._writer.register_channel(topic, encoding, schema_id, metadata or {})

    def add_message(
        self,
        channel_id: int,
        time_ns: int,
        data: bytes,
        publish_ns: int | None = None,
        sequence: int | None = None,
    ) -> None:
        """One message; it may stay in memory until ``settle``. Raises LogError for one too long to read."""
        if len(data) > MAX_MESSAGE:
            raise LogError(
                f"{self.path}: a message has {len(data):,} bytes, more than the {MAX_MESSAGE:,} that are "
                "read again; if it is the map of a large tank, make it coarser: --set mapping.cell_m=0.2"
            )
        number = self._counts[channel_id] if sequence is None else sequence
        publish = time_ns if publish_ns is None else publish_ns
        self._writer.add_message(channel_id, time_ns, data, publish, number)
        self._counts[channel_id] += 1
        self._messages += 1

    def settle(self) -> None:
        """Write what is in memory where it would become more than its share by as many messages as came
        since the last call: call it once per control step."""
        step, self._before = self._messages - self._before, self._messages
        if self._messages + step - self._on_disk > LOSS_SHARE * self._messages:
            self._writer.flush()
            self._on_disk = self._messages

    def finish(self) -> None:
        """Indexes, fsync, rename. Raises OSError."""
        self._writer.finish()
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        os.replace(self.part, self.path)
        sync_folder(self.path.parent)

    def leave(self) -> None:
        """Close without finishing: the ``.part`` file stays and can be repaired."""
        if not self._file.closed:
            self._writer.flush()
            self._file.close()

    def discard(self) -> None:
        """Close and remove the ``.part`` file, whatever state it is in."""
        with contextlib.suppress(OSError):
            self._file.close()
        self.part.unlink(missing_ok=True)


@contextlib.contextmanager
def whole_log(path: Path, profile: str = "") -> Iterator[McapFile]:
    """A file that is finished where all goes well inside, and discarded where not. Raises OSError."""
    file = McapFile(path, profile)
    try:
        yield file
        file.finish()
    except BaseException:
        file.discard()
        raise


def sync_folder(folder: Path) -> None:
    """Make a rename in this folder durable, where the system can."""
    with contextlib.suppress(OSError):
        flush(folder)
