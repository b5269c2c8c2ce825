"""What the commands of a vehicle show in the terminal: replays, imports, flights, checks, what was
identified."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from uuvtai.console.screen import Screen
from uuvtai.report.tables import Column, Table, heads, number, percent

# ---- A replayed log in the terminal: what agrees, where it first does not, and what became of the messages.

_FATES = ("fed", "used", "lost", "late", "bad", "unplaced")  # what may become of a message


def show_replay(screen: Screen, found: dict[str, Any]) -> None:
    """A ``uuv replay --json`` document."""
    steps = found["steps"]
    columns = (*heads("per step", "equal"), Column("first difference", left=True, prose=True))
    rows = [
        [row["what"], f"{row['equal_steps']} of {steps}", _place(row["first_difference"])]
        for row in found["agreement"]
    ]
    title = f"{found['log']}: {found['agent']} in {found['world']}, {steps} steps"
    screen.table(Table(columns, rows, title))
    if found["faults"]["any"]:
        screen.table(_messages(found["messages"]))
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


def _messages(found: dict[str, dict[str, int]], fates: Sequence[str] = _FATES) -> Table:
    """What became of each sensor's messages."""
    columns = [*heads("sensor", *fates[:-2]), *(Column(fate, 1) for fate in fates[-2:])]
    return Table(
        columns, [[name, *(str(row[fate]) for fate in fates)] for name, row in found.items()], "messages"
    )


_TICK = "{median:.2f} ms a step (99 %: {99th percentile:.2f} ms)"


def show_opened(screen: Screen, found: dict[str, Any]) -> None:
    """A ``uuv replay --open --json`` document."""
    steps = found["steps"]
    rows = [[name, str(count), percent(count / steps)] for name, count in found["nodes"].items()]
    held = [
        [f"stopped: {name}", str(count), percent(count / steps)] for name, count in found["held_for"].items()
    ]
    title = f"{found['log']}: {found['agent']}, {steps} steps"
    screen.table(Table(heads("node of the tree", "steps", "%"), [*rows, *held], title))
    heard = {name: row for name, row in found["messages"].items() if row["fed"] or row["lost"]}
    screen.table(_messages(heard))
    screen.line(f"routes planned: {found['replans']}; {_TICK.format_map(found['tick_ms'])}")
    screen.line(f"log: {found['recorded']}")
    screen.line(f"picture: {found['picture']}")


_FILES = (
    Column("file", left=True, prose=True),
    Column("kind", left=True),
    *(Column(name) for name in ("from s", "to s", "messages", "readings")),
)
_DROPPED = (Column("dropped", left=True, prose=True), Column("count"), Column("why", left=True, prose=True))
_MOST_DROPPED = 40


def show_import(screen: Screen, found: dict[str, Any]) -> None:
    """A ``uuv log import --json`` document."""
    files = [
        [Path(row["path"]).name, row["kind"], f"{row['from_s']:.1f}", f"{row['to_s']:.1f}"]
        + [str(row[key]) for key in ("messages", "readings")]
        for row in found["files"]
    ]
    screen.table(Table(_FILES, files, f"{found['log']}: {found['duration_s']:.1f} s"))
    rows = sorted((row for file in found["files"] for row in file["dropped"]), key=lambda row: -row["count"])
    if rows:
        shown = [[row["what"], str(row["count"]), row["why"]] for row in rows[:_MOST_DROPPED]]
        screen.table(Table(_DROPPED, shown))
    if len(rows) > _MOST_DROPPED:
        screen.line(f"and {len(rows) - _MOST_DROPPED} more kinds that were dropped: --json")
    for note in found["notes"]:
        screen.line(f"note: {note}")
    told = ", ".join(f"{name} {count}" for name, count in found["readings"].items())
    screen.line(f"readings: {told}; next: uuv replay {shlex.quote(found['log'])} --open")


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
    time = _TICK.format_map(found["tick_ms"])
    if found["equal"]:
        return f"all commands equal the logged ones; {time}"
    why = "under these faults" if found["faults"]["any"] else "though nothing was disturbed"
    return f"commands differ, {why}; {time}"


# ---- A flight by MAVLink in the terminal: what was done, and why.

_CHECKED = (
    Column("what", left=True),
    Column("", left=True),
    Column("Hz", 1),
    Column("gap s", 2),
    Column("age s", 3),
    Column("sender", 4, left=True),
    Column("found", prose=True),
)


def show_flight(screen: Screen, found: dict[str, Any]) -> None:
    """A ``uuv pilot --json`` document."""
    if found["check"]:
        return show_check(screen, found)
    if found["calibration"]:
        return show_calibration(screen, found)
    steps = max(found["steps"], 1)
    title = "dry run: nothing was sent that moves the vehicle" if found["dry_run"] else "armed"
    rows = [[name, str(count), f"{100 * count / steps:.0f} %"] for name, count in found["actions"].items()]
    screen.table(Table(heads("action", "steps", "share"), rows, title))
    counts = [[name, str(row["said"]), str(row["sent"])] for name, row in found["said"].items()]
    if counts:
        screen.table(
            Table(heads("order", "said", "sent"), counts, f"driven in {found['driven_in'] or 'no mode'}")
        )
    screen.table(_messages(found["sensors"], [fate for fate in _FATES if fate != "lost"]))
    show_instruments(screen, found["instruments"])
    for name, count in found["refused"].items():
        screen.line(f"not used, {count} times: {name}")
    if found["log_trouble"]:
        screen.line(found["log_trouble"])
    screen.line(f"ended: {found['ended']}; next: uuv log import {shlex.quote(found['log'])}")


