"""Instruments by their own protocols (pool, S = 8, D = 6 and 0, v = 0.6 m/s): CPU of the adapters; ``uuv sitl
--as``, ``uuv pilot --rate 0`` that hears an A50 and a Ping360, a 3D-15 or a ring as JSON, and between them
the stand-in autopilot, every part a process of its own. Beside it the same episodes in
``uuv eval``'s loop.

All of them go by the water's clock: the autopilot waits for the water's answer and for the pilot, so a busy
machine makes them slow and changes nothing else.
"""

from __future__ import annotations

import json
import math
import os
import re
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
import yaml

from benchmarks.common import Job, Row
from uuvtai.api import evaluate
from uuvtai.common.enums import LETTERS
from uuvtai.common.statistics import bootstrap_interval, wilson_interval
from uuvtai.config.loader import load_config
from uuvtai.logs.run_folder import git_sha
from uuvtai.vehicle.calibrate import WAYS
from uuvtai.vehicle.instruments.a50 import A50
from uuvtai.vehicle.instruments.channel import Instrument, InstrumentPlace, TcpChannel, UdpChannel
from uuvtai.vehicle.instruments.emulate import FakeA50, FakePing360, FakeSonar3D, emulated
from uuvtai.vehicle.instruments.ping import Ping360
from uuvtai.vehicle.instruments.rig import JsonUdp
from uuvtai.vehicle.instruments.rip2 import LONGEST, Sonar3D
from uuvtai.vehicle.stand_in import LOOP_HZ, RATE_HZ, StandIn

THREADS = 1
LONGEST_S = 86400
SETS = ("a50,ping360", "a50,3d15", "a50,json")  # the last: a ring
EPISODES, CALIBRATIONS, SEED = 600, 20, 90011
FLIGHTS = Path(__file__).with_name("flights.json")
_LETTERS = LETTERS | {"not ended": "-"}
_WORDS = {letter: word for word, letter in _LETTERS.items()}
_PILOTS = 3  # at once; one is getting ready while others drive
_ROOT = Path(__file__).resolve().parent.parent
_PATIENCE_S = 20.0  # by our clock, that the pilot is waited for
_SAYS_START = re.compile(r"instance (\d+): uuv pilot needs --start (\S+) --goal (\S+) --heading (\S+)")
_SAYS_END = re.compile(r"instance (\d+): (\w+) after ([\d.]+) s")


def measure(job: Job) -> list[Row]:
    """CPU of each adapter; arrivals beside the simulator's own loop; errors of calibrations."""
    count = 2 if job.quick else EPISODES
    rows = [_adapter(name, job) for name in ADAPTERS]
    for setup in (Setup(kinds, dynamic) for dynamic in (6, 0) for kinds in SETS):
        rows += _driven(setup, count, job)
    return [*rows, *_calibrations(2 if job.quick else CALIBRATIONS, job)]


def _driven(setup: Setup, count: int, job: Job) -> list[Row]:
    """By the instruments, in the simulator's own loop, and the difference by episode. What has been flown is
    kept (``FLIGHTS``) and not flown again, for all of it takes hours."""
    what, known = f"{setup.kinds.replace(',', ' + ')}, D = {setup.dynamic}", json.loads(FLIGHTS.read_text())
    kept = known.setdefault(what, {"processes": "", "loop": "", "commits": []})
    ends, own = ([_WORDS[letter] for letter in kept[side] if not job.quick] for side in ("processes", "loop"))

    def keep(side: str, found: list[str]) -> None:
        if not job.quick:
            kept[side] = "".join(_LETTERS[end] for end in found)
            kept["commits"] = sorted({*kept["commits"], str(git_sha())})
            FLIGHTS.write_text(json.dumps(known, indent=1) + "\n")

    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(_PILOTS) as threads, ExitStack() as opened:
        folder, pilots = Path(name), SimpleQueue[Process]()
        for _ in range(_PILOTS if len(ends) < count else 0):
            pilots.put(opened.enter_context(Process(folder)))
        for first in range(len(ends), count, MOST_AT_ONCE):
            some = min(MOST_AT_ONCE, count - first)
            with Process(folder) as process:
                waters = Waters(process, setup, folder, first, some)
                ends += threads.map(partial(flown, waters, pilots, job.say), range(some))
            keep("processes", ends)
        if len(own) < count:
            own = in_the_loop(str(setup.rig(folder)), setup.overrides, count)
            keep("loop", own)
    off = [100.0 * ((one == "success") - (other == "success")) for one, other in zip(ends, own, strict=True)]
    low, high = bootstrap_interval(off) or (math.nan, math.nan)
    note = f"[{low:.1f}, {high:.1f}]; {off.count(100)} arrive so alone, {off.count(-100)} not"
    return [
        ends_row(f"{what}, by processes", ends),
        ends_row(f"{what}, in the simulator's own loop", own),
        Row(f"{what}, difference", float(np.mean(off)), "points", note=note),
    ]


