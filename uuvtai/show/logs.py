"""A recorded episode in the terminal: its topics, how often they come, how it ended."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer

from uuvtai.endings import plain
from uuvtai.show.screen import Column, Screen
from uuvtai.show.words import number

_TOPICS = (Column("topic", left=True), Column("messages"), Column("Hz"), Column("schema", 1, left=True))


def show_log(screen: Screen, found: dict[str, Any], file: Path) -> None:
    """Topics of a ``uuv log info --json`` document."""
    rows = [
        [topic["topic"], str(topic["messages"]), number(topic["rate_hz"]), topic["schema"]]
        for topic in found["topics"]
    ]
    screen.table(_TOPICS, rows, str(file))
    screen.line(
        f"duration {found['duration_s']:.2f} s, outcome {found['outcome'] or 'none: the log was cut off'}"
    )
    if found["converted_from"]:
        typer.echo(
            "output of uuv log convert (protobuf); for every other command use "
            f"{plain(found['converted_from'])}"
        )
