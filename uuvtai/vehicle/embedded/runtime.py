"""The stack's machine code in an exported folder, launched with NumPy and ctypes alone. Copied into the
folder; it knows nothing of the rest of uuvtai but the pilot's frame."""

from __future__ import annotations

import argparse
import ctypes
import dataclasses
import hashlib
import json
import platform
import resource
import sys
from pathlib import Path
from typing import Any

import numpy as np

from uuvtai.vehicle.messages import KINDS, Mission, PilotNumbers, SensorMessage
from uuvtai.vehicle.onboard_core import FedPilot
from uuvtai.vehicle.sensor_inputs import FedSensors

SCHEMA = 3
SPEC, MEMORY, GOLDEN = "stack.json", "memory.npz", "golden.npz"
_PAGE = 4096


class StackFolderError(RuntimeError):
    """What a folder lacks to be an exported stack for this computer."""


class CarriedStack:
    """A ``StackRunner`` out of a folder."""

    def __init__(self, folder: Path) -> None:
        """Raises StackFolderError."""
        self.spec = spec_of(folder)
        self._library = _library_of(folder, self.spec)
        first = np.load(_unchanged(folder, self.spec, MEMORY), allow_pickle=False)["memory"]
        self._block = _aligned(len(first))
        self._block[:] = first
        self.views = {
            name: np.ndarray(
                place["shape"], place["dtype"], self._block.data, place["offset"], place["strides"]
            )
            for name, place in self.spec["arrays"].items()
        }
        self._kept: list[Any] = []
        self._runtime = self._runtime_block(self.spec["runtime"])
        self._tensors = [np.zeros(shape, dtype) for shape, dtype in self.spec["tensors"]]
        self._begin, self._step, self._keep = (
            [self._work(line) for line in self.spec[name]] for name in ("begin", "step", "keep")
        )
        self._mission: Mission | None = None

    def begin(self, mission: Mission, sensors: FedSensors) -> None:
        """Forget everything and take the first step."""
        self._mission = mission
        for name in ("clock.running", "clock.active"):
            self.views[name][...] = 0
        for tensor, value in zip(self._tensors, (1, mission.seed, mission.episode), strict=False):
            tensor[0] = value
        self._run(self._begin, sensors)

    def step(self, sensors: FedSensors) -> None:
        self._run(self._step, sensors)

    def _run(self, lines: list[Any], sensors: FedSensors) -> None:
        for line in lines:
            if not isinstance(line, str):
                line()
            elif line == "place":
                assert self._mission is not None
                for name, place in self._mission.places().items():
                    self.views[name][0] = place
            elif line == "route":
                if self.views["route.n_failed"][()]:  # there is no second planner here: the old route stays
                    self._run(self._keep, sensors)
            else:
                getattr(sensors, line)(None)

    def _work(self, line: dict[str, Any]) -> Any:
        """What a line of the specification does."""
        if "do" in line:
            return str(line["do"])
        function = getattr(self._library, f"uuv_kernel_{line['kernel']}")
        function.argtypes, function.restype = (ctypes.c_void_p, ctypes.c_void_p), None
        packed = self._packed(line["arguments"])
        self._kept.append(packed)
        runtime = ctypes.addressof(self._runtime)
        return lambda: function(ctypes.addressof(packed), runtime)

    def _packed(self, arguments: list[tuple[str, Any]]) -> ctypes.Structure:
        """Arguments as Taichi's kernels read them from memory."""
        fields: list[tuple[str, Any]] = []
        for i, (kind, value) in enumerate(arguments):
            if kind == "array":
                rank = self._tensors[value].ndim
                fields.append((f"shape{i}", _array_of(rank)))
            else:
                fields.append((f"a{i}", ctypes.c_int32 if kind == "int" else ctypes.c_float))
        packed = type("Arguments", (ctypes.Structure,), {"_fields_": fields})()
        for i, (kind, value) in enumerate(arguments):
            if kind == "array":
                place, tensor = getattr(packed, f"shape{i}"), self._tensors[value]
                place.data, place.shape[:] = tensor.ctypes.data, tensor.shape
            else:
                setattr(packed, f"a{i}", value)
        return packed

    def _runtime_block(self, layout: dict[str, int]) -> Any:
        """What kernels take for Taichi's runtime."""
        block = ctypes.create_string_buffer(layout["bytes"])
        alone = ctypes.c_int32(1)
        temporaries = ctypes.create_string_buffer(layout["temporary_bytes"])
        loop = ctypes.cast(self._library.uuv_parallel_for, ctypes.c_void_p).value
        self._kept += [alone, temporaries]
        addresses = {
            layout["pool"]: ctypes.addressof(alone),
            layout["parallel_for"]: loop,
            layout["temporaries"]: ctypes.addressof(temporaries),
        }
        for tree in range(layout["trees"]):
            addresses[layout["roots"] + 8 * tree] = self._block.ctypes.data
        for offset, address in addresses.items():
            ctypes.c_uint64.from_buffer(block, offset).value = address
        return block


