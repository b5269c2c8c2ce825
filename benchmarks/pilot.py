"""``uuv pilot --arm`` as a process of its own against a test vehicle: signals at random moments; and flights
with random faults. What the vehicle is told after that is looked at from its side.
"""

from __future__ import annotations

import json
import math
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mav

from benchmarks.common import Job, Row
from tests.flights import moves, orders, violations
from tests.mavlink_vehicle import FakeSub, free_port
from uuvtai.logs.reader import read_messages

LONGEST_S = 7200
_ROOT = Path(__file__).resolve().parent.parent
_SEED = 20261127
_NUMBERS, _AT_ONCE = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP), 2
_SIGNALS, _FLIGHTS, _FIRST_FLIGHT = 100, 500, 1000
"""flights of the gate have lower numbers"""
_LEAVE_S, _LONGEST_FLIGHT_S = 0.5, 25.0
"""until the first stop; of a flight before its signal"""
_TANK_M, _START, _GOAL = (20.0, 6.0), (2.0, 3.0, -0.8), (18.0, 3.0, -0.8)


def measure(job: Job) -> list[Row]:
    """Violations; each is shown as it is found."""
    for number in _NUMBERS:  # a job in the background ignores some, and so would its children
        signal.signal(number, signal.SIG_DFL)
    return [*signalled(job), flown(job)]


class SwimmingSub(FakeSub):
    """Swims as it is told, level and straight ahead, and sees the tank's walls."""

    def __init__(self, port: int) -> None:
        super().__init__(port)
        self.place, self.velocity = np.array(_START[:2]), np.zeros(2)

    def speak(self, dt: float = 0.02) -> None:
        """One step by its own clock."""
        asked = [m for m in self.told[-8:] if m.get_type() == "SET_POSITION_TARGET_LOCAL_NED"]
        wanted = np.array([asked[-1].vx, -asked[-1].vy]) if asked and self.mode == 4 else np.zeros(2)
        self.velocity += (wanted - self.velocity) * min(1.0, 2.0 * dt)
        self.place += dt * self.velocity
        super().speak(dt)

    def emit(self, name: str, message: Any, link: Any) -> None:
        """As it moves and sees."""
        if name == "VISION_POSITION_DELTA":
            message.position_delta = [0.02 * self.velocity[0], -0.02 * self.velocity[1], 0.0]
        elif name == "OBSTACLE_DISTANCE":
            message.distances = self.walls_cm()
        self.send(message, link)

    def walls_cm(self) -> list[int]:
        """72 sectors of 130 degrees, clockwise."""
        turn = np.radians(65 - 65 / 72 - 130 / 72 * np.arange(72))
        way = np.stack([np.cos(turn), np.sin(turn)], 1)
        with np.errstate(divide="ignore"):
            far = np.where(way > 0, (np.array(_TANK_M) - self.place) / way, -self.place / way)
        return np.clip(np.rint(100 * far.min(1)), 20, 3000).astype(int).tolist()


def signalled(job: Job) -> list[Row]:
    """SIGINT, SIGTERM and SIGHUP in turn, each in a process of its own."""
    luck, count = random.Random(_SEED), 3 if job.quick else _SIGNALS
    tries = [(_NUMBERS[i % 3], luck.uniform(0.0, _LONGEST_FLIGHT_S)) for i in range(count)]
    with ThreadPoolExecutor(_AT_ONCE) as threads:
        ends = list(threads.map(lambda given: _signalled(*given), tries))
    wrong = [
        f"{tries[i][0].name} after {tries[i][1]:.1f} s: {text}" for i in range(count) for text in ends[i][0]
    ]
    for text in wrong:
        job.say(f"VIOLATION {text}")
    waits = [wait_s for _, wait_s, drove in ends if drove]
    slowest = max(waits, default=math.nan)
    return [
        Row(
            f"{count} signals: orders other than stop and mode, halves, other exit codes", len(wrong),
            "violations", less_is_better=True, floor=0, details={"violations": wrong, "seed": _SEED},
        ),
        Row("of them while it was driven", len(waits), f"of {count}"),
        Row("from the signal to the first stop, longest", slowest, "s", less_is_better=True, floor=_LEAVE_S),
    ]  # fmt: skip


def _signalled(number: signal.Signals, after_s: float) -> tuple[list[str], float, bool]:
    with tempfile.TemporaryDirectory() as folder:
        return _ended(Path(folder), number, after_s)


