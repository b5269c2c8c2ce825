"""Real ArduSub in our water: depth, velocities, restarts, three at once, and the pool driven by the stack.

ArduSub is GPL 3 and no part of this project. ``UUV_ARDUSUB`` names its binary (``waf configure --board
sitl``, ``waf sub``), ``UUV_ARDUSUB_EPISODES`` how many episodes of the pool are driven (default 20). Without
it there is nothing to measure. Everything runs by the water's clock, so that a slow machine changes nothing.
"""

from __future__ import annotations

import math
import os
import select
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from pymavlink import mavutil

from benchmarks.common import Job, Row
from benchmarks.instruments import SEED, ends_row, in_the_loop
from uuvtai.config import Config
from uuvtai.config.loader import load_config
from uuvtai.sim.behavior_tree import read_tree
from uuvtai.sim.sim import Sim
from uuvtai.vehicle.control_loop import FlightPlan, OnboardLoop
from uuvtai.vehicle.mavlink import Endpoint, LinkPlace
from uuvtai.vehicle.onboard import Mission, OnboardPilot
from uuvtai.vehicle.pilot_log import LinkLog
from uuvtai.vehicle.sitl import PLACE, PLACE_S, PLACED_S, Instance, SitlPlan, SitlPort, WaterRows

THREADS = 1
LONGEST_S = 7200
BINARY = "UUV_ARDUSUB"
RATE_HZ = 400
ALT_HOLD, GUIDED = 2, 4
PORT, SENSORS, OPERATOR = 29002, 24660, 24560
_SCENE = {
    "world.n_dynamic": 6, "world.dynamic_speed_m_s": 0.6, "sensors.sonar.period_steps": 5,
    "camera_tracking.use_camera": False, "height.use_camera": False, "mapping.depth_hit": 0.0,
}  # fmt: skip
"""as the pilot has it: scans as often as MAVLink tells them, no camera"""
PARAMETERS = Path(__file__).resolve().parent.parent / "examples/ardusub.parm"
"""beside ArduPilot's own defaults for its simulated submarine (Tools/autotest/default_params/sub.parm)"""


def measure(job: Job) -> list[Row]:
    """Rows of each thing that was tried."""
    binary = os.environ.get(BINARY, "")
    if not binary:
        return [Row("real ArduSub", None, "", note=f"not tried: {BINARY} names no binary")]
    tree = read_tree("bt")
    still = load_config("open", "multibeam", "bluerov2_16v")
    alone = Sim(still, 1, tree)
    rows = _alone(alone, binary, job)
    rows.append(_three(Sim(still, 3, tree), binary, job))
    pool = load_config("pool", "multibeam", "bluerov2_16v", overrides=_SCENE)
    count = 1 if job.quick else int(os.environ.get(f"{BINARY}_EPISODES", "20"))
    return rows + _driven(pool, Sim(pool, 1, tree), Sim(pool, 1, tree), count, binary, job)


def parameters(binary: str) -> str:
    """A parameter file: the tree's own, and ours."""
    own = Path(binary).resolve().parents[3] / "Tools/autotest/default_params/sub.parm"
    return (own.read_text() if own.exists() else "") + "\n" + PARAMETERS.read_text()