def _array_of(rank: int) -> type[ctypes.Structure]:
    """Type of an array among a kernel's arguments: shape and address."""
    fields = [("shape", ctypes.c_int32 * rank), ("data", ctypes.c_void_p)]
    return type(f"Array{rank}", (ctypes.Structure,), {"_fields_": fields})


def carried_pilot(folder: Path, mission: Mission | None = None) -> FedPilot:
    """The pilot of a folder, on ``mission`` or that of the exported log. Raises StackFolderError."""
    stack = CarriedStack(folder)
    numbers: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in stack.spec["numbers"].items()
    }
    told = stack.spec["mission"]
    own = Mission(tuple(told["start"]), tuple(told["goal"]), told["seed"], told["episode"])
    return FedPilot(PilotNumbers(**numbers), stack, mission or own)


def spec_of(folder: Path) -> dict[str, Any]:
    """A folder's specification. Raises StackFolderError."""
    try:
        spec = json.loads((folder / SPEC).read_text(encoding="utf-8"))
        schema = spec["schema"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StackFolderError(f"{folder}: is no exported stack ({error})") from None
    if schema != SCHEMA:
        raise StackFolderError(
            f"{folder}: has the form {schema}, this runtime reads {SCHEMA}: export it anew"
        )
    return spec


def _library_of(folder: Path, spec: dict[str, Any]) -> ctypes.CDLL:
    kind = platform.machine()
    if kind not in spec["libraries"]:
        there = ", ".join(spec["libraries"])
        raise StackFolderError(
            f"{folder}: has no code for {kind}, only for {there}: export it for {kind} too"
        )
    library = _unchanged(folder, spec, spec["libraries"][kind])
    try:
        ctypes.CDLL("libm.so.6", mode=ctypes.RTLD_GLOBAL)
        return ctypes.CDLL(str(library.resolve()))
    except OSError as error:
        raise StackFolderError(f"{folder}: its code cannot be loaded ({error})") from None


def _unchanged(folder: Path, spec: dict[str, Any], name: str) -> Path:
    """A file of the folder that is what was exported. Raises StackFolderError."""
    try:
        is_same = digest_of(folder / name) == spec["sha256"][name]
    except (OSError, KeyError) as error:
        raise StackFolderError(f"{folder}: {name} cannot be loaded ({error})") from None
    if not is_same:
        raise StackFolderError(f"{folder}: {name} has changed since it was exported; export the stack anew")
    return folder / name


def digest_of(file: Path) -> str:
    """sha256 of a file. Raises OSError."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _aligned(n_bytes: int) -> np.ndarray:
    """Bytes that begin at a page, as Taichi has them."""
    whole = np.zeros(n_bytes + _PAGE, np.uint8)
    begin = -whole.ctypes.data % _PAGE
    return whole[begin : begin + n_bytes]


# ---- Messages of a log and what was decided on them, and whether a folder's code decides the same: ``python
# -m uuv_stack FOLDER``. Copied into every exported folder.

AGREES = 1e-4  # largest difference between two commands, each in [-1, 1], that counts as none


def packed_messages(arrivals: list[tuple[int, SensorMessage]]) -> dict[str, np.ndarray]:
    """Arrays of messages, each with the step before which it arrives, in the order of arrival."""
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
            key = f"{name}.{member.name}"
            found[key] = np.concatenate([value.ravel() for value in values]) if values else np.zeros(0)
            found[f"{key}.length"] = np.array([value.size for value in values], np.int32)
    return found


def messages_in(packed: Any, image: tuple[int, ...]) -> list[tuple[int, SensorMessage]]:
    """What ``packed_messages`` packed; ``image``: shape of a depth image."""
    kinds = list(KINDS.items())
    fields = {
        f"{name}.{member.name}": iter(
            np.split(packed[f"{name}.{member.name}"], np.cumsum(packed[f"{name}.{member.name}.length"])[:-1])
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
    if name in ("time_s", "first_beam") or (kind, name) == ("pressure", "depth_m"):
        return float(flat[0])
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
    """What a folder's code decides here beside what it did at its export. Raises StackFolderError."""
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
