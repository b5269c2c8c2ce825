"""What was identified, in the terminal: parameters with intervals, errors ahead, warnings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from uuvtai.show.screen import Screen
from uuvtai.tables.table import Column, Table


def _number(value: float) -> str:
    return f"{value:.3f}"


def _interval(entry: dict[str, Any]) -> str:
    return f"[{_number(entry['low'])}, {_number(entry['high'])}]" if entry["fitted"] else ""


_PARAMETERS = (
    Column("parameter", left=True, of=lambda entry: entry["name"]),
    Column("unit", 1, left=True, of=lambda entry: entry["unit"]),
    Column("given", 2, of=lambda entry: _number(entry["given"])),
    Column("found", of=lambda entry: _number(entry["value"]) if entry["fitted"] else "as given"),
    Column("95 % interval", of=_interval),
)
_AHEAD = (
    Column("steps ahead"),
    Column("vehicle", left=True),
    Column("surge m/s"),
    Column("sway m/s"),
    Column("heave m/s"),
    Column("yaw rad/s"),
)


def show_identified(screen: Screen, document: dict[str, Any], known: str) -> None:
    """Tables of a ``uuv identify --json`` document, then its warnings; ``known``: what was taken from which
    vehicle."""
    title = f"{document['seconds']:g} s of drives, known: {known}"
    screen.table(Table(_PARAMETERS, document["parameters"], title))
    rows = [
        [steps, name, *_errors(found[steps])]
        for steps in document["horizons"]["identified"]
        for name, found in document["horizons"].items()
    ]
    screen.table(Table(_AHEAD, rows, "rms error of predictions, on stretches that the fit had not seen"))
    for text in document["warnings"]:
        screen.line(f"warning: {text}", "yellow")


def _errors(values: Sequence[float | None]) -> list[str]:
    return ["-" if value is None else f"{value:.4f}" for value in values]