class Rig:
    """ArduSubs and their water, moved on by its clock."""

    def __init__(
        self, sim: Sim, binary: str, seed: int = SEED, episode: int = 0, pilot: int | None = None
    ) -> None:
        self.water, self._binary = WaterRows(sim, seed, episode), binary
        self._sim, count = sim, sim.num_envs
        places = [LinkPlace("127.0.0.1", SENSORS, False)]
        if pilot is not None:
            places.append(LinkPlace("127.0.0.1", pilot, True))
        plan = SitlPlan(port=PORT, instances=count, places=tuple(places))
        self.ports = [SitlPort(plan, self.new_instance(row), row) for row in range(count)]
        self._folder = tempfile.TemporaryDirectory()
        self.links = [
            mavutil.mavlink_connection(
                f"udpin:127.0.0.1:{OPERATOR + 10 * row}", source_system=255, source_component=190
            )
            for row in range(count)
        ]
        self._processes = [self._started(row) for row in range(count)]
        self.modes, self.armed = [-1] * count, [False] * count
        self.said: list[str] = []
        self._beat_s = [-math.inf] * count

    def new_instance(self, row: int) -> Instance:
        """The water of a row as if we had begun anew."""
        return Instance(self._sim.config, self.water, row)

    def _started(self, row: int) -> subprocess.Popen[bytes]:
        folder = Path(self._folder.name) / f"{row}_{time.monotonic_ns()}"
        folder.mkdir()
        (folder / "sub.parm").write_text(parameters(self._binary))
        words = [
            str(Path(self._binary).resolve()), "--model", "JSON:127.0.0.1", "--home",
            "-35.36,149.16,0,0", "--wipe", "--defaults", "sub.parm", f"-I{row}", "--sysid", str(row + 1),
            "--rate", str(RATE_HZ), "--speedup", "100",
            "--sim-port-out", str(PORT + 10 * row), "--sim-port-in", str(PORT + 500 + 10 * row),
            "--base-port", str(OPERATOR + 2200),
            "--serial0", f"udpclient:127.0.0.1:{OPERATOR + 10 * row}",
            "--serial1", f"udpclient:127.0.0.1:{self._pilot_port(row)}",
            "--serial2", f"udpclient:127.0.0.1:{SENSORS + 10 * row}",
        ]  # fmt: skip
        output = open(folder / "output.txt", "wb")  # noqa: SIM115 - as long as the process
        return subprocess.Popen(words, cwd=folder, stdout=output, stderr=subprocess.STDOUT)

    def _pilot_port(self, row: int) -> int:
        found = [link.endpoint.calls for link in self.ports[row].links if link.endpoint.calls]
        return found[0][1] if found else SENSORS + 10 * row + 5

    @property
    def time_s(self) -> float:
        """Of the first row's water."""
        return self.ports[0].instance.time_s

    def advance(
        self,
        seconds: float,
        each: Callable[[float], None] = lambda now_s: None,
        until: Callable[[], bool] = bool,
    ) -> bool:
        """Move the first row's water on; ``each`` control step; whether ``until`` ended it. RuntimeError
        where ArduSub says nothing for a minute."""
        end_s, next_s = self.time_s + seconds, self.time_s
        quiet_s = time.monotonic()
        sockets = {port.socket: port for port in self.ports}
        while self.time_s < end_s:
            ready, _, _ = select.select(list(sockets), [], [], 0.5)
            for one in ready:
                sockets[one].serve(time.monotonic())
                quiet_s = time.monotonic()
            if time.monotonic() - quiet_s > 60:
                raise RuntimeError("ArduSub has said nothing for a minute")
            if self.time_s < next_s - 1.0:  # begun anew
                end_s, next_s = self.time_s + (end_s - next_s), self.time_s
            if ready and self.time_s >= next_s:
                next_s += 0.02
                self.listen()
                each(self.time_s)
                if until():
                    return True
        return False

    def listen(self) -> None:
        """What the ArduSubs tell the operator; his heartbeat, and where they are for a minute, for a DVL does
        not tell that."""
        for row, link in enumerate(self.links):
            while (message := link.recv_match(blocking=False)) is not None:
                kind = message.get_type()
                if kind == "HEARTBEAT" and message.get_srcComponent() == 1:
                    self.modes[row], self.armed[row] = message.custom_mode, bool(message.base_mode & 128)
                elif kind == "STATUSTEXT":
                    self.said = [*self.said, message.text][-60:]
            now_s = self.ports[row].instance.time_s
            if not 0.0 <= now_s - self._beat_s[row] < PLACE_S and link.clients:
                self._beat_s[row] = now_s
                link.mav.heartbeat_send(6, 8, 0, 0, 4)
                if now_s <= PLACED_S:
                    link.mav.set_gps_global_origin_send(row + 1, *PLACE)

    def order(self, command: int, *params: float, row: int = 0) -> None:
        """A command by the operator."""
        given = [*params, *[0.0] * (7 - len(params))]
        self.links[row].mav.command_long_send(row + 1, 1, command, 0, *given)

    def take(self, mode: int, seconds: float = 20.0, row: int = 0) -> bool:
        """Arm and take a mode; whether it did."""
        asked = {"next": 0.0}

        def ask(now_s: float) -> None:
            if now_s >= asked["next"]:
                asked["next"] = now_s + 1.0
                if not self.armed[row]:
                    self.order(400, 1.0, row=row)
                if self.modes[row] != mode:
                    self.order(176, 1.0, float(mode), row=row)

        return self.advance(seconds, ask, lambda: self.armed[row] and self.modes[row] == mode)

    def velocity(self, ahead: float, turn: float) -> None:
        """Metres per second ahead and radians per second clockwise."""
        self.links[0].mav.set_position_target_local_ned_send(
            0, 1, 1, 8, 0x5C7, 0, 0, 0, ahead, 0, 0, 0, 0, 0, 0, turn
        )

    def stop(self, row: int) -> None:
        """Kill an ArduSub."""
        self._processes[row].kill()
        self._processes[row].wait()

    def start(self, row: int) -> None:
        """Start it again."""
        self._processes[row] = self._started(row)
        self.modes[row], self.armed[row] = -1, False

    def close(self) -> None:
        """End everything."""
        for row in range(len(self._processes)):
            self.stop(row)
        for port in self.ports:
            port.close()
        for link in self.links:
            link.close()
        self._folder.cleanup()


