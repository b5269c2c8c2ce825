"""Recorded episodes for the player of a page: logs as quantised arrays, packed, that base64 carries.

A blob is zlib's stream of: length of the header [bytes, uint32, little endian], the header in JSON, arrays.
The header names each array with its place, bytes of an integer, rows, columns and ``step``: value = integer *
step. Stored are differences from row to row, column after column, their lowest bytes first, then the next:
so they pack best. What comes from a log is in the blob and nowhere else.
"""

from __future__ import annotations

import base64
import json
import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from uuvtai.common.colours import PALETTE, agent_colours
from uuvtai.common.obstacle_motion import KIND_NAMES, obstacle_positions
from uuvtai.logs import drawing
from uuvtai.logs.drawing import TRIGGER_COLORS, Recording, Series

RECORDING_BYTES, SCENE_BYTES = 300_000, 100_000
"""the most that an agent's episode, and what all agents of one share, may take of a page"""
PLACE_M, TIME_S, SPEED_M_S, SHARE, TRACK_M, VARIANCE_M2 = 1e-3, 1e-3, 1e-2, 1 / 31, 1e-2, 1e-3
"""steps of the quantised values: an error is at most half of one; ``SHARE`` of an occupancy"""
_POINT_M, _FAR_M, CLEAR_M, _MOST_TTC_S = 0.02, 0.05, 0.1, 100.0
_SEEN_M = 10.0  # as far as the camera's image shows differences
_GAP_S, _MOST_MOMENTS = 0.0999, 150
"""[s] between tracks that are shown, and how many scans and forecasts are; a log may have 50 a second"""
LEAST_WEIGHT, EVERY_POINT = 0.1, 5  # of forecasts: less likely ones, and points between, are not shown
_MOST_STEPS, _MOST_CELLS, _MOST_NUMBERS = 20_000, 4_000_000, 3_000_000  # zeros pack well, and fill a memory
_SHED = ("camera", "echoes", "map_clearance", "futures", "tracks", "map_dynamic", "map_static", "route")
"""what is left out first where an episode is too long to be held whole"""

_DARK = {
    "paper": "#12171d", "water": "#1a2733", "ink": "#e4e9ee", "grey": "#9fabb7", "faint": "#323c47",
    "static": "#c3ccd6", "dynamic": "#ff6b75", "goal": "#f7c531", "route": "#58adff", "mover": "#ff8a45",
    "failed": "#ff8787", "echo": "#37c2bb",
    "initial": "#9fabb7", "stuck": "#d58be0", "safety": "#ff9a52", "intersection": "#6cb6f5",
}  # fmt: skip


def palette() -> dict[str, tuple[str, str]]:
    """'#rrggbb' on light and on dark of everything that is drawn: on light as in pictures and videos."""
    light = TRIGGER_COLORS | {
        name: vars(drawing)[name.upper()] for name in _DARK if name not in TRIGGER_COLORS
    }
    return {name: ("#{:02x}{:02x}{:02x}".format(*light[name][::-1]), dark) for name, dark in _DARK.items()}


@dataclass(frozen=True)
class Fact:
    """How an agent's episode ended: why, by name and meaning, and the slot of what was touched, -1 = none."""

    cause: str = ""
    meaning: str = ""
    slot: int = -1


# ---- Blobs: a header and arrays of integers, packed.


_MOST = 1 << 30  # of a quantised value: differences fit four bytes


