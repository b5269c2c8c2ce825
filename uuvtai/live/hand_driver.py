"""A person at the wheel, as ``measure.episodes.playing`` wants a driver: no faster than the clock, keys in,
what the vehicle knows out."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from uuvtai.learn.pilot import PilotDecision
from uuvtai.live.gamepad import Sticks
from uuvtai.live.hand_steering import HandSteering
from uuvtai.live.keyboard import Keys
from uuvtai.live.real_time import RealTime
from uuvtai.live.viewer_server import LiveError
from uuvtai.logs.topics.map_topics import map_origin
from uuvtai.sim import Sim

NAME = "human"
"""of the method in tables and logs"""
_SHOWN_HZ = 10.0


@dataclass(frozen=True)
class DriverView:
    """What the person at the wheel may know: what the vehicle has sensed, remembered and been told."""

    time_s: float
    left_s: float
    static: np.ndarray
    """(rows = y, columns = x) bool: mapped as standing"""
    dynamic: np.ndarray
    """the same of what moves"""
    origin_m: tuple[float, float]
    """x, y of the corner of the first cell"""
    cell_m: float
    position: tuple[float, float, float]
    """[m] x, y, z"""
    yaw_rad: float
    velocity: tuple[float, float, float]
    """[m/s] ahead, left, up"""
    goal: tuple[float, float, float]
    bodies: list[tuple[float, float]]
    """[m] x, y of those that the sonar follows"""
    near_m: float
    """[m] range of the nearest return of the newest scan"""
    share: float
    """of the limits that a key asks for"""
    action: tuple[float, float, float, float]


Show = Callable[[DriverView], None]


class HandDriver:
    """Steers row 0 of a simulator of one vehicle. A ``playing.Driver``."""

    risk = None
    world_model = None

    def __init__(
        self,
        sim: Sim,
        keys: Keys,
        show: Show,
        clock: RealTime,
        now: Callable[[], float] = time.perf_counter,
        sticks: Sticks | None = None,
    ) -> None:
        if sim.num_envs != 1:
            raise LiveError(f"a person drives one vehicle, not {sim.num_envs}")
        self._sim, self._keys, self._show, self._clock, self._now = sim, keys, show, clock, now
        self._sticks, self._steering = sticks, HandSteering()
        self._shown_s = -np.inf
        self._take(np.zeros(4, np.float32))

    def reset(self, rows: torch.Tensor) -> None:
        """Another episode: keys pressed before it are forgotten."""
        self._keys.pressed()
        self._steering.stop()
        self._clock.begin(self._sim, 0, None)
        self._take(np.zeros(4, np.float32))
        self._show(view_of(self._sim, self._steering.share, self.decision.action[0].numpy()))

    def decide(self, obs: torch.Tensor) -> PilotDecision:
        """What the hands ask for; asking again changes nothing."""
        return self.decision

    def advance(self) -> None:
        """A control step has been done: wait until it is over, then look at the keys."""
        self._clock.step(self._sim)
        now = self._now()
        self._steering.press(self._keys.pressed(), now)
        self._take(self._steering.action(now, self._sticks.tilted() if self._sticks else None))
        if now - self._shown_s >= 1.0 / _SHOWN_HZ:
            self._shown_s = now
            self._show(view_of(self._sim, self._steering.share, self.decision.action[0].numpy()))

    def _take(self, action: np.ndarray) -> None:
        nothing = torch.zeros(0)
        rest = (nothing,) * (len(PilotDecision._fields) - 1)
        self.decision = PilotDecision(torch.from_numpy(action)[None], *rest)


def view_of(sim: Sim, share: float, action: np.ndarray) -> DriverView:
    """Of row 0."""
    s, config = sim.s, sim.config

    def row(field: Any) -> np.ndarray:
        return sim.rows(field, [0])[0]

    static, tracks = row(s.grid_map.static_occ), s.tracks
    known = (row(tracks.alive) == 1) & (row(tracks.moving) == 1)
    step, dt = int(row(s.clock.step)), config.episode.control_dt_s
    ranges, position, velocity = row(s.scan.range_m), row(s.ego.pos_w), row(s.ego.vel_b)
    return DriverView(
        time_s=step * dt,
        left_s=(config.episode.horizon_steps - step) * dt,
        static=static >= config.mapping.occupied,
        dynamic=row(s.grid_map.dynamic_occ) >= config.mapping.occupied,
        origin_m=map_origin(config, static.shape),
        cell_m=config.mapping.cell_m,
        position=_three(position),
        yaw_rad=float(row(s.ego.rpy)[2]),
        velocity=_three(velocity),
        goal=_three(row(s.mission.goal_w)),
        bodies=[(float(x), float(y)) for x, y in row(tracks.state)[known][:, :2]],
        near_m=float(ranges.min()),
        share=share,
        action=(float(action[0]), float(action[1]), float(action[2]), float(action[3])),
    )


def _three(values: np.ndarray) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


@dataclass(frozen=True)
class HandPiece:
    """A person, before there is a simulator."""

    keys: Keys
    show: Show
    rate: float = 1.0
    sticks: Sticks | None = None

    def driver(self, sim: Sim) -> HandDriver:
        """At the wheel of this simulator."""
        clock = RealTime(sim.config.episode.control_dt_s, self.rate)
        return HandDriver(sim, self.keys, self.show, clock, sticks=self.sticks)
