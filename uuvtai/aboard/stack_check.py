"""Messages of a log and what was decided on them, and whether a folder's code decides the same:
``python -m uuv_stack FOLDER``. Copied into every exported folder."""

from __future__ import annotations

import argparse
import dataclasses
import json
import platform
import resource
import sys
from pathlib import Path
from typing import Any

import numpy as np

from uuvtai.aboard.carried_stack import GOLDEN, StackFolderError, carried_pilot
from uuvtai.pilot.sensor_messages import KINDS, SensorMessage

AGREES = 1e-4
"""largest difference between two commands, each in [-1, 1], that counts as none"""


def packed_messages(arrivals: list[tuple[int, SensorMessage]]) -> dict[str, np.ndarray]:
    """Arrays of messages, each with the step before which it arrives, in the order of arrival."""
    names = list(KINDS)
    found: dict[str, np.ndarray] = {
        "arrival_step": np.array([step for step, _ in arrivals], np.int32),
        "arrival_kind": np.array(
            [list(KINDS.values()).index(type(message)) for _, message in arrivals], np.int8
        ),
    }
    for name, kind in KINDS.items():
        messages = [message for _, message in arrivals if isinstance(message, kind)]
        for member in dataclasses.fields(kind):
            values = [np.asarray(getattr(message, member.name), np.float64) for message in messages]
            key = f"{names[names.index(name)]}.{member.name}"
            found[key] = np.concatenate([value.ravel() for value in values]) if values else np.zeros(0)
            found[f"{key}.length"] = np.array([value.size for value in values], np.int32)
    return found


def messages_in(packed: Any, image: tuple[int, ...]) -> list[tuple[int, SensorMessage]]:
    """What ``packed_messages`` packed; ``image``: shape of a depth image."""
    kinds = list(KINDS.items())
    fields = {
        f"{name}.{member.name}": iter(
            np.split(
                packed[f"{name}.{member.name}"],
                np.cumsum(packed[f"{name}.{member.name}.length"])[:-1],
            )
        )
        for name, kind in kinds
        for member in dataclasses.fields(kind)
        if len(packed[f"{name}.{member.name}.length"])
    }
    found = []
    for step, number in zip(packed["arrival_step"].tolist(), packed["arrival_kind"].tolist(), strict=True):
        name, kind = kinds[number]
        values = {
            member.name: _value(name, member.name, next(fields[f"{name}.{member.name}"]), image)
            for member in dataclasses.fields(kind)
        }
        found.append((step, kind(**values)))
    return found


def _value(kind: str, name: str, flat: np.ndarray, image: tuple[int, ...]) -> Any:
    if name == "time_s" or (kind, name) == ("pressure", "depth_m"):
        return float(flat[0])
    if name == "first_beam":
        return int(flat[0])
    return flat.reshape(image) if kind == "depth" else flat


def decided(pilot: Any, arrivals: list[tuple[int, SensorMessage]], steps: int) -> np.ndarray:
    """(steps, 4) commands of a pilot that is told these messages."""
    commands, sent = np.zeros((steps, 4), np.float32), 0
    for step in range(steps):
        while sent < len(arrivals) and arrivals[sent][0] <= step:
            pilot.feed(arrivals[sent][1])
            sent += 1
        commands[step] = pilot.tick().chosen
    return commands


def compare(folder: Path) -> dict[str, Any]:
    """What a folder's code decides on this computer beside what was decided at its export. Raises
    StackFolderError."""
    pilot = carried_pilot(folder)
    with np.load(folder / GOLDEN, allow_pickle=False) as golden:
        arrivals, wanted = messages_in(golden, pilot.numbers.image), golden["commands"]
    off = np.abs(decided(pilot, arrivals, len(wanted)) - wanted).max(axis=1)
    wrong = np.flatnonzero(~(off <= AGREES))
    return {
        "schema": 1,
        "machine": platform.machine(),
        "steps": len(wanted),
        "equal": int((off == 0).sum()),
        "largest_difference": float(off.max()),
        "first_beyond": int(wrong[0]) if len(wrong) else None,
        "agrees": not len(wrong),
        "memory_mib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1),
        "foreign": sorted({"taichi", "torch", "llvmlite", "uuvtai"} & set(sys.modules)),
    }


def main() -> int:
    """Exit code 3: another decision; 2: no such folder, or no code for this computer."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=Path(__file__).resolve().parents[1])
    try:
        found = compare(parser.parse_args().folder)
    except StackFolderError as error:
        print(error, file=sys.stderr)
        return 2
    print(json.dumps(found, indent=1))
    return 0 if found["agrees"] else 3


if __name__ == "__main__":
    raise SystemExit(main())