class _Packer:
    """Collects named arrays and packs them with a header."""

    def __init__(self) -> None:
        self._arrays: dict[str, tuple[np.ndarray, float]] = {}

    def add(self, name: str, values: Any, step: float = 1.0) -> None:
        """Numbers (n, columns) or (n,), quantised by ``step``. Raises ValueError for what is too large."""
        rows = np.asarray(values, float)
        if not (np.abs(rows) < _MOST * step).all():
            raise ValueError(f"{name}: a number beyond all bounds, or none")
        whole = np.rint((rows if rows.ndim == 2 else rows[:, None]) / step).astype(np.int64)
        differences = np.diff(whole, axis=0, prepend=np.zeros((min(len(whole), 1), whole.shape[1]), np.int64))
        self._arrays[name] = differences, step

    @property
    def numbers(self) -> int:
        return sum(integers.size for integers, _ in self._arrays.values())

    def drop(self, prefix: str) -> bool:
        """Whether there was anything of that name."""
        names = [name for name in self._arrays if name.split(".")[0] == prefix]
        for name in names:
            del self._arrays[name]
        return bool(names)

    def packed(self, header: dict[str, Any]) -> bytes:
        table, parts, place = {}, [], 0
        for name, (integers, step) in self._arrays.items():
            low, high = int(integers.min(initial=0)), int(integers.max(initial=0))
            kind = next(kind for kind in ("i1", "i2", "i4") if max(-low - 1, high) <= np.iinfo(kind).max)
            flat = integers.astype(f"<{kind}").ravel(order="F")
            data = flat.view(np.uint8).reshape(-1, flat.itemsize).T.tobytes()
            rows, columns = integers.shape
            table[name] = {"at": place, "bytes": int(kind[1]), "rows": rows, "columns": columns, "step": step}
            parts.append(data)
            place += len(data)
        head = json.dumps({**header, "arrays": table}, allow_nan=False, separators=(",", ":")).encode()
        return base64.b64encode(zlib.compress(struct.pack("<I", len(head)) + head + b"".join(parts)))


# ---- One agent's recording.