def ready(rig: Rig) -> None:
    """Until every ArduSub speaks and knows where it is. RuntimeError after a minute."""
    if not rig.advance(60.0, until=lambda: all(mode >= 0 for mode in rig.modes)):
        raise RuntimeError("no heartbeat within a minute of the water's time")
    rig.advance(20.0)


def _alone(sim: Sim, binary: str, job: Job) -> list[Row]:
    rig = Rig(sim, binary)
    rows: list[Row] = []
    try:
        ready(rig)
        took = rig.take(ALT_HOLD)
        depth = [-rig.water.motion(0, 0.0).pos_w[2]]
        rig.advance(5.0)
        rig.advance(30.0, lambda now_s: depth.append(-rig.water.motion(0, 0.0).pos_w[2]))
        off = float(np.abs(np.array(depth) - depth[0]).max())
        rows.append(
            Row(
                "ALT_HOLD for 35 s",
                off,
                "m off at most",
                less_is_better=True,
                floor=0.3,
                note=f"armed: {took}",
            )
        )
        job.say(f"ALT_HOLD: {took}, off by {off:.3f} m; {rig.said[-3:]}")
        took = rig.take(GUIDED)
        rows.append(_velocity_row(rig, "GUIDED, 0.5 m/s ahead for 60 s", 0.5, 0.0, 60.0, took))
        job.say(f"{rows[-1].what}: {rows[-1].ours}, {took}; {rig.said[-3:]}")
        rows.append(_velocity_row(rig, "GUIDED, turning by 0.3 rad/s for 20 s", 0.0, 0.3, 20.0, took))
        job.say(f"{rows[-1].what}: {rows[-1].ours}")
        rows += _restarts(rig, job)
    finally:
        rig.close()
    return rows


def _velocity_row(rig: Rig, what: str, ahead: float, turn: float, seconds: float, took: bool) -> Row:
    spoke = {"next": 0.0}
    found: list[tuple[float, float]] = []

    def each(now_s: float) -> None:
        if now_s >= spoke["next"]:
            spoke["next"] = now_s + 0.1
            rig.velocity(ahead, turn)
        vel, rate = rig.water.value("vehicle.vel_b", 0), rig.water.value("vehicle.rate_b", 0)
        found.append((float(vel[0]), -float(rate[2])))

    index, asked = (0, ahead) if ahead else (1, turn)
    rig.advance(2.0, each)
    early = found[-1][index]
    rig.advance(3.0, each)
    found.clear()
    rig.advance(seconds, each)
    mean = np.array(found).mean(axis=0)
    spread = np.array(found).std(axis=0)
    off = 100.0 * abs(float(mean[index]) - asked) / asked
    return Row(
        what, off, "% off in the mean", less_is_better=True, floor=10.0,
        note=f"mode taken: {took}; after 2 s {early:.3f}; mean {mean[index]:.3f} +- {spread[index]:.3f}",
    )  # fmt: skip


