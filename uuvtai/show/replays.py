"""A replayed log in the terminal: what agrees, where it first does not, and what became of the messages."""

from __future__ import annotations

from typing import Any

from uuvtai.show.screen import Screen
from uuvtai.tables.table import Column, Table

_MESSAGES = (
    Column("sensor", left=True),
    Column("fed"),
    Column("used"),
    Column("lost"),
    Column("late"),
    Column("bad", 1),
    Column("unplaced", 1),
)


def show_replay(screen: Screen, found: dict[str, Any]) -> None:
    """A ``uuv replay --json`` document."""
    steps = found["steps"]
    columns = (
        Column("per step", left=True),
        Column("equal"),
        Column("first difference", left=True, prose=True),
    )
    rows = [
        [row["what"], f"{row['equal_steps']} of {steps}", _place(row["first_difference"])]
        for row in found["agreement"]
    ]
    title = f"{found['log']}: {found['controller']} in {found['world']}, {steps} steps"
    screen.table(Table(columns, rows, title))
    if found["faults"]["any"]:
        screen.table(
            Table(_MESSAGES, [_counts(name, row) for name, row in found["messages"].items()], "messages")
        )
        _show_change(screen, found["change"], steps)
    screen.line(_verdict(found))


def _place(first: dict[str, Any] | None) -> str:
    if first is None:
        return "none"
    said = (_value(first[name]) for name in ("replayed", "logged"))
    return f"step {first['step']} ({first['time_s']:g} s): {' instead of '.join(said)}"


def _value(value: Any) -> str:
    if isinstance(value, str):
        return value or "no node"
    return "(" + ", ".join(f"{number:.9g}" for number in value) + ")"


def _counts(name: str, row: dict[str, int]) -> list[str]:
    return [name, *(str(row[key]) for key in ("fed", "used", "lost", "late", "bad", "unplaced"))]


def _show_change(screen: Screen, change: dict[str, Any], steps: int) -> None:
    screen.line(
        f"commands off by {change['mean']:.3f} in the mean, {change['largest']:.2f} at most (of 1); by more "
        f"than 0.1 in {change['steps_beyond_tenth']} of {steps} steps; own position off by up to "
        f"{change['position_m']:.2f} m"
    )
    reasons = ", ".join(f"{name} {count}" for name, count in change["held_for"].items())
    screen.line(
        f"stopped in {change['held_steps']} of {steps} steps{f' (for want of: {reasons})' if reasons else ''}"
    )


def _verdict(found: dict[str, Any]) -> str:
    tick = found["tick_ms"]
    time = f"{tick['median']:.2f} ms a step (99 %: {tick['99th percentile']:.2f} ms)"
    if found["equal"]:
        return f"all commands equal the logged ones; {time}"
    why = "under these faults" if found["faults"]["any"] else "though nothing was disturbed"
    return f"commands differ, {why}; {time}"
