"""What one log may ask of whoever reads it: records, bytes of attachments, schemas and metadata, bytes that
chunks unpack to."""

from __future__ import annotations

from mcap.opcode import Opcode

from uuvtai.logs.log_errors import LogError

MAX_RECORDS = 1_000_000
"""of a file, chunks and indexes included: an hour of 14 topics at 20 Hz"""
MAX_UNPACKED = 512 << 20
"""[bytes] most that all chunks of a file may unpack to: four times the longest log that was seen"""
UNPACKED_BASE, UNPACKED_RATIO = 64 << 20, 64
"""[bytes, 1] a small file may unpack to the first and as often its own size as the second says; logs unpack
to ten times their size"""
MAX_MESSAGE = 8 << 20
"""[bytes] of a message or a JSON attachment: a hundred times our largest; read as JSON it takes thirty times
that"""

_TOTALS: dict[int, tuple[int, str]] = {
    Opcode.ATTACHMENT: (64 << 20, "attachments"),
    Opcode.SCHEMA: (16 << 20, "schemas"),
    Opcode.CHANNEL: (4 << 20, "channels"),
    Opcode.METADATA: (4 << 20, "metadata"),
}
"""[bytes] all records of a kind together"""
_COUNTS: dict[int, tuple[int, str]] = {Opcode.SCHEMA: (1000, "schemas"), Opcode.CHANNEL: (400, "topics")}
"""fewer than the files that a process may have open: an export opens one for each topic"""


class BudgetError(LogError):
    """A log that asks for more than any of ours: nothing behind this place is read."""


class LogBudget:
    """What is left for a file of ``size`` bytes; each method takes from it and raises BudgetError where it
    does not suffice."""

    def __init__(self, name: str, size: int) -> None:
        self._name = name
        self._records = MAX_RECORDS
        self._unpacked_limit = min(MAX_UNPACKED, UNPACKED_BASE + UNPACKED_RATIO * size)
        self._unpacked = 0
        self._bytes = dict.fromkeys(_TOTALS, 0)
        self._counts = dict.fromkeys(_COUNTS, 0)

    def take_record(self, opcode: int, length: int) -> None:
        """One record with a content of ``length`` bytes, before it is read."""
        self._records -= 1
        if self._records < 0:
            self._refuse(f"has more than {MAX_RECORDS:,} records")
        if opcode == Opcode.MESSAGE and length > MAX_MESSAGE:
            self._refuse(f"has a message of {length:,} bytes, more than {MAX_MESSAGE >> 20} MiB")
        if opcode in _TOTALS:
            self._bytes[opcode] += length
            limit, what = _TOTALS[opcode]
            if self._bytes[opcode] > limit:
                self._refuse(f"has {what} of more than {limit >> 20} MiB together")
        if opcode in _COUNTS:
            self._counts[opcode] += 1
            limit, what = _COUNTS[opcode]
            if self._counts[opcode] > limit:
                self._refuse(f"has more than {limit:,} {what}")

    def take_unpacked(self, size: int) -> None:
        """``size`` bytes that a chunk unpacked to, used or not."""
        self._unpacked += size
        if self._unpacked > self._unpacked_limit:
            self._refuse(f"has chunks that unpack to more than {self._unpacked_limit >> 20} MiB together")

    def _refuse(self, reason: str) -> None:
        raise BudgetError(
            f"{self._name}: {reason}, which no log of uuv eval --record does; it is not read any further"
        )
