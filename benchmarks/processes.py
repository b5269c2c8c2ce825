"""``uuv sitl`` and ``uuv pilot`` as two processes, typed as a user types them, by the clock. Between them, in
the place of ArduSub, the autopilot of a hundred lines. Pool, S = 8, D = 6, v = 0.6 m/s, sensing `multibeam`.

The water and the pilot run at a share of the clock's pace, so that a busy machine is not what is measured.
"""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from benchmarks.common import Job, Row
from benchmarks.peers.stand_in_autopilot import StandIn
from uuvtai.loader import load_config
from uuvtai.sim import Sim
from uuvtai.sitl.rows_of_water import WaterRows
from uuvtai.tree import read_tree

THREADS = 1
LONGEST_S = 3600
SEED = 77001
EPISODES = 5
PACE = 0.25
PORT, PILOT = 29602, 24760
_SCENE = ["--world", "pool", "--sensors", "multibeam", "--vehicle", "bluerov2_16v"]
_LONGEST_S = 600.0


def measure(job: Job) -> list[Row]:
    """One row: how the episodes ended, as the referee in the water's process saw it."""
    changes = {"world.n_dynamic": 6, "world.dynamic_speed_m_s": 0.6}
    config = load_config("pool", "multibeam", "bluerov2_16v", overrides=changes)
    sim, ends = Sim(config, 1, read_tree("bt")), []
    for number in range(1 if job.quick else EPISODES):
        water = WaterRows(sim, SEED, number)
        water.begin(0)
        start, goal = (water.value(f"mission.{name}", 0).tolist() for name in ("start_w", "goal_w"))
        with tempfile.TemporaryDirectory() as folder:
            served, flown = _played(number, start, goal, Path(folder))
        (instance,) = served["instances"]
        ends.append(instance["outcome"])
        job.say(
            f"episode {number}: {ends[-1]} after {instance['driven_s']:.1f} s; pilot: {flown.get('ended')}, "
            f"{flown.get('actions')}, {flown.get('reasons')}"
        )
    counted = ", ".join(f"{end} {n}" for end, n in sorted(Counter(ends).items()))
    return [
        Row(
            "uuv sitl and uuv pilot as two processes",
            100.0 * ends.count("success") / len(ends),
            "% of the episodes a success",
            note=f"{len(ends)} episodes: {counted}",
            details={"endings": ends, "seed": SEED, "pace": PACE},
        )
    ]


def _played(
    number: int, start: list[float], goal: list[float], folder: Path
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The documents of both commands."""
    uuv = [sys.executable, "-m", "uuvtai"]
    episode = ["--seed", str(SEED), "--episode", str(number), "-S", "8", "-D", "6", "-v", "0.6"]
    link = ["--port", str(PORT), "--mavlink", f"udpout:127.0.0.1:{PILOT}"]
    places = ["--start", ",".join(map(str, start)), "--goal", ",".join(map(str, goal))]
    told = ["--mavlink", f"udp:127.0.0.1:{PILOT}", *places, "--depth", "0.05,1.55", "--heading", "0"]
    pace = ["--rate", str(PACE), "--json"]
    water = _begun([*uuv, "sitl", *_SCENE, *episode, *link, "--once", *pace], folder / "sitl")
    log = ["--log", str(folder / "flight.mcap")]
    armed = ["--max-speed", "0.6", "--arm"]
    pilot = _begun([*uuv, "pilot", *_SCENE, *told, *armed, *pace, *log], folder / "pilot")
    autopilot = StandIn(("127.0.0.1", PILOT))
    try:
        _between(autopilot, water, pilot)
        water.wait(60)
        time.sleep(5.0)
        pilot.send_signal(2)
        pilot.wait(60)
    finally:
        autopilot.close()
        for process in (water, pilot):
            process.kill()
    return _document(folder / "sitl"), _document(folder / "pilot")


def _begun(words: list[str], out: Path) -> subprocess.Popen[bytes]:
    with out.open("wb") as standard, out.with_suffix(".err").open("wb") as errors:
        return subprocess.Popen(words, stdout=standard, stderr=errors)


def _between(autopilot: StandIn, water: subprocess.Popen[bytes], pilot: subprocess.Popen[bytes]) -> None:
    """Be driven until the water's process has ended. RuntimeError where it does not."""
    ends = time.monotonic() + _LONGEST_S
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as physics:
        physics.settimeout(1.0)
        while water.poll() is None:
            if time.monotonic() > ends or pilot.poll() not in (None, 0):
                raise RuntimeError("the water's process has not ended, or the pilot's has")
            packet = autopilot.frame()
            answer = b""
            while not answer and water.poll() is None:
                physics.sendto(packet, ("127.0.0.1", PORT))
                try:
                    answer = physics.recv(4096)
                except OSError:
                    continue
            if answer:
                autopilot.take(answer)


def _document(path: Path) -> dict[str, Any]:
    text = path.read_text()
    if not text.strip():
        raise RuntimeError(f"{path.name} said nothing: {path.with_suffix('.err').read_text()[-400:]}")
    return json.loads(text)
