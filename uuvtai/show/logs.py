"""A recorded episode in the terminal: its topics, how often they come, how it ended."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from uuvtai.show.screen import Screen
from uuvtai.tables.table import Column, Table
from uuvtai.tables.wording import number

_TOPICS = (
    Column("topic", left=True, of=lambda topic: topic["topic"]),
    Column("messages", of=lambda topic: str(topic["messages"])),
    Column("Hz", of=lambda topic: number(topic["rate_hz"])),
    Column("schema", 1, left=True, of=lambda topic: topic["schema"]),
)


def show_log(screen: Screen, found: dict[str, Any], file: Path) -> None:
    """Topics of a ``uuv log info --json`` document."""
    screen.table(Table(_TOPICS, found["topics"], str(file)))
    end = f"outcome {found['outcome'] or 'none: the log was cut off'}"
    screen.line(
        f"duration {found['duration_s']:.2f} s, {end if found['is_eval'] else 'not a log of uuv eval'}"
    )
