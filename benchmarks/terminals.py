"""``uuv sitl``, real ArduSub and ``uuv pilot`` as three processes, by the commands of docs/sitl.md.

The pool (8, 6, 0.6) with sensing `multibeam`, beside the same episodes in ``uuv eval``'s loop; then each of
the three is killed on the way. ``UUV_ARDUSUB`` names ArduSub's binary, ``UUV_ARDUSUB_EPISODES`` how many
episodes are driven (default 6). Without it there is nothing to measure. The pilot follows the vehicle's
clock, so that a slow machine changes nothing; the water goes at half the clock's pace (``--rate 0.5``).
"""

from __future__ import annotations

import json
import math
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.ardusub import BINARY, PARAMETERS, pool_row
from benchmarks.closed_loop import SEED, simulated
from benchmarks.common import Job, Row
from uuvtai.link.dialect import MavCodec
from uuvtai.loader import load_config
from uuvtai.sim import Sim
from uuvtai.tree import read_tree

THREADS = 1
LONGEST_S = 7200
PHYSICS, SENSORS, PILOT = 31002, 31660, 31550
_READY_S, _LONGEST_S = 180.0, 400.0
"""by our clock: until the water waits, and until an episode has ended"""
_NEEDS = re.compile(r"uuv pilot needs (.*)")


def measure(job: Job) -> list[Row]:
    """Rows of the episodes, then of what happens when one of the three is killed."""
    binary = os.environ.get(BINARY, "")
    if not binary:
        return [Row("three processes", None, "", note=f"not tried: {BINARY} names no binary")]
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in a shell's background
    count = 1 if job.quick else int(os.environ.get(f"{BINARY}_EPISODES", "6"))
    ends = []
    for number in range(count):
        with Terminals(binary, number) as three:
            found, ended = three.driven()
            ends.append(found)
            job.say(f"episode {number}: {found}; the pilot: {ended}")
    changes = {"world.n_dynamic": 6, "world.dynamic_speed_m_s": 0.6}
    sim = Sim(load_config("pool", "multibeam", "bluerov2_16v", overrides=changes), 1, read_tree("bt"))
    ours = [simulated(sim, number) for number in range(count)]
    rows = [pool_row("three processes", ends), pool_row("in uuv eval's loop", ours)]
    return rows if job.quick else rows + [_killed(binary, job, *case) for case in _CASES]


class Terminals:
    """The three processes of one episode, as they are typed. Use as a context."""

    def __init__(self, binary: str, number: int) -> None:
        self._binary, self._number = Path(binary).resolve(), number
        self._folder = tempfile.TemporaryDirectory()
        self.folder = Path(self._folder.name)
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self._needs = ""

    def __enter__(self) -> Terminals:
        self.start("sitl")
        self._needs = _NEEDS.search(self.until("sitl", "uuv pilot needs"))[1]  # type: ignore[index]
        self.start("ardusub")
        self.start("pilot")
        return self

    def __exit__(self, *_: object) -> None:
        for name in self.processes:
            self.kill(name)
        self._folder.cleanup()

    def start(self, name: str) -> None:
        """Type it."""
        uuv, tree = f"{sys.executable} -m uuvtai", self._binary.parents[3]
        typed = {
            "sitl": f"{uuv} sitl --world pool -S 8 -D 6 -v 0.6 --seed {SEED} --episode {self._number} "
            f"--operator --once --rate 0.5 --json --port {PHYSICS} --mavlink udp:127.0.0.1:{SENSORS} "
            f"--mavlink udpout:127.0.0.1:{PILOT}",
            "ardusub": f"{self._binary} --model JSON:127.0.0.1 --home -35.36,149.16,0,0 --rate 400 -I0 "
            f"--wipe --defaults {tree}/Tools/autotest/default_params/sub.parm,{PARAMETERS} "
            f"--serial1 udpclient:127.0.0.1:{PILOT} --serial2 udpclient:127.0.0.1:{SENSORS} "
            f"--sim-port-out {PHYSICS} --sim-port-in {PHYSICS + 500} "
            f"--serial0 udpclient:127.0.0.1:{PHYSICS + 9}",
            "pilot": f"{uuv} pilot --mavlink udp:127.0.0.1:{PILOT} --vehicle bluerov2_16v --rate 0 "
            f"--depth 0.05,1.55 --max-speed 1 {self._needs} --arm --json --log {self.folder}/flight.mcap",
        }
        words = shlex.split(typed[name])
        folder = self.folder / f"{name}_{time.monotonic_ns()}"
        folder.mkdir()
        link = self.folder / name
        link.unlink(missing_ok=True)
        link.symlink_to(folder)
        with open(folder / "out.txt", "wb") as out, open(folder / "err.txt", "wb") as err:
            root = str(Path(__file__).resolve().parent.parent)
            environment = {**os.environ, "PYTHONPATH": root}
            self.processes[name] = subprocess.Popen(
                words, cwd=folder, stdout=out, stderr=err, env=environment, start_new_session=True
            )

    def said(self, name: str) -> str:
        """What it wrote on stderr so far."""
        return (self.folder / name / "err.txt").read_text(errors="replace")

    def until(self, name: str, text: str, seconds: float = _READY_S) -> str:
        """Wait until it says so; all that it said. RuntimeError where it does not, or ends."""
        self.wait(lambda: text in self.said(name), seconds, name)
        return self.said(name)

    def wait(self, done: Callable[[], bool], seconds: float, name: str) -> None:
        """Wait until something is so. RuntimeError where it does not come, or the process ends before."""
        until_s = time.monotonic() + seconds
        while not done():
            if time.monotonic() > until_s or self.processes[name].poll() is not None:
                raise RuntimeError(f"{name} stopped short: {self.said(name)[-500:]}")
            time.sleep(0.1)

    def ended(self, name: str, seconds: float = _LONGEST_S) -> tuple[int | None, dict[str, Any]]:
        """(exit code, document) of a command that ends by itself; (None, ..) where it did not."""
        try:
            code = self.processes[name].wait(seconds)
        except subprocess.TimeoutExpired:
            return None, {}
        text = (self.folder / name / "out.txt").read_text()
        return code, json.loads(text) if text.strip() else {}

    def driven(self) -> tuple[str, str]:
        """(how the episode ended, how the pilot ended)."""
        _, flight = self.ended("pilot")
        code, water = self.ended("sitl", 60.0)
        if code is None:  # no end yet, as the referee sees it
            self.processes["sitl"].send_signal(signal.SIGINT)
            code, water = self.ended("sitl", 30.0)
        ended = flight.get("ended", f"nothing: {self.said('pilot')[-300:]}")
        if not water:
            return "failed", f"{ended}; the water, exit code {code}: {self.said('sitl')[-600:]}"
        return water["instances"][0]["outcome"], ended

    def kill(self, name: str) -> None:
        """As a crash does."""
        self.processes[name].kill()
        self.processes[name].wait()

    def on_the_way(self) -> None:
        """Wait until the pilot drives, and a little more."""
        self.until("pilot", "\ndrives", _LONGEST_S)
        time.sleep(6.0)