def _ended(folder: Path, number: signal.Signals, after_s: float) -> tuple[list[str], float, bool]:
    """(what was wrong, seconds to the first stop, whether the vehicle was driven) of one process; the signal
    comes ``after_s`` seconds after its port is open."""
    port, log = free_port(), folder / "flight/flight.mcap"
    out, err = folder / "out", folder / "err"  # no pipes: a process that it began may hold them longer
    child = subprocess.Popen(
        [
            *(sys.executable, "-m", "uuvtai", "pilot", "--arm", "--json", "--log", str(log)),
            *("--mavlink", f"udp:127.0.0.1:{port}", "--heading", "0", "--sensors", "multibeam"),
            *("--start", ",".join(map(str, _START)), "--goal", ",".join(map(str, _GOAL))),
            *("--set", "sensors.localization=estimated"),
        ],
        env=os.environ | {"PYTHONPATH": str(_ROOT), "PYTHONFAULTHANDLER": "1"},
        stdout=out.open("w"),
        stderr=err.open("w"),
        text=True,
    )
    sub = SwimmingSub(port)
    lock, over = threading.Lock(), threading.Event()

    def live() -> None:
        begun, step = time.monotonic(), 0
        while not over.is_set():
            with lock:
                sub.speak()
                sub.listen()
            step += 1
            time.sleep(max(0.0, begun + 0.02 * step - time.monotonic()))

    vehicle = threading.Thread(target=live)
    vehicle.start()
    try:
        while child.poll() is None and not _is_open(port):
            time.sleep(0.01)
        time.sleep(after_s)
        with lock:
            before, drove = len(sub.told), any(map(moves, sub.told))
            asked = any(map(orders, sub.told))
            sent_s = time.monotonic()
            child.send_signal(number)
        wait_s = _first_stop_s(sub, before, sent_s) if drove else 0.0
        _wait(child)
        time.sleep(0.3)
    finally:
        over.set()
        vehicle.join()
        sub.close()
        child.kill()
    after = [message for message in sub.told[before:] if orders(message)]
    found = _wrong(after, asked, sub)
    return found + _not_whole(log, out.read_text(), err.read_text(), child.returncode, number), wait_s, drove


def _wait(child: subprocess.Popen[str]) -> None:
    """Until it ends; one that does not says where it hangs."""
    try:
        child.wait(60)
    except subprocess.TimeoutExpired:
        child.send_signal(signal.SIGABRT)
        child.wait()


def _first_stop_s(sub: FakeSub, told: int, sent_s: float) -> float:
    while time.monotonic() - sent_s < 5.0:
        if any(orders(m) and not moves(m) for m in list(sub.told[told:])):
            return time.monotonic() - sent_s
        time.sleep(0.005)
    return math.inf


def _wrong(after: list[Any], asked: bool, sub: FakeSub) -> list[str]:
    """``after``: orders after the signal. One that was on its way may come first."""
    first = next((i for i, message in enumerate(after) if not moves(message)), len(after))
    rest, found = after[first:], []
    if first > 1 or any(map(moves, rest)):
        found.append(f"moved after the signal {sum(map(moves, after))} times")
    kinds = [message.get_type() for message in rest]
    if asked and sub.mode != 2:
        found.append(f"left in mode {sub.mode}, told {kinds}")
    if asked and kinds[:2] != ["SET_POSITION_TARGET_LOCAL_NED", "COMMAND_LONG"]:
        found.append(f"told {kinds[:4]} and not to stop and hand back")
    commands = [m for m in rest if m.get_type() == "COMMAND_LONG"]
    if any((m.command, m.param2) != (mav.MAV_CMD_DO_SET_MODE, 2.0) for m in commands):
        found.append(f"commanded {[(m.command, m.param2) for m in commands]}")
    return found


def _not_whole(log: Path, out: str, err: str, code: int, number: int) -> list[str]:
    found = [] if code == 128 + number else [f"exit code {code}: {err[-2000:]}"]
    if "Traceback" in err or "a bug of ours" in err:
        found.append(err[-600:])
    parts = [path.name for path in log.parent.glob("*") if path != log]
    found += [f"left {parts}"] if parts else []
    if log.exists():
        try:
            json.loads(out)
            assert any(True for _ in read_messages(log, ("/pilot/safety",))) or "interrupted" in out
        except Exception as error:
            found.append(f"log or result: {error!r}")
    return found


def _is_open(port: int) -> bool:
    """Whether somebody listens at this UDP port (Linux)."""
    rows = Path("/proc/net/udp").read_text().splitlines()[1:]
    return any(int(row.split()[1].rpartition(":")[2], 16) == port for row in rows)


def flown(job: Job) -> Row:
    """Flights with one to three random faults."""
    count, wrong = 5 if job.quick else _FLIGHTS, []
    for seed in range(_FIRST_FLIGHT, _FIRST_FLIGHT + count):
        found = violations(seed)
        for text in found:
            job.say(f"VIOLATION {text}")
        wrong += found
    return Row(
        f"{count} flights with faults: orders beyond limits, while held, by old values, against the operator",
        len(wrong), "violations", less_is_better=True, floor=0, details={"violations": wrong},
    )  # fmt: skip