def show_instruments(screen: Screen, places: dict[str, dict[str, Any]]) -> None:
    """What each instrument told, why something was left out, and which of them nobody heard."""
    if places:
        rows = [[place, str(one["heard"]), str(one["strange"])] for place, one in places.items()]
        screen.table(Table(heads("instrument", "heard", "of others"), rows))
    for place, one in places.items():
        for why, count in one["refused"].items():
            screen.line(f"{place}: not used, {count} times: {why}")
        if not one["heard"]:
            screen.line(f"{place}: NOTHING was heard: is it on, is this its address, does 'ping' reach it?")


def show_check(screen: Screen, found: dict[str, Any]) -> None:
    """The rows of a ``uuv pilot --check --json`` document, and what they come to."""
    check = found["check"]
    rows = []
    for row in check["rows"]:
        numbers = (number(row[name], digits) for name, digits in (("rate_hz", 1), ("gap_s", 2), ("age_s", 2)))
        rows.append([row["what"], row["state"], *numbers, row["sender"], row["told"]])
    screen.table(Table(_CHECKED, rows, f"check of {found['steps']} steps: nothing was sent that moves it"))
    show_instruments(screen, found["instruments"])
    bad = [row["what"] for row in check["rows"] if row["state"] == "bad"]
    wrong = f"it may NOT drive: {', '.join(bad) or 'no step was judged'}"
    screen.line("it may drive" if check["ready"] else wrong, "bold")
    screen.line(f"log: {found['log']}")


_CALIBRATED = (Column("what", left=True), Column("found"), Column("+-", 1), Column("key", 2, left=True))


def show_calibration(screen: Screen, found: dict[str, Any]) -> None:
    """What a ``uuv pilot --calibrate --json`` document has found, and how sure it is."""
    told, rig = found["calibration"]["found"], found["calibration"]["rig"]
    if rig:
        keys = {"DVL's yaw, deg": "sensors.dvl.yaw_deg", "heading of x, deg": "world.tank.heading_deg"}
        values = (rig["sensors"]["dvl"]["yaw_deg"], rig["world"]["tank"]["heading_deg"])
        spreads = (told["dvl_yaw_sd_rad"], told["turn_sd_rad"])
        rows = [
            [what, f"{value:.1f}", f"{math.degrees(spread):.1f}", key]
            for (what, key), value, spread in zip(keys.items(), values, spreads, strict=True)
        ]
        screen.table(Table(_CALIBRATED, rows, f"calibrated at {told['places']} places"))
        x, y = told["start"]
        screen.line(f"walls over DVL: {told['dvl_scale']:.3f}; they agree to {told['residual_m']:.2f} m")
        screen.line(f"the vehicle rests at x {x:.2f}, y {y:.2f}: --start from here")
    else:
        screen.line(f"NOT calibrated: {found['calibration']['refusal']}", "bold")
    show_instruments(screen, found["instruments"])
    screen.line(f"log: {found['log']}")


def _packets(name: str) -> Column:
    return Column(name, 1, of=lambda row: str(row["packets"][name]))


_INSTANCES = (
    Column("instance", of=lambda row: str(row["row"])),
    Column("seconds", of=lambda row: f"{row['seconds']:.1f}"),
    Column("driven s", of=lambda row: f"{row['driven_s']:.1f}"),
    Column("outcome", of=lambda row: row["outcome"]),
    *map(_packets, ("step", "reset", "again", "ignore", "bad")),
)


def show_sitl(screen: Screen, found: dict[str, Any]) -> None:
    """A ``uuv sitl --json`` document."""
    title = f"{found['seconds']:.0f} s by the clock; packets by what they asked for"
    screen.table(Table(_INSTANCES, found["instances"], title))


# ---- What was identified, in the terminal: parameters with intervals, errors ahead, warnings.


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
_AHEAD = (Column("steps ahead"), *heads("vehicle", "surge m/s", "sway m/s", "heave m/s", "yaw rad/s"))


def show_identified(screen: Screen, document: dict[str, Any], known: str) -> None:
    """Tables of a ``uuv identify --json`` document, then its warnings; ``known``: what was taken from which
    vehicle."""
    title = f"{document['seconds']:g} s of drives, known: {known}"
    screen.table(Table(_PARAMETERS, document["parameters"], title))
    rows = [
        [steps, name, *("-" if error is None else f"{error:.4f}" for error in found[steps])]
        for steps in document["horizons"]["identified"]
        for name, found in document["horizons"].items()
    ]
    screen.table(Table(_AHEAD, rows, "rms error of predictions, on stretches that the fit had not seen"))
    for text in document["warnings"]:
        screen.line(f"warning: {text}", "yellow")