def packed_agent(recording: Recording, colour: str, fact: Fact) -> bytes:
    """The blob of one agent, in base64. Raises what ``drawing.drawing`` turns into LogError."""
    poses = recording["/pose"]
    keep = slice(None, None, -(-len(poses.times) // _MOST_STEPS))
    times = poses.times[keep]
    pack = _Packer()
    pack.add("time", times, TIME_S)
    pose = np.array(poses.values[keep])
    pack.add("pose", np.column_stack([pose[:, :3], np.unwrap(pose[:, 3])]), PLACE_M)
    _add_along(pack, recording, times)
    _add_events(pack, recording)
    grid = _grid(recording)
    if grid is not None:
        shape = grid["rows"], grid["columns"]
        for name, step in (("static", SHARE), ("dynamic", SHARE), ("clearance", CLEAR_M)):
            _add_map(pack, f"map_{name}", recording[f"/map/{name}"], step, shape)
    leaves = recording["/action"].values
    header = {
        "agent": recording.agent[:80],
        "colour": [colour, PALETTE.index(colour) if colour in PALETTE else -1],
        "outcome": recording.outcome_text[:80],
        "failed": recording.outcome not in ("success", drawing.REPLAYED),
        "cause": fact.cause[:80],
        "meaning": fact.meaning[:300],
        "slot": fact.slot,
        "leaves": list(dict.fromkeys(str(leaf)[:40] for leaf in leaves))[:100],
        "triggers": list(TRIGGER_COLORS),
        "grid": grid,
        "rare_s": _rare_s(recording),
        "left_out": [],
    }
    content = pack.packed(header)
    for name in _SHED:
        if len(content) <= RECORDING_BYTES and pack.numbers <= _MOST_NUMBERS:
            break
        if pack.drop(name):
            header["left_out"].append(name.replace("_", " "))
            content = pack.packed(header)
    if len(content) > RECORDING_BYTES:
        raise ValueError(f"an episode of {len(times)} steps that takes {len(content)} bytes")
    return content


def _add_along(pack: _Packer, recording: Recording, times: Sequence[float]) -> None:
    """What there is at every step, as of that moment."""
    safety, leaves = recording["/safety"], [str(leaf)[:40] for leaf in recording["/action"].values]
    if safety.times and recording.outcome != drawing.REPLAYED:  # nobody knows the truth
        first = safety.values[0]
        rows = [safety.at(time_s) or first for time_s in times]
        pack.add("clearance", [row[0] for row in rows], PLACE_M)
        # -1 = nothing closes in
        pack.add("ttc", [-1.0 if row[1] is None else min(row[1], _MOST_TTC_S) for row in rows], SPEED_M_S)
    if recording["/state"].times:
        pack.add("speed", [recording["/state"].at(time_s) or 0.0 for time_s in times], SPEED_M_S)
    if leaves:
        codes = {leaf: i for i, leaf in enumerate(list(dict.fromkeys(leaves))[:100])}
        found = Series(recording["/action"].times, [codes.get(leaf, 0) for leaf in leaves])
        pack.add("leaf", [found.at(time_s) or 0 for time_s in times])
    ahead = recording["/plan/lookahead"]
    if ahead.times:
        pack.add("ahead", [ahead.at(time_s) or ahead.values[0] for time_s in times], _POINT_M)


def _add_events(pack: _Packer, recording: Recording) -> None:
    """Routes, tracks, forecasts and returns: rows of each moment, as many as it has."""
    plans, triggers = recording["/plan/info"], list(TRIGGER_COLORS)
    _add_rows(pack, "route", plans.times, [points for points, _ in plans.values], _POINT_M)
    codes = [triggers.index(why) if why in triggers else 0 for _, why in plans.values]
    pack.add("route.why", codes)
    tracks = _spaced(recording["/tracks"])
    _add_rows(pack, "tracks", tracks.times, [rows[:, :6] for rows in tracks.values], TRACK_M)
    pack.add(
        "tracks.cov", np.concatenate([np.empty((0, 3)), *(r[:, 6:9] for r in tracks.values)]), VARIANCE_M2
    )
    gap_s = _rare_s(recording)
    futures = _spaced(recording["/futures"], gap_s)
    likely = [(weight >= LEAST_WEIGHT, weight, points) for weight, points in futures.values]
    paths = [points[keep, ::EVERY_POINT] for keep, _, points in likely]
    if len({part.shape[1] for part in paths if len(part)}) == 1:
        flat = [part.reshape(len(part), -1) for part in paths if len(part)]
        moments = [time_s for time_s, part in zip(futures.times, paths, strict=True) if len(part)]
        _add_rows(pack, "futures", moments, flat, _FAR_M)
        pack.add("futures.weight", np.concatenate([w[keep] for keep, w, _ in likely]), SHARE)
    scans = recording["/sonar/scan"]
    moments = _spaced(Series(scans.times, scans.times), gap_s).times
    _add_rows(pack, "echoes", moments, [recording.echoes(time_s) for time_s in moments], _POINT_M)
    seen = recording["/camera/depth"]
    if seen.times:
        pack.add("camera.time", seen.times, TIME_S)
        pack.add("camera.of", [camera_view(image / 1000.0).ravel() for image in seen.values])


def camera_view(depth_m: np.ndarray) -> np.ndarray:
    """What a depth image (rows, columns) [m] shows of the nearest ``_SEEN_M``, uint8 (36, 64): 0 = near,
    31 = that far or farther."""
    near = cv2.resize(np.minimum(depth_m, _SEEN_M).astype(np.float32), (64, 36), interpolation=cv2.INTER_AREA)
    return np.rint(near * (31 / _SEEN_M)).astype(np.uint8)


def _rare_s(recording: Recording) -> float:
    """[s] between the moments that show returns and forecasts."""
    return max(2 * _GAP_S, recording.duration_s / _MOST_MOMENTS)


def _spaced(series: Series, gap_s: float = _GAP_S) -> Series:
    """Without what comes sooner than that after the one before."""
    found = Series()
    for time_s, value in zip(series.times, series.values, strict=True):
        if not found.times or time_s - found.times[-1] >= gap_s:
            found.add(time_s, value)
    return found


def _add_rows(
    pack: _Packer, name: str, times: Sequence[float], rows: Sequence[np.ndarray], step: float
) -> None:
    """Rows by time: ``name``.time, ``name``.rows = how many each moment has, ``name``.of = all of them."""
    width = rows[0].shape[1] if rows else 2
    pack.add(f"{name}.time", times, TIME_S)
    pack.add(f"{name}.rows", [len(part) for part in rows])
    pack.add(f"{name}.of", np.concatenate([np.empty((0, width)), *rows]), step)


def _add_map(pack: _Packer, name: str, series: Series, step: float, shape: tuple[int, int]) -> None:
    """A layer of the map as changes: cells (row * columns + column) that differ from the time before."""
    cells, values, counts = [np.empty(0, int)], [np.empty(0, int)], []
    before = np.zeros(shape[0] * shape[1], np.uint8)
    for layer in series.values:
        if layer.shape != shape:
            raise ValueError(f"{name}: maps of {layer.shape} and {shape} cells")
        now = np.rint(np.clip(layer.values, 0, 255 * step).ravel() / step).astype(np.uint8)
        changed = np.flatnonzero(now != before)
        cells.append(changed)
        values.append(now[changed])
        counts.append(len(changed))
        before = now
    pack.add(f"{name}.time", series.times, TIME_S)
    pack.add(f"{name}.rows", counts)
    pack.add(f"{name}.of", np.concatenate(cells))
    pack.add(f"{name}.value", np.concatenate(values))


def _grid(recording: Recording) -> dict[str, Any] | None:
    """Shape and place of the map; None = the log has none."""
    layers = recording["/map/static"].values
    if not layers:
        return None
    rows, columns = layers[0].shape
    if rows * columns > _MOST_CELLS:
        raise ValueError(f"a map of {rows} x {columns} cells")
    x, y = map(float, layers[0].origin_m)
    return {"rows": rows, "columns": columns, "x": x, "y": y, "cell_m": float(layers[0].cell_m)}


# ---- What the agents of an episode share.


def packed_scene(recordings: Sequence[Recording]) -> bytes:
    """The blob of the truth that all agents meet, in base64."""
    scenario = recordings[0].scenario
    header, moving = scene_header(scenario)
    times = max((one["/pose"].times for one in recordings), key=lambda found: found[-1])
    times = times[:: -(-len(times) // _MOST_STEPS)]
    for share in (1, 2, 5, 10, 50):  # the last step of this episode is always there
        some = np.array([*times[:-1:share], times[-1]])
        pack = _Packer()
        pack.add("time", some, TIME_S)
        places = [obstacle_positions(obstacle, some)[:, :2] for obstacle in moving]
        pack.add("places", np.concatenate([np.empty((len(some), 0)), *places], axis=1), PLACE_M)
        content = pack.packed(header)
        if len(content) <= SCENE_BYTES and pack.numbers <= _MOST_NUMBERS:
            return content
    raise ValueError(f"{len(moving)} moving obstacles in {len(times)} steps")


def scene_header(scenario: dict[str, Any]) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """(what the player knows of a scenario beside places, its obstacles that move). ValueError for a tank
    without depth."""
    obstacles = scenario["obstacles"]
    moving = [obstacle for obstacle in obstacles if obstacle["path"] is not None]
    tank = scenario["tank"]
    low, high = _floats(tank["z_m"], 2)
    if not low < high:
        raise ValueError(f"a tank from {low:g} to {high:g} m")
    header = {
        "tank": {
            "shape": "circle" if tank["shape"] == "circle" else "rectangle",
            "radius_m": float(tank["radius_m"]),
            **{axis: _floats(tank[axis], 2) for axis in ("x_m", "y_m", "z_m")},
        },
        "goal": _floats(scenario["goal"], 3),
        "goal_radius_m": float(scenario["goal_radius_m"]),
        "obstacles": [_obstacle(one) for one in obstacles],
        "palette": palette(),
    }
    return header, moving


def _obstacle(obstacle: dict[str, Any]) -> dict[str, Any]:
    return {
        "kind": obstacle["kind"] if obstacle["kind"] in KIND_NAMES.values() else "cylinder",
        "at": _floats(obstacle["position"], 3),
        "size": [abs(length) for length in _floats(obstacle["size"], 3)],
        "yaw": float(obstacle["yaw"]),
        "slot": int(obstacle["slot"]),
        "moves": obstacle["path"] is not None,
    }


def _floats(values: Sequence[Any], n: int) -> list[float]:
    """The first so many, as numbers."""
    return [float(values[i]) for i in range(n)]


def packed_episode(paths: Sequence[Path], agents: Sequence[str], fact: Callable[[str], Fact]) -> list[bytes]:
    """Blobs of one episode: the scene, then each log's agent. ``agents``: all that are compared, by whom the
    colours go; ``fact``: how an agent's episode ended. Raises LogError for a log that cannot be shown."""
    recordings = [drawing.load_recording(path) for path in paths]
    names = [recording.agent for recording in recordings]
    colours = agent_colours([*agents, *names])
    with drawing.drawing(paths[0]):
        blobs = [packed_scene(recordings)]
    for path, recording in zip(paths, recordings, strict=True):
        with drawing.drawing(path):
            blobs.append(packed_agent(recording, colours[recording.agent], fact(recording.agent)))
    return blobs
