"""Feed a log to the pilot, step by step, and compare what it decides with what was decided then."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from uuvtai.logs.log_errors import LogError
from uuvtai.measure.replay.faults import Disturbed, Faults, disturbed
from uuvtai.measure.replay.log_feed import LogFeed, read_feed
from uuvtai.pilot import OnboardPilot, PilotCommand, SensorMessage

COMPARED = {
    "command": "action",
    "asked velocity": "asked_w",
    "node of the tree": "leaf",
    "own position": "pos_w",
}
"""what is compared per step: attribute of a PilotCommand and of a LoggedStep"""

Build = Callable[[LogFeed], OnboardPilot]


def replay(
    path: Path, faults: Faults | None = None, controller: str | None = None, build: Build | None = None
) -> dict[str, Any]:
    """What ``uuv replay --json`` prints. ``build`` makes the pilot (default: one with its own simulator).

    Numbers count as equal where they are equal as float32; logs do not keep the sign of a zero. Raises
    LogError, TreeError, ConfigError.
    """
    feed, faults = read_feed(path, controller), faults or Faults()
    told = disturbed(feed.arrivals, faults)
    pilot = (build or built)(feed)
    commands, tick_s = _played(pilot, feed, told)
    agreement = [_agreement(name, commands, feed) for name in COMPARED]
    return {
        "schema": 1,
        "log": str(path),
        **{name: feed.run.get(name, "") for name in ("controller", "world", "seed", "episode")},
        "steps": len(feed.steps),
        "faults": {**asdict(faults), "any": faults.any},
        "equal": all(row["first_difference"] is None for row in agreement),
        "agreement": agreement,
        "change": _change(commands, feed),
        "messages": {
            name: {**asdict(tally), "lost": told.lost[name]} for name, tally in pilot.tallies.items()
        },
        "tick_ms": {
            "median": round(1e3 * float(np.median(tick_s)), 3),
            "99th percentile": round(1e3 * float(np.quantile(tick_s, 0.99)), 3),
        },
    }


def built(feed: LogFeed) -> OnboardPilot:
    """A pilot of the log's config, tree and mission."""
    return OnboardPilot.built(feed.config, feed.tree, feed.mission)


def _played(pilot: OnboardPilot, feed: LogFeed, told: Disturbed) -> tuple[list[PilotCommand], list[float]]:
    """(commands of all steps, seconds that each took)."""
    commands, tick_s, sent = [], [], 0
    dt, arrivals = feed.config.episode.control_dt_s, told.arrivals
    for step in range(len(feed.steps)):
        until = (step + 0.5) * dt
        began = time.perf_counter()
        while sent < len(arrivals) and arrivals[sent].time_s <= until:
            _feed(pilot, arrivals[sent].message, feed.path)
            sent += 1
        commands.append(pilot.tick())
        tick_s.append(time.perf_counter() - began)
    return commands, tick_s


def _feed(pilot: OnboardPilot, message: SensorMessage, path: Path) -> None:
    try:
        pilot.feed(message)
    except ValueError as error:
        raise LogError(
            f"{path}: a message does not fit its config.yaml ({error}); see what is in it with: uuv log info "
            f"{path}"
        ) from None


def _agreement(name: str, commands: list[PilotCommand], feed: LogFeed) -> dict[str, Any]:
    """Of one of COMPARED: how many steps are equal, and where the first is not."""
    pairs = [
        (getattr(command, COMPARED[name]), getattr(logged, COMPARED[name]))
        for command, logged in zip(commands, feed.steps, strict=True)
    ]
    wrong = [step for step, (ours, theirs) in enumerate(pairs) if not _is_equal(ours, theirs)]
    first = None
    if wrong:
        step, (ours, theirs) = wrong[0], map(_plain, pairs[wrong[0]])
        time_s = round(step * feed.config.episode.control_dt_s, 9)
        first = {"step": step, "time_s": time_s, "replayed": ours, "logged": theirs}
    return {"what": name, "equal_steps": len(pairs) - len(wrong), "first_difference": first}


def _is_equal(ours: Any, theirs: Any) -> bool:
    """What the log does not say counts as equal."""
    return theirs is None or bool(np.array_equal(ours, theirs))


def _plain(value: Any) -> Any:
    return value if isinstance(value, str) else value.tolist()


def _change(commands: list[PilotCommand], feed: LogFeed) -> dict[str, Any]:
    """How far the commands are from the logged ones, and how often the pilot stopped."""
    actions = np.array([command.action for command in commands], np.float64)
    off = np.abs(actions - np.array([logged.action for logged in feed.steps], np.float64)).max(axis=1)
    held = [command.held for command in commands]
    reasons: dict[str, int] = {}
    for name in (reason.partition(":")[0] for all_of in held for reason in all_of):
        reasons[name] = reasons.get(name, 0) + 1
    places = [
        float(np.linalg.norm(command.pos_w - logged.pos_w))
        for command, logged in zip(commands, feed.steps, strict=True)
        if logged.pos_w is not None
    ]
    return {
        "finite": bool(np.isfinite(actions).all()),
        "largest": float(off.max(initial=0.0)),
        "mean": float(off.mean()) if len(off) else 0.0,
        "steps_beyond_tenth": int((off > 0.1).sum()),
        "position_m": max(places, default=0.0),
        "held_steps": sum(bool(all_of) for all_of in held),
        "held_for": reasons,
    }