def ends_row(what: str, found: list[str]) -> Row:
    """How many episodes were a success, and how the others ended."""
    count, ends = len(found), Counter(found)
    low, high = wilson_interval(ends["success"], count) or (0.0, 1.0)
    others = ", ".join(f"{end} {n}" for end, n in sorted(ends.items()) if end != "success") or "none"
    note = f"{ends['success']} of {count} [{100 * low:.1f}, {100 * high:.1f}]; others: {others}"
    share, details = 100.0 * ends["success"] / count, {"endings": found, "seed": SEED}
    return Row(what, share, "% of the episodes a success", note=note, details=details)


def in_the_loop(sensors: str, overrides: Mapping[str, Any], count: int) -> list[str]:
    """How the same episodes end in ``uuv eval``, by the simulator's own velocity loop."""
    given: Any = {"sensors": sensors, "vehicle": "bluerov2_16v", "overrides": dict(overrides)}
    with tempfile.TemporaryDirectory() as folder:
        found = evaluate("bt", "pool", episodes=count, seeds=SEED, run_dir=Path(folder) / "loop", **given)
    return [episode["outcome"] for episode in found.document["agents"][0]["episodes_detail"]]


def _calibrations(count: int, job: Job) -> list[Row]:
    """With the DVL turned by a few degrees, from near an end of the pool."""
    found = []
    for number in range(count):
        yaw_deg = 16.0 * (number / max(count - 1, 1)) - 8.0
        with tempfile.TemporaryDirectory() as name:
            setup = Setup(static=0, yaw_deg=yaw_deg, changes=_BY_THE_WALL)
            with Process(Path(name)) as process, Process(Path(name)) as pilot:
                waters = Waters(process, setup, Path(name), number, 1)
                found.append(calibrated(waters, 0, pilot, job.say))
    good = [one for one in found if one is not None]
    rows = []
    for place, what in enumerate(("DVL's yaw [deg]", "place [m]", "heading [deg]")):
        worst = max((one[place] for one in good), default=math.nan)
        note = f"{len(good)} of {count} found"
        rows.append(Row(f"calibration, largest error: {what}", worst, "", less_is_better=True, note=note))
    return rows


# ---- CPU of an adapter at its device's full rate, its step of the pilot's loop alone.


def _a50() -> tuple[Callable[[float], object], Instrument]:
    fake = FakeA50("127.0.0.1", 0)
    fake.PERIOD_S = 1 / 15
    instrument = A50(TcpChannel("127.0.0.1", fake.port), 0.0, 0.1, 0.05)
    return lambda now_s: fake.tell(now_s, np.array([0.3, 0.0, 0.1]), 1.0), instrument


def _ping360() -> tuple[Callable[[float], object], Instrument]:
    sonar, fake = load_config("pool", "ping360").sensors.sonar, FakePing360("127.0.0.1", 0)
    fake._step_s = lambda listening: sonar.step_us / 1e6
    channel = UdpChannel(InstrumentPlace("ping360", "127.0.0.1", fake.port), True, 2048)
    instrument = Ping360(channel, sonar, sonar.zero_gradian, sonar.min_range_m, sonar.sound_m_s)
    return lambda now_s: fake.step(now_s, lambda bearing: 3.0 + bearing), instrument


def _3d15() -> tuple[Callable[[float], object], Instrument]:
    config = load_config("pool", "3d15")
    camera = emulated(config, ("3d15",)).sensors.depth
    fake, depth_m = FakeSonar3D("127.0.0.1", _IMAGES, camera), np.full((camera.rows, camera.cols), 4.0)
    channel = UdpChannel(InstrumentPlace("3d15", "127.0.0.1", _IMAGES), False, LONGEST)
    return lambda now_s: fake.tell(now_s, depth_m), Sonar3D(channel, config)


def _json() -> tuple[Callable[[float], object], Instrument]:
    channel = UdpChannel(InstrumentPlace("json", "127.0.0.1", _IMAGES + 1), False, 65507)
    other = UdpChannel(InstrumentPlace("json", "127.0.0.1", _IMAGES + 1), True, 65507)
    said = {"kind": "sonar", "range_m": [4.123] * 256, "hit": [1] * 256, "doppler_m_s": []}
    return lambda _: other.write(json.dumps(said).encode()), JsonUdp(channel)