class Listener:
    """What the DVL says, for whoever asks."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(5.0)
        self._codec = MavCodec(250, 1)

    def speed(self) -> float:
        """[m/s] over ground, of the next reading. TimeoutError where none comes."""
        self._socket.sendto(b"\0", ("127.0.0.1", SENSORS))
        while True:
            for message in self._codec.decode(self._socket.recv(2048)):
                if message.name == "VISION_POSITION_DELTA":
                    fields = message.fields
                    return math.hypot(*fields["position_delta"]) / fields["time_delta_usec"] * 1e6

    def close(self) -> None:
        """Let go of the port."""
        self._socket.close()


def _killed_pilot(three: Terminals) -> tuple[bool, str]:
    listener = Listener()
    try:
        before = max(listener.speed() for _ in range(10))
        three.kill("pilot")
        begun, after = time.monotonic(), math.inf
        while time.monotonic() - begun < 15.0:
            after = listener.speed()
        return before > 0.2 > after, f"{before:.2f} m/s before, {after:.2f} m/s seven seconds of water later"
    finally:
        listener.close()


def _killed_water(three: Terminals) -> tuple[bool, str]:
    three.kill("sitl")
    three.start("sitl")
    code, flight = three.ended("pilot")
    three.until("sitl", "nobody operates it")
    return code == 3, f"the pilot: {flight.get('ended')}; the water says that nobody operates ArduSub"


def _killed_ardusub(three: Terminals) -> tuple[bool, str]:
    three.kill("ardusub")
    three.start("ardusub")
    code, flight = three.ended("pilot")
    return code == 3, f"the pilot: {flight.get('ended')}"


_CASES: tuple[tuple[str, Callable[[Terminals], tuple[bool, str]]], ...] = (
    ("the pilot killed on the way: the vehicle stops", _killed_pilot),
    ("the water killed on the way, and begun anew: the pilot ends safely", _killed_water),
    ("ArduSub killed on the way, and begun anew: the pilot ends safely", _killed_ardusub),
)


def _killed(binary: str, job: Job, what: str, case: Callable[[Terminals], tuple[bool, str]]) -> Row:
    try:
        with Terminals(binary, 0) as three:
            three.on_the_way()
            held, note = case(three)
    except (RuntimeError, TimeoutError) as error:
        held, note = False, str(error)
    job.say(f"{what}: {held}; {note}")
    return Row(what, float(held), "1 = yes", note=note)
