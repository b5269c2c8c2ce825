"""The closed loop over the real interfaces (pool, S = 8, D = 6, v = 0.6 m/s, sensing `multibeam`).

Our water by ArduSub's JSON packets, sensors and orders by MAVLink over UDP, the stack by ``uuv pilot``'s own
loop; in the place of ArduSub an autopilot of a hundred lines that knows its motion exactly. Beside it the
same episodes in ``uuv eval``'s loop. Everything runs in one process, by the water's clock.
"""

from __future__ import annotations

import socket
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import torch

from benchmarks.common import Job, Row
from benchmarks.peers.stand_in_autopilot import StandIn
from uuvtai.common.enums import OUTCOMES, RUNNING
from uuvtai.common.statistics import wilson_interval
from uuvtai.config import Config
from uuvtai.config.loader import load_config
from uuvtai.sim.behavior_tree import read_tree
from uuvtai.sim.sim import Sim
from uuvtai.vehicle.control_loop import FlightPlan, OnboardLoop
from uuvtai.vehicle.mavlink import Endpoint, LinkPlace, MavCodec, Order
from uuvtai.vehicle.onboard import Mission, OnboardPilot
from uuvtai.vehicle.pilot_log import LinkLog
from uuvtai.vehicle.sitl import Instance, WaterRows

THREADS = 1
LONGEST_S = 3600
SEED = 77001
EPISODES = 60
_LONGEST_EPISODE_S = 70.0
_CHANGES = {"world.n_dynamic": 6, "world.dynamic_speed_m_s": 0.6}


def measure(job: Job) -> list[Row]:
    """Two rows: by the interfaces, and as ``uuv eval`` runs."""
    config = load_config("pool", "multibeam", "bluerov2_16v", overrides=_CHANGES)
    tree, count = read_tree("bt"), 2 if job.quick else EPISODES
    water, flown = Sim(config, 1, tree), Sim(config, 1, tree)
    ends = {
        "by JSON and MAVLink": [_flown(config, water, flown, number, job.say) for number in range(count)],
        "in the simulator's own loop": [simulated(water, number) for number in range(count)],
    }
    return [ends_row(f"closed loop, {name}", found) for name, found in ends.items()]


def ends_row(what: str, found: list[str]) -> Row:
    """How many episodes were a success, and how the others ended."""
    count, ends = len(found), Counter(found)
    low, high = wilson_interval(ends["success"], count) or (0.0, 1.0)
    others = ", ".join(f"{end} {n}" for end, n in sorted(ends.items()) if end != "success") or "none"
    return Row(
        what,
        100.0 * ends["success"] / count,
        "% of the episodes a success",
        note=f"{ends['success']} of {count} [{100 * low:.1f}, {100 * high:.1f}]; others: {others}",
        details={"endings": found, "seed": SEED},
    )


class Wire:
    """Sensors beside the autopilot, to the pilot by UDP."""

    def __init__(self, pilot: tuple[str, int]) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._codec, self._pilot = MavCodec(1, 197), pilot

    def say(self, orders: list[Order]) -> None:
        """Messages of one step."""
        for order in orders:
            self._socket.sendto(self._codec.encode(order), self._pilot)
            self._codec.sent(order)

    def close(self) -> None:
        """Let go of the socket."""
        self._socket.close()


def _flown(config: Config, water_sim: Sim, flown: Sim, number: int, say: Callable[[str], None]) -> str:
    """How one episode ends by the interfaces."""
    water = WaterRows(water_sim, SEED, number)
    water.begin(0)
    start, goal = (tuple(water.value(f"mission.{name}", 0).tolist()) for name in ("start_w", "goal_w"))
    instance = Instance(config, water, 0)
    plan = FlightPlan.typed(
        config, "udp:127.0.0.1:1", start, goal, None, (0.05, 1.55), config.vehicle.max_surge_m_s, 0.0,
        arms=True, heading_deg=0.0, seconds=None, rate=1.0, log=None, system=1, operator=255,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder, Endpoint(LinkPlace("127.0.0.1", 0, False)) as endpoint:
        address = ("127.0.0.1", endpoint.port)
        autopilot, wire = StandIn(address), Wire(address)
        log = LinkLog(Path(folder) / "flight.mcap", {})
        mission = Mission(start, goal, SEED, number)
        loop = OnboardLoop(config, OnboardPilot(flown, mission), plan, endpoint, log)
        try:
            _until_it_ends(instance, autopilot, wire, loop)
        finally:
            autopilot.close()
            wire.close()
            log.close()
    found = instance.outcome or "not ended"
    held = loop.tally.actions["HOLD"]
    why = ", ".join(f"{name} {count}" for name, count in loop.tally.reasons.items())
    say(f"episode {number}: {found} after {instance.driven_s:.1f} s, held in {held} steps ({why})")
    return found


def _until_it_ends(instance: Instance, autopilot: StandIn, wire: Wire, loop: OnboardLoop) -> None:
    step, now_s = 0, 0.0
    while not instance.outcome and instance.time_s < _LONGEST_EPISODE_S:
        now_s += 1.0
        answer, said = instance.answer(autopilot.frame(), now_s)
        wire.say(said)
        autopilot.take(answer)
        while 0.02 * step <= instance.time_s:
            loop.step(instance.time_s)
            step += 1


def simulated(sim: Sim, number: int) -> str:
    """How the same episode ends where the stack drives by the simulator's own velocity loop."""
    one, seeds, numbers = (torch.ones(sim.num_envs, dtype=torch.int32) for _ in range(3))
    sim.sleep()
    sim.reset(one, SEED * seeds, number * numbers)
    while (outcome := int(sim.rows(sim.s.termination.outcome, [0])[0])) == RUNNING:
        sim.step()
    return OUTCOMES[outcome]