_IMAGES = 24747  # UDP port
ADAPTERS = {
    "A50, 15 readings a second": _a50, "Ping360, 36 profiles of 1,200 a second": _ping360,
    "3D-15, 5 images of 256 x 64 a second": _3d15, "JSON, 50 scans of 256 beams a second": _json,
}  # fmt: skip


def _adapter(name: str, job: Job) -> Row:
    tell, instrument = ADAPTERS[name]()
    seconds, spent_s, found = (5 if job.quick else 60), 0.0, 0
    for step in range(50 * seconds):
        tell(0.02 * step)
        begun_s = time.thread_time()
        found += len(instrument.poll(0.02 * step))
        spent_s += time.thread_time() - begun_s
    instrument.close()
    return Row(
        f"adapter: {name}", 100.0 * spent_s / seconds, "% of a core", less_is_better=True,
        floor=5.0, note=f"{found / seconds:.1f} readings a second",
    )  # fmt: skip


_WORK = """
import contextlib, json, sys
from uuvtai.cli import main
for line in sys.stdin:
    told = json.loads(line)
    with open(told["out"], "w") as out, contextlib.redirect_stdout(out):
        try:
            main(told["words"])
        except SystemExit as end:
            code = end.code
    print("ended", code, file=sys.stderr, flush=True)
"""