def _restarts(rig: Rig, job: Job) -> list[Row]:
    before = rig.ports[0].instance
    rig.ports[0].instance = rig.new_instance(0)
    rig.modes[0] = -1
    goes_on = rig.advance(30.0, until=lambda: rig.modes[0] >= 0) or rig.modes[0] >= 0
    counts = dict(rig.ports[0].instance.counts)
    job.say(f"we began anew: {goes_on}, {counts}, before {dict(before.counts)}")
    rig.stop(0)
    rig.start(0)
    ready(rig)
    took = rig.take(ALT_HOLD)
    resets = rig.ports[0].instance.counts["reset"]
    job.say(f"ArduSub began anew: {took}, resets {resets}")
    return [
        Row("our side restarted: ArduSub goes on", float(goes_on), "1 = yes", note=str(counts)),
        Row("ArduSub restarted: armed and in ALT_HOLD again", float(took and resets == 2), "1 = yes"),
    ]


def _three(sim: Sim, binary: str, job: Job) -> Row:
    rig = Rig(sim, binary)
    try:
        ready(rig)
        took = [rig.take(ALT_HOLD, row=row) for row in range(3)]
        rig.advance(10.0)
        ahead = [port.instance.time_s for port in rig.ports]
    finally:
        rig.close()
    job.say(f"three: {took}, seconds {ahead}")
    note = "seconds of water: " + ", ".join(f"{value:.0f}" for value in ahead)
    return Row("three instances at once, armed and in ALT_HOLD", float(sum(took)), "of 3", note=note)


def _driven(config: Config, sim: Sim, flown: Sim, count: int, binary: str, job: Job) -> list[Row]:
    found = []
    for number in range(count):
        try:
            found.append(_episode(config, sim, flown, number, binary, job))
        except RuntimeError as error:
            found.append(f"failed: {error}")
            job.say(f"episode {number}: {error}")
    ours = in_the_loop("multibeam", _SCENE, count)
    what = "pool (8, 6, 0.6), "
    return [
        ends_row(f"{what}driven by the stack through ArduSub", found),
        ends_row(f"{what}in uuv eval's loop", ours),
    ]


def _episode(config: Config, sim: Sim, flown: Sim, number: int, binary: str, job: Job) -> str:
    with tempfile.TemporaryDirectory() as folder, Endpoint(LinkPlace("127.0.0.1", 0, False)) as endpoint:
        rig = Rig(sim, binary, SEED, number, endpoint.port)
        log = LinkLog(Path(folder) / "flight.mcap", {})
        try:
            ready(rig)
            start, goal = (
                tuple(rig.water.value(f"mission.{name}", 0).tolist()) for name in ("start_w", "goal_w")
            )
            top = math.hypot(config.vehicle.max_surge_m_s, config.vehicle.max_sway_m_s)  # as the simulator
            plan = FlightPlan.typed(
                config, "udp:127.0.0.1:1", start, goal, None, (0.05, 1.55), top, 0.0,
                arms=True, heading_deg=0.0, seconds=None, rate=1.0, log=None, system=1, operator=255,
            )  # fmt: skip
            pilot = OnboardPilot(flown, Mission(start, goal, SEED, number))
            endpoint.receive()
            loop, begun = OnboardLoop(config, pilot, plan, endpoint, log), rig.time_s
            rig.advance(
                90.0,
                lambda now_s: loop.step(now_s - begun) and None,
                lambda: bool(rig.ports[0].instance.outcome),
            )
        finally:
            rig.close()
            log.close()
    instance = rig.ports[0].instance
    found = instance.outcome or "not ended"
    done = loop.document()
    job.say(
        f"episode {number}: {found} after {instance.driven_s:.1f} s, {done['driven_in']}, {done['actions']}, "
        f"{done['reasons']}, {done['ended']}, {rig.said[-2:]}"
    )
    return found
