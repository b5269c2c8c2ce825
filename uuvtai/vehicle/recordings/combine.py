"""``uuv log import``: recordings of one drive as one log, with the topics that ``uuv replay`` reads.

Times count from the earliest reading. A rig has one instrument of a kind: where two files tell the same at
the same time an instrument's own file counts before an autopilot's, then the one that was named first.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from uuvtai.common.files import open_file, refuse_output, refusing
from uuvtai.config import Config
from uuvtai.config.loader import to_yaml
from uuvtai.logs.container import McapFile, whole_log
from uuvtai.logs.encode import IDENTITY, LogError, dumped
from uuvtai.logs.reader import IMPORTED
from uuvtai.logs.scenario import scenario_document
from uuvtai.logs.schemas import NUMBER, array_of, described, record
from uuvtai.logs.topics import TOPICS
from uuvtai.sim.behavior_tree import read_tree
from uuvtai.sim.scene import SceneOptions
from uuvtai.vehicle.messages import NAMES, DvlReading, ImuReading, PositionFix, PressureReading, SonarPing
from uuvtai.vehicle.pilot_log import ABOUT
from uuvtai.vehicle.recordings import sources
from uuvtai.vehicle.recordings.bags import read_bag
from uuvtai.vehicle.recordings.sources import Pulses, RecordingError, Source, Told
from uuvtai.vehicle.telemetry import wrapped

PULSES = record(
    "uuv.Pulses",
    us=described(array_of(NUMBER), "pulse widths of ArduSub's motors 1 to 8, none reversed, 0 = off; armed"),
)
_GAP_S = 2.0  # a file that is silent for longer leaves the time to others
_FAR_S = 86_400.0  # a time so far from the middle one of its file is none
_AHEAD_M, _EDGE_M = 5.0, 0.5
"""the goal where none is typed: so far ahead of the start, so far from a wall at least"""
_OUTSIDE = "--start, --goal: give X,Y,Z within the tank of --world, z is up and 0 at the surface"
_MOST_NOTES = 20

Read = Callable[[Source, Config, tuple[float, ...]], None]
_READERS: dict[str, Read] = {
    "tlog": sources.read_ardusub,
    "DataFlash": sources.read_ardusub,
    "A50": lambda source, config, _: sources.read_a50(source, config),
    "Ping Viewer": lambda source, config, _: sources.read_ping_viewer(source, config),
    "uuv pilot": sources.read_pilot,
    "bag": read_bag,
}
_INSTRUMENTS = ("A50", "Ping Viewer")


def kind_of(path: Path) -> str:
    """What a file is, by how it begins: a key of the readers. Raises RecordingError, FileError."""
    if path.is_dir():
        return "bag"
    unread = f"{path}: cannot be read"
    with refusing(RecordingError, unread, "name a recording"), open_file(path, sources.MOST_BYTES) as file:
        head = file.read(4096)
    if not head:
        raise RecordingError(f"{path}: is empty; give another copy of the recording")
    if head.startswith(b"\x89MCAP0") and ABOUT.encode() in head:
        return "uuv pilot"
    if head.startswith((b"\x89MCAP0", b"#ROSBAG", b"SQLite format 3\0")):
        return "bag"
    if head.startswith(b"\xa3\x95\x80"):
        return "DataFlash"
    if sources.VIEWER in head[:64].replace(b"\0", b""):
        return "Ping Viewer"
    if len(head) > 8 and head[8] in (0xFD, 0xFE):  # microseconds, then a packet of MAVLink
        return "tlog"
    if b"{" in head.lstrip()[:64].partition(b"\n")[0]:
        return "A50"
    raise RecordingError(
        f"{path}: begins neither like a .tlog, a .BIN, a log of uuv pilot, lines of an A50, a recording of "
        "Ping Viewer's nor a bag of ROS 1 or 2; name one of these"
    )


@dataclass(frozen=True)
class ImportPlan:
    """What ``uuv log import`` was told."""

    files: Sequence[Path]
    out: Path
    world: str = "open"
    sensors: str | None = None
    start: Sequence[float] | None = None
    """x, y, z [m] of where the recording begins, and perhaps the yaw [deg] there; None = the tank's middle"""
    goal: Sequence[float] | None = None
    offsets: Sequence[str] = ()
    """``FILE=SECONDS``, added to the times of a file"""


