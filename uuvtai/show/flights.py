"""A flight by MAVLink in the terminal: what was done, and why."""

from __future__ import annotations

from typing import Any

from uuvtai.show.screen import Screen
from uuvtai.tables.table import Column, Table

_ACTIONS = (Column("action", left=True), Column("steps"), Column("share"))
_ORDERS = (Column("order", left=True), Column("said"), Column("sent"))
_FATES = ("fed", "used", "late", "bad", "unplaced")
_SENSORS = (Column("sensor", left=True), *(Column(name) for name in _FATES))


def show_flight(screen: Screen, found: dict[str, Any]) -> None:
    """A ``uuv pilot --json`` document."""
    steps = max(found["steps"], 1)
    title = "dry run: nothing was sent that moves the vehicle" if found["dry_run"] else "armed"
    rows = [[name, str(count), f"{100 * count / steps:.0f} %"] for name, count in found["actions"].items()]
    screen.table(Table(_ACTIONS, rows, title))
    counts = [[name, str(row["said"]), str(row["sent"])] for name, row in found["said"].items()]
    screen.table(Table(_ORDERS, counts, f"driven in {found['driven_in'] or 'no mode'}"))
    sensors = [[name, *(str(row[key]) for key in _FATES)] for name, row in found["sensors"].items()]
    screen.table(Table(_SENSORS, sensors, "messages"))
    for name, count in found["refused"].items():
        screen.line(f"not used, {count} times: {name}")
    if found["log_trouble"]:
        screen.line(found["log_trouble"])
    screen.line(f"ended: {found['ended']}; log: {found['log']}")


_INSTANCES = tuple(Column(name) for name in ("instance", "seconds", "driven s", "outcome"))
_PACKETS = ("step", "reset", "again", "ignore", "bad")


def show_sitl(screen: Screen, found: dict[str, Any]) -> None:
    """A ``uuv sitl --json`` document."""
    columns = (*_INSTANCES, *(Column(name, 1) for name in _PACKETS))
    rows = [
        [
            str(row["row"]),
            f"{row['seconds']:.1f}",
            f"{row['driven_s']:.1f}",
            row["outcome"],
            *(str(row["packets"][name]) for name in _PACKETS),
        ]
        for row in found["instances"]
    ]
    screen.table(
        Table(columns, rows, f"{found['seconds']:.0f} s by the clock; packets by what they asked for")
    )
