"""A simulated vehicle driven by a pilot of its own, whose messages may be lost or late on the way: the loop
is closed, so that what goes wrong has its consequences."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from uuvtai.measure.replay.faults import Faults
from uuvtai.measure.replay.log_feed import Delivery
from uuvtai.outcomes import OUTCOMES, RUNNING
from uuvtai.pilot import (
    DepthShot,
    DvlReading,
    ImuReading,
    Mission,
    OnboardPilot,
    PositionFix,
    PressureReading,
    SensorMessage,
    SonarPing,
)
from uuvtai.pilot.sensor_messages import NAMES
from uuvtai.sim import Sim


class LiveFeed:
    """Messages of row 0 of a simulator, step by step, disturbed by ``faults``."""

    def __init__(self, sim: Sim, faults: Faults) -> None:
        self._sim, self._faults = sim, faults
        self._random = np.random.default_rng(faults.seed)
        self._on_the_way: list[Delivery] = []
        self._dt = sim.config.episode.control_dt_s
        self._given = sim.config.sensors.localization != "estimated"

    def due(self) -> list[SensorMessage]:
        """What the simulator has just sensed and what was late before, as far as it arrives in this step."""
        step = int(self._value("clock.step"))
        for message in self._sensed(step):
            luck, delay = self._random.random(2)
            name = NAMES[type(message)]
            dead = any(o.sensor == name and o.from_s <= message.time_s < o.to_s for o in self._faults.outages)
            if not dead and luck >= self._faults.drop:
                self._on_the_way.append(Delivery(step * self._dt + delay * self._faults.jitter_s, message))
        until = (step + 0.5) * self._dt
        ready = [arrival for arrival in self._on_the_way if arrival.time_s <= until]
        self._on_the_way = [arrival for arrival in self._on_the_way if arrival.time_s > until]
        return [arrival.message for arrival in sorted(ready, key=lambda arrival: arrival.time_s)]

    def _value(self, name: str) -> np.ndarray:
        struct, _, field = name.partition(".")
        return self._sim.rows(getattr(getattr(self._sim.s, struct), field), [0])[0]

    def _ping(self) -> SonarPing:
        """The scan, or the beams of it that a mechanical head has just taken."""
        sonar, first, count = self._sim.config.sensors.sonar, 0, self._sim.config.sensors.sonar.n_ray
        if sonar.mechanical:
            first, count = int(self._value("scan.new_from")), int(self._value("scan.new_count"))
        beams = (first + np.arange(count)) % sonar.n_ray
        range_m, hit, doppler = (
            self._value(f"scan.{name}")[beams] for name in ("range_m", "hit", "doppler_m_s")
        )
        ping_s = int(self._value("scan.ping_step")) * self._dt
        return SonarPing(ping_s, range_m, hit, doppler if sonar.doppler else doppler[:0], first)

    def _sensed(self, step: int) -> Iterator[SensorMessage]:
        now, value = step * self._dt, self._value
        yield ImuReading(now, value("ego.imu_rpy"), value("ego.rate_b"), value("ego.specific_force_b"))
        if value("ego.dvl_fresh"):
            yield DvlReading(now, value("ego.dvl_b"))
        yield PressureReading(now, float(value("ego.depth_m")))
        if self._given:
            yield PositionFix(now, value("ego.pos_w"))
        if value("scan.fresh"):
            yield self._ping()
        if value("image.fresh"):
            yield DepthShot(now, value("image.depth_m"))


def drive_by_pilot(sim: Sim, flown: Sim, seed: int, episode: int, faults: Faults) -> dict[str, int | str]:
    """Play one episode in ``sim`` (its row 0), driven by a pilot on ``flown``: how it ended, its steps, those
    in which the pilot stopped, and those in which it did something else than ``sim``'s own stack would.
    ValueError where both are the same."""
    if sim is flown:
        raise ValueError(
            "drive_by_pilot needs two simulators: one is the vehicle, the pilot thinks in the other"
        )
    one, seeds, numbers = (torch.zeros(sim.num_envs, dtype=torch.int32) for _ in range(3))
    one[0], seeds[0], numbers[0] = 1, seed, episode
    sim.sleep()
    sim.reset(one, seeds, numbers)
    start, goal = (
        sim.rows(field, [0])[0].tolist() for field in (sim.s.mission.start_w, sim.s.mission.goal_w)
    )
    mission = Mission(tuple(start), tuple(goal), seed, episode)
    pilot = OnboardPilot(flown, mission)
    feed = LiveFeed(sim, faults)
    held = other = 0
    while True:
        for message in feed.due():
            pilot.feed(message)
        command = pilot.tick()
        held += bool(command.held)
        other += not np.array_equal(command.action, sim.rows(sim.s.teacher.action, [0])[0])
        if not np.isfinite(command.action).all():
            raise RuntimeError(f"episode {episode}: a command that is not finite at step {command.step}")
        outcome = int(sim.rows(sim.s.referee.outcome, [0])[0])
        if outcome != RUNNING:
            steps = int(sim.rows(sim.s.clock.step, [0])[0])
            return {"outcome": OUTCOMES[outcome], "steps": steps, "held": held, "other": other}
        action = torch.zeros(sim.num_envs, 4)
        action[0] = torch.from_numpy(command.action)
        sim.step(action)