class Process(AbstractContextManager["Process"]):
    """Runs commands of uuvtai's, one after the other; what the running one says on its error stream."""

    def __init__(self, folder: Path) -> None:
        environment = os.environ | {"PYTHONPATH": str(_ROOT), "UUV_NUM_THREADS": "1", "COLUMNS": "400"}
        self.lines: list[str] = []
        self.out = folder / f"{id(self)}.json"  # what it says on its output
        self._running = subprocess.Popen(
            [sys.executable, "-c", _WORK], cwd=folder, env=environment, text=True,
            stdin=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._running.stderr is not None
        for line in self._running.stderr:
            self.lines.append(line.strip())
        self.lines.append("ended")

    def begin(self, words: list[str]) -> None:
        """A command."""
        assert self._running.stdin is not None
        self.lines = []
        self._running.stdin.write(json.dumps({"words": words, "out": str(self.out)}) + "\n")
        self._running.stdin.flush()

    @property
    def has_ended(self) -> bool:
        """Whether the command has."""
        return any(line.startswith("ended") for line in self.lines)

    def until(self, says: re.Pattern[str], count: int = 1) -> list[re.Match[str]]:
        """The first ``count`` lines that match. RuntimeError where it ends without, or after five minutes."""
        end_s = time.monotonic() + 300.0
        while True:
            has_ended = self.has_ended
            found = [match for line in list(self.lines) if (match := says.search(line))]
            if len(found) >= count:
                return found[:count]
            if has_ended or time.monotonic() > end_s:
                raise RuntimeError(f"{says.pattern}: not said: {self.lines[-5:]}")
            time.sleep(0.02)

    def __exit__(self, *_: object) -> None:
        self._running.kill()
        self._running.wait()
        self._reader.join(5)


class Link(AbstractContextManager["Link"]):
    """The autopilot between one instance of the water and one pilot."""

    def __init__(self, physics: int, pilot_port: int, pilot: Process, system: int) -> None:
        """``physics``, ``pilot_port``: UDP ports on this computer; ``system``: the vehicle's id."""
        self.autopilot, self.pilot = StandIn(("127.0.0.1", pilot_port), system), pilot
        self._to = "127.0.0.1", physics
        self._queued = re.compile(rf":{pilot_port:04X} \S+ \w+ \w+:(\w+)")
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(600.0)
        self.hurried = 0
        """how often the pilot was not waited for"""

    def advance(self) -> None:
        """A control step of the water, once the pilot has heard the last one."""
        for _ in range(RATE_HZ // LOOP_HZ):
            self._socket.sendto(self.autopilot.frame(), self._to)
            self.autopilot.take(self._socket.recv(65536))
        end_s = time.monotonic() + _PATIENCE_S
        while self._waits() and not self.pilot.has_ended:
            time.sleep(2e-4)
            if time.monotonic() > end_s:
                self.hurried += 1
                return

    def _waits(self) -> bool:
        """Whether something is in the queue of the pilot's port."""
        return any(int(waits, 16) for waits in self._queued.findall(Path("/proc/net/udp").read_text()))

    def __exit__(self, *_: object) -> None:
        self._socket.close()
        self.autopilot.close()


MOST_AT_ONCE = 20  # pilots of one water
PORTS = {
    "physics": 21002,
    "pilot": 23000,
    "a50": 16171,
    "ping360": 9092,
    "3d15": 4747,
    "json": 14700,
}  # counted on by ten
_HORIZON = 6000  # twice the usual: the pilot first turns until the walls have told where it is
_RIG = """extends: {preset}
sensors:
  localization: estimated
  sonar: {{max_range_m: {range_m}, step_overhead_s: 0.03, doppler: false}}  # a step of a Ping360 as recorded
  dvl: {{yaw_deg: {yaw_deg}, sigma_m_s: 0.005, period_steps: 6}}
camera_tracking: {{use_camera: {images}}}
height: {{use_camera: {images}}}
mapping: {{depth_hit: {depth_hit}}}
"""


@dataclass(frozen=True)
class Setup:
    """A scene with a rig."""

    kinds: str = "a50,ping360"
    """a DVL and a sonar, as for ``--as``"""
    dynamic: int = 0
    static: int = 8
    yaw_deg: float = 0.0
    range_m: float = 12.0
    """of the sonar: from anywhere in the pool an end wall is in view"""
    changes: Mapping[str, Any] = field(default_factory=dict)

    def rig(self, folder: Path) -> Path:
        """Its file for ``--sensors``."""
        path, kind = folder / "rig.yaml", self.kinds.partition(",")[2]
        preset, images = "nominal" if kind == "json" else kind, kind == "3d15"  # no other camera is emulated
        path.write_text(_RIG.format(**vars(self), preset=preset, images=images, depth_hit=0.1 * images))
        return path

    @property
    def overrides(self) -> dict[str, Any]:
        """Of the config."""
        scene = {"n_static": self.static, "n_dynamic": self.dynamic, "dynamic_speed_m_s": 0.6}
        long = {"episode.horizon_steps": _HORIZON}
        return {f"world.{name}": value for name, value in scene.items()} | long | dict(self.changes)


class Waters:
    """``uuv sitl`` with the emulators of a setup, for a few episodes."""

    def __init__(
        self, process: Process, setup: Setup, folder: Path, first: int, count: int, **ports: int
    ) -> None:
        self.setup, self.folder, self.rig, self._ports = setup, folder, setup.rig(folder), PORTS | ports
        words = ["sitl", "--world", "pool", "--sensors", str(self.rig), "--vehicle", "bluerov2_16v"]
        words += [f"--set={name}={value}" for name, value in setup.overrides.items()]
        words += ["--seed", str(SEED), "--episode", str(first), "--instances", str(count), "--operator"]
        words += [
            "--as",
            ",".join(f"{kind}:{self._ports[kind]}" for kind in setup.kinds.split(",")),
            "--json",
        ]
        words += [
            "--port",
            str(self._ports["physics"]),
            "--mavlink",
            f"udpout:127.0.0.1:{self._ports['pilot']}",
        ]
        self.process = process
        process.begin(words)
        found = self.process.until(_SAYS_START, count)
        self.places = {int(match[1]): (match[2], match[3]) for match in found}

    def pilot(self, process: Process, number: int, *more: str) -> None:
        """``uuv pilot`` for an instance, until it listens."""
        ports = {name: port + 10 * number for name, port in self._ports.items()}
        instruments = [f"{kind}:127.0.0.1:{ports[kind]}" for kind in self.setup.kinds.split(",")]
        start, goal = self.places[number]
        words = ["pilot", "--mavlink", f"udp:127.0.0.1:{ports['pilot']}", "--rate", "0", "--world", "pool"]
        words += ["--sensors", str(self.rig), "--vehicle", "bluerov2_16v"]
        words += [word for pair in zip(("--dvl", "--sonar"), instruments, strict=False) for word in pair]
        words += ["--start", start, "--goal", goal, "--heading", "0", "--battery", "0", "--json"]
        words += ["--system", str(number + 1)]
        words += ["--log", str(self.folder / f"pilot{number}.mcap"), "--force", *more]
        process.begin(words)
        process.until(re.compile("listens at"))

    def link(self, number: int, pilot: Process) -> Link:
        """The autopilot of an instance."""
        physics, pilot_port = (self._ports[name] + 10 * number for name in ("physics", "pilot"))
        return Link(physics, pilot_port, pilot, number + 1)

    def ended(self, number: int) -> str:
        """How an instance's episode ended; '' = it has not."""
        said = (_SAYS_END.search(line) for line in list(self.process.lines))
        return next((match[2] for match in said if match and int(match[1]) == number), "")


_LONGEST_EPISODE_S, _AFTER_S = 200.0, 10.0  # of the water's time; after the pilot has left


def flown(waters: Waters, pilots: SimpleQueue[Process], say: Callable[[str], None], number: int) -> str:
    """How an episode ends that ``uuv pilot --arm`` drives."""
    pilot = pilots.get()
    try:
        return _flown(waters, pilot, say, number)
    finally:
        pilots.put(pilot)


def _flown(waters: Waters, pilot: Process, say: Callable[[str], None], number: int) -> str:
    waters.pilot(pilot, number, "--arm", "--max-speed", "1")
    with waters.link(number, pilot) as link:
        left_s = _LONGEST_EPISODE_S
        while not (end := waters.ended(number)) and link.autopilot.time_s < left_s:
            link.advance()
            if pilot.has_ended:
                left_s = min(left_s, link.autopilot.time_s + _AFTER_S)
        while not pilot.has_ended:  # it gives the vehicle back
            link.advance()
            if link.autopilot.time_s > 3 * _LONGEST_EPISODE_S:
                raise RuntimeError(f"instance {number}: the pilot does not end: {pilot.lines[-1:]}")
    last = [line for line in pilot.lines if not line.startswith("ended")][-1:]
    time_s = f"{link.autopilot.time_s:.1f} s, {link.hurried} times not waited for"
    say(f"{number}: {end or 'not ended'}, {time_s}; {last}")
    return end or "not ended"


# ---- A vehicle that is driven by hand where ``uuv pilot --calibrate`` says.

_BY_THE_WALL = {"world.spawn_x_m": [15.6, 17.0], "world.spawn_y_m": [2, 4], "world.start_goal_gap_m": 0.5,
                "episode.horizon_steps": 30000}  # fmt: skip
_OFF, _HEADING_DEG, _SPEED_M_S, _TURN_RAD_S = (0.2, -0.2), 6.0, 0.35, 0.25
"""errors of what is typed [m], [deg]; how the operator drives and turns"""
_SAYS_DRIVE = re.compile(r"drive (\d) m ([a-z ]+) by hand")
_LONGEST_S_BY_HAND = 1200.0


def calibrated(
    waters: Waters, number: int, pilot: Process, say: Callable[[str], None]
) -> tuple[float, float, float] | None:
    """Errors of the DVL's yaw [deg], of the place [m] and of the heading [deg]; None: nothing was found."""
    x, y, z = (float(part) for part in waters.places[number][0].split(","))
    typed, out = f"{x + _OFF[0]:.3f},{y + _OFF[1]:.3f},{z:.3f}", waters.folder / f"found{number}.yaml"
    out.unlink(missing_ok=True)
    more = ("--start", typed, "--heading", f"{_HEADING_DEG:g}", "--set", "sensors.dvl.yaw_deg=0")
    waters.pilot(pilot, number, *more, "--calibrate", str(out))
    with waters.link(number, pilot) as link:
        left_m, way, told = 0.0, np.zeros(4), ""
        while not pilot.has_ended and link.autopilot.time_s < _LONGEST_S_BY_HAND:
            last = pilot.lines[-1] if pilot.lines else ""
            if last != told and (said := _SAYS_DRIVE.search(last)):
                angle = WAYS.index(said[2]) * math.tau / len(WAYS)
                way = _SPEED_M_S * np.array([0.0, math.cos(angle), -math.sin(angle), 0.0])
                left_m = int(said[1]) + 0.2
            told = last
            turns = _TURN_RAD_S if "turn the vehicle" in told else 0.0
            link.autopilot.is_armed = True
            link.autopilot.by_hand = way if left_m > 0 else np.array([turns, 0.0, 0.0, 0.0])
            left_m -= _SPEED_M_S / 50
            link.advance()
        say(f"{number}: {link.autopilot.time_s:.0f} s, {link.hurried} hurried; {pilot.lines[-1:]}")
    if not pilot.has_ended or not out.exists():
        return None
    found = json.loads(pilot.out.read_text())["calibration"]["found"]
    rig = yaml.safe_load(out.read_text())
    yaw = math.remainder(rig["sensors"]["dvl"]["yaw_deg"] - waters.setup.yaw_deg, 360.0)
    heading = math.remainder(rig["world"]["tank"]["heading_deg"], 360.0)
    return abs(yaw), math.dist(found["start"], link.autopilot.place), abs(heading)