class _Import:
    """One run of the command."""

    def __init__(self, plan: ImportPlan) -> None:
        self.plan = plan
        refuse_output(plan.out, plan.files, True)
        if plan.out.exists():
            raise RecordingError(f"{plan.out}: is already there; give another --out")
        self.sources = [Source(path, kind_of(path)) for path in plan.files]
        self.offsets = [self._offset(source) for source in self.sources]
        for text in plan.offsets:
            if not any(_names(source, text) for source in self.sources):
                raise RecordingError(f"--offset {text}: names none of the files; write --offset FILE=SECONDS")
        self.config = self._scene()
        if self.config.sensors.sonar.doppler:
            raise RecordingError(
                "--sensors: no recording has a sonar with Doppler; take multibeam or ping360"
            )
        self.start, self.goal, self.yaw = self._places()
        self.notes: list[str] = []

    def _scene(self) -> Config:
        """With the sensors typed; else a Ping360 of the whole circle, as far as its recording reaches."""
        plan = self.plan
        head = next((source.path for source in self.sources if source.kind == "Ping Viewer"), None)
        if plan.sensors or head is None:
            return SceneOptions(plan.world, plan.sensors or "multibeam").config()
        found = {
            "horizontal_aperture_deg": "360",
            "n_ray": "400",
            "max_range_m": f"{sources.reach_m(head):.3f}",
        }
        circle = [f"sensors.sonar.{name}={value}" for name, value in found.items()]
        return SceneOptions(plan.world, "ping360", overrides=circle).config()

    def _offset(self, source: Source) -> float:
        typed = [text for text in self.plan.offsets if _names(source, text)]
        try:
            found = float(typed[-1].rpartition("=")[2]) if typed else 0.0
        except ValueError:
            found = math.nan
        if not abs(found) < 1e11:
            raise RecordingError(f"--offset {typed[-1]}: write --offset FILE=SECONDS")
        return found

    def _places(self) -> tuple[tuple[float, float, float], tuple[float, float, float], float]:
        """Start, goal [m], yaw at the start [rad]. RecordingError for places out of the tank."""
        tank, plan = self.config.world.tank, self.plan
        spans = (tank.x_m, tank.y_m, tank.z_m)
        middle = [0.5 * (low + high) for low, high in spans]
        x, y, z, yaw = [*(plan.start or middle), 0.0][:4]
        yaw = math.radians(yaw)
        ahead = [x + _AHEAD_M * math.cos(yaw), y + _AHEAD_M * math.sin(yaw), z]
        sides = [(low + _EDGE_M, high - _EDGE_M) for low, high in spans[:2]]
        inside = [min(max(v, low), high) for v, (low, high) in zip(ahead[:2], sides, strict=True)]
        goal = plan.goal or [*inside, z]
        for place in ((x, y, z), goal):
            if not all(low <= value <= high for value, (low, high) in zip(place, spans, strict=True)):
                raise RecordingError(f"{_OUTSIDE}: {spans}")
        return (x, y, z), (goal[0], goal[1], goal[2]), yaw

    def run(self) -> dict[str, Any]:
        """The document of ``uuv log import --json``."""
        for source, offset in zip(self.sources, self.offsets, strict=True):
            self._read(source, offset)
        self._drop_twice()
        every = [reading for source in self.sources for reading in source.readings]
        told = sorted(every, key=lambda reading: reading.time_s)
        if not told:
            why = f"{self.plan.files[0]}: tells nothing that the stack reads: {self._reasons()}"
            raise RecordingError(f"{why}; name another recording")
        begin_s = told[0].time_s
        self._note_ranges(begin_s)
        counts = Counter(_kind(reading) for reading in told)
        if not counts["position"]:
            estimated = self.config.sensors.model_copy(update={"localization": "estimated"})
            self.config = self.config.model_copy(update={"sensors": estimated})
        for kind in ("imu", "pressure", "dvl", "sonar"):
            if not counts[kind]:
                self.notes.append(f"no file tells {kind}")
        self._write(told, begin_s)
        return self._document(begin_s, told[-1].time_s, counts)

    def _read(self, source: Source, offset: float) -> None:
        with refusing(RecordingError, f"{source.path}: cannot be read"):
            _READERS[source.kind](source, self.config, self.start)
        times = np.array([reading.time_s for reading in source.readings])
        if not len(times):
            return
        near = np.abs(times - np.median(times)) <= _FAR_S
        if not near.all():
            source.drop("readings", "a time that is a day or more from the others'", int((~near).sum()))
        source.readings = [
            dataclasses.replace(reading, time_s=reading.time_s + offset)
            for reading, is_near in zip(source.readings, near.tolist(), strict=True)
            if is_near
        ]

    def _drop_twice(self) -> None:
        """Of two files that tell the same at the same time one counts."""
        spans: dict[str, list[tuple[float, float, Path]]] = {}
        for source in sorted(self.sources, key=lambda each: each.kind not in _INSTRUMENTS):
            kept = []
            for reading in source.readings:
                kind = _kind(reading)
                other = next((s for s in spans.get(kind, []) if s[0] <= reading.time_s <= s[1]), None)
                if other is None:
                    kept.append(reading)
                else:
                    source.drop(f"readings: {kind}", f"{other[2].name} tells it")
            source.readings = kept
            for kind in {_kind(reading) for reading in kept}:
                times = np.sort([reading.time_s for reading in kept if _kind(reading) == kind])
                for part in np.split(times, np.flatnonzero(np.diff(times) > _GAP_S) + 1):
                    spans.setdefault(kind, []).append((part[0], part[-1], source.path))

    def _note_ranges(self, begin_s: float) -> None:
        """Files that lie apart from the first, and from those that do not, are named with the offset that has
        both begin together."""
        spans = [(source, *_span(source)) for source in self.sources if source.readings]
        joined, start_s = spans[:1], spans[0][1]
        for source, first, last in spans[1:]:
            if any(first <= high and low <= last for _, low, high in joined):
                joined.append((source, first, last))
                continue
            shift = start_s - first + self.offsets[self.sources.index(source)]
            self.notes.append(
                f"{source.path}: {first - begin_s:.1f} to {last - begin_s:.1f} s overlaps no other file; to "
                f"begin it with {spans[0][0].path.name}: --offset {source.path}={shift:.3f}"
            )
        for source in self.sources:
            if not source.readings:
                self.notes.append(f"{source.path}: tells nothing that is used")
        del self.notes[_MOST_NOTES:]

    def _reasons(self) -> str:
        all_of = sum((source.dropped for source in self.sources), Counter())
        found = [f"{what}: {why} ({count})" for (what, why), count in all_of.most_common(3)]
        return "; ".join(found) or "it holds no messages"

    # ------------------------------------------------------------------------------------------------ writing

    def _write(self, told: list[Told], begin_s: float) -> None:
        out = self.plan.out
        with refusing(LogError, f"{out}: cannot write there", "give another --out"):
            out.parent.mkdir(parents=True, exist_ok=True)
            with whole_log(out) as file:
                self._write_messages(file, told, begin_s)

    def _write_messages(self, file: McapFile, told: list[Told], begin_s: float) -> None:
        self._write_head(file)
        channels: dict[str, int] = {}
        writer = _Messages(self.config, self.start, self.yaw, self._levers())
        for reading in told:
            time_ns = round(1e9 * (reading.time_s - begin_s))
            for topic, data in writer.of(reading, time_ns):
                if topic not in channels:
                    schema = SCHEMAS[topic]
                    known = file.add_schema(schema["title"], "jsonschema", json.dumps(schema).encode())
                    channels[topic] = file.add_channel(topic, known)
                file.add_message(channels[topic], time_ns, data)

    def _levers(self) -> set[int]:
        """Readings of a DVL that speaks of its own place."""
        return {id(each) for s in self.sources if s.kind == "A50" for each in s.readings}

    def _write_head(self, file: McapFile) -> None:
        tree = read_tree("bt")
        about = {"agent": "bt", "world": self.plan.world, "seed": "0", "episode": "0"}
        about["files"] = json.dumps([str(path) for path in self.plan.files])
        file.add_metadata(IMPORTED, about)
        places = {"start": list(self.start), "start_yaw": self.yaw, "goal": list(self.goal), "obstacles": []}
        scenario = scenario_document(self.config, places, self.plan.world, 0, 0)
        file.add_attachment("config.yaml", "application/yaml", to_yaml(self.config).encode())
        file.add_attachment("scenario.json", "application/json", json.dumps(scenario).encode())
        file.add_attachment("tree.xml", "application/xml", tree.xml)

    def _document(self, begin_s: float, end_s: float, counts: Counter[str]) -> dict[str, Any]:
        return {
            "schema": 1, "log": str(self.plan.out), "begin_s": begin_s,
            "duration_s": round(end_s - begin_s, 3), "start": list(self.start), "goal": list(self.goal),
            "localization": self.config.sensors.localization, "readings": dict(counts),
            "files": [self._of_file(source, begin_s) for source in self.sources], "notes": self.notes,
        }  # fmt: skip

    def _of_file(self, source: Source, begin_s: float) -> dict[str, Any]:
        first, last = _span(source) if source.readings else (begin_s, begin_s)
        rows = sorted(source.dropped.items(), key=lambda row: (-row[1], row[0]))
        return {
            "path": str(source.path), "kind": source.kind, "messages": source.messages,
            "readings": len(source.readings), "from_s": round(first - begin_s, 3),
            "to_s": round(last - begin_s, 3), "offset_s": self.offsets[self.sources.index(source)],
            "dropped": [{"what": what, "why": why, "count": count} for (what, why), count in rows],
        }  # fmt: skip


def _names(source: Source, text: str) -> bool:
    named, _, _ = text.rpartition("=")
    return bool(named) and (Path(named) == source.path or named == source.path.name)


def _kind(reading: Told) -> str:
    return "motors" if isinstance(reading, Pulses) else NAMES[type(reading)]


def _span(source: Source) -> tuple[float, float]:
    times = [reading.time_s for reading in source.readings]
    return min(times), max(times)


SCHEMAS: dict[str, Any] = {
    topic.name: topic.schema
    for topic in TOPICS
    if topic.name.startswith("/sensors/") or topic.name in ("/sonar/scan", "/sonar/doppler", "/pose_estimate")
} | {"/motors/pulses": PULSES}


class _Messages:
    """Readings, in the order of time, as a log's messages."""

    def __init__(self, config: Config, start: Sequence[float], yaw: float, levers: set[int]) -> None:
        """``yaw`` [rad]: by how much the world's x axis is behind where the vehicle first looked; ``levers``:
        ids of velocities that are those of the DVL's place."""
        self._sonar, self._lever = config.sensors.sonar, np.array(config.sensors.dvl.position_b_m)
        self._start, self._yaw, self._levers = np.array(start), yaw, levers
        self._rate_b, self._vel_b = np.zeros(3), np.zeros(3)

    def of(self, reading: Told, time_ns: int) -> list[tuple[str, bytes]]:
        """(topic, JSON)"""
        if isinstance(reading, Pulses):
            return [("/motors/pulses", dumped({"us": _list(reading.us)}))]
        if isinstance(reading, ImuReading):
            self._rate_b = np.asarray(reading.rate_b)
            turned = [*_list(reading.rpy)[:2], wrapped(float(reading.rpy[2]) + self._yaw)]
            rest = {"rates": _list(reading.rate_b), "specific_force": _list(reading.specific_force_b)}
            return [("/sensors/imu", dumped({"attitude": turned} | rest))]
        if isinstance(reading, DvlReading):
            moved = np.cross(self._rate_b, self._lever) if id(reading) in self._levers else 0.0
            self._vel_b = np.asarray(reading.vel_b) - moved
            return [("/sensors/dvl", dumped({"velocity": _list(self._vel_b)}))]
        if isinstance(reading, PressureReading):
            return [("/sensors/pressure", dumped({"depth_m": float(reading.depth_m)}))]
        stamp: dict[str, int] = dict(zip(("sec", "nsec"), divmod(time_ns, 1_000_000_000), strict=True))
        if isinstance(reading, PositionFix):
            x, y, z = np.asarray(reading.pos_w) - self._start
            cos, sin = math.cos(self._yaw), math.sin(self._yaw)
            place = self._start + np.array([cos * x - sin * y, sin * x + cos * y, z])
            pose = IDENTITY | {"position": dict(zip("xyz", _list(place), strict=True))}
            return [("/pose_estimate", dumped({"timestamp": stamp, "frame_id": "world", "pose": pose}))]
        assert isinstance(reading, SonarPing)
        return self._scan(reading, stamp)

    def _scan(self, ping: SonarPing, stamp: dict[str, int]) -> list[tuple[str, bytes]]:
        sonar = self._sonar
        first = sonar.first_beam_rad + sonar.turn_rad(ping.first_beam)
        hit = np.asarray(ping.hit) > 0
        scan = {"timestamp": stamp, "frame_id": "sonar", "pose": IDENTITY, "start_angle": first}
        scan["end_angle"] = first + sonar.turn_rad(len(hit) - 1)
        scan["ranges"] = _list(np.where(hit, ping.range_m, sonar.max_range_m))
        scan["intensities"] = _list(hit * 1.0)
        own = {"timestamp": stamp, "velocity": [], "own_velocity": _list(self._vel_b)}
        return [("/sonar/scan", dumped(scan)), ("/sonar/doppler", dumped(own))]


def _list(values: Any) -> list[float]:
    return [float(value) for value in values]


def import_recordings(plan: ImportPlan) -> dict[str, Any]:
    """Write the log; the document of ``uuv log import --json``. Raises RecordingError, FileError, LogError,
    ConfigError, SettingError, and then nothing is left."""
    return _Import(plan).run()
