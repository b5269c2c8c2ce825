"""The stack without the simulator: sensor messages in, commands with their reasons out.

    pilot = OnboardPilot.built(config, read_tree("bt"), Mission(start, goal))
    while True:                      # every control_dt_s (20 ms)
        for message in arrived:
            pilot.feed(message)
        command = pilot.tick()

It runs the stages of ``Sim`` themselves, from the pose filter to the behaviour tree's tick: the same kernels
on the same arrays, of which ``FedSensors`` fills the readings. Where nothing better can be done than to stop,
the action is zero and ``held`` says why (``StaleLimits``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from uuvtai.config import Config, SonarConfig
from uuvtai.logs.moment import numbered
from uuvtai.pilot.fed_sensors import FedSensors
from uuvtai.pilot.inbox import ANY, Inbox, Tally
from uuvtai.pilot.mission import Mission, begin_mission, step_mission
from uuvtai.pilot.sensor_messages import SensorMessage, SonarPing
from uuvtai.plan_codes import TRIGGERS
from uuvtai.sim import Sim
from uuvtai.tree import FlatTree


@dataclass(frozen=True)
class StaleLimits:
    """[s] how old the newest message of a sensor may be; beyond, the pilot stops. Infinite: it goes on.

    The DVL has none: without it the pose filter goes on by the accelerometer, and the stack knows
    (``vel_valid``) when the velocity is no longer sure. So has the camera, which only adds to the sonar.
    """

    imu: float = 0.5
    sonar: float = 1.0
    pressure: float = 2.0
    position: float = 0.5
    """where the pilot does not estimate its own"""
    dvl: float = math.inf
    depth: float = math.inf


@dataclass(frozen=True, eq=False)
class PilotCommand:
    """What one step decided."""

    step: int
    time_s: float
    action: np.ndarray
    """(4,) float32 in [-1, 1]: surge, sway, heave, yaw rate as shares of the vehicle's limits; zero = stop"""
    velocity: np.ndarray
    """(4,) the same in m/s and rad/s, body axes"""
    chosen: np.ndarray
    """(4,) the tree's own choice, which ``action`` is unless ``held``"""
    asked_w: np.ndarray
    """(3,) [m/s] velocity that the tree asks for, world"""
    leaf: str
    """node of the tree that chose, as logs name it; '' = none"""
    trigger: str
    """why the route was planned in this step, '' = it was not"""
    pos_w: np.ndarray
    """(3,) [m] where the vehicle takes itself to be"""
    held: tuple[str, ...]
    """why the pilot stops instead of doing what the tree chose; none = it does it"""


class OnboardPilot:
    """One vehicle's stack, fed from outside. On the CPU."""

    def __init__(self, sim: Sim, mission: Mission, limits: StaleLimits | None = None) -> None:
        """``sim``: its row 0 becomes the pilot's, its ``sensors`` are replaced. ValueError on a GPU, and for
        a config whose map takes the truth in (``mapping.stamp``)."""
        config = sim.config
        if sim.device.type != "cpu" or config.mapping.stamp > 0:
            raise ValueError("the pilot runs on the CPU, with a map that it makes itself (mapping.stamp 0)")
        self.config, self.mission, self.limits = config, mission, limits or StaleLimits()
        self._sim, self._begun = sim, False
        self._nodes = numbered(sim.tree.names)
        memory = sim.memory()
        camera = config.sensors.depth
        self._inbox = Inbox(_shapes(config.sensors.sonar) | {"depth.depth_m": (camera.rows, camera.cols)})
        views = memory.views(memory.read(), scratch=True)
        self._sensors = FedSensors(config, views, self._inbox)
        self._teacher = {name: views[f"teacher.{name}"] for name in ("action", "last_vel_w", "leaf")}
        self._route = {name: views[f"route.{name}"] for name in ("n_way", "plan_step", "trigger")}
        self._pos_w = views["ego.pos_w"]
        vehicle = config.vehicle
        self._top = np.array(
            [vehicle.max_surge_m_s, vehicle.max_sway_m_s, vehicle.max_heave_m_s, vehicle.max_yaw_rate_rad_s],
            np.float32,
        )

    @classmethod
    def built(
        cls, config: Config, tree: FlatTree, mission: Mission, limits: StaleLimits | None = None
    ) -> OnboardPilot:
        """A pilot with a simulator of its own; its kernels are compiled, or found compiled, at the first
        steps (``uuv warm --num-envs 1``)."""
        return cls(Sim(config, 1, tree), mission, limits)

    @property
    def tallies(self) -> dict[str, Tally]:
        """What became of the messages, by sensor."""
        return self._inbox.tallies

    def feed(self, message: SensorMessage) -> None:
        """Take a message, at any time before the ``tick`` that is to use it. TypeError, ValueError."""
        if isinstance(message, SonarPing):
            _check_beams(message, self.config.sensors.sonar)
        self._inbox.feed(message)

    def tick(self) -> PilotCommand:
        """One control step, the first one at time 0."""
        self._sim.sensors = self._sensors
        if self._begun:
            step_mission(self._sim)
        else:
            begin_mission(self._sim, self.mission)
            self._begun = True
        return self._command()

    def _command(self) -> PilotCommand:
        step, node = self._sensors.step, int(self._teacher["leaf"][0])
        chosen = self._teacher["action"][0].copy()
        held = self._reasons_to_stop(chosen)
        action = np.zeros(4, np.float32) if held else chosen
        planned = self._route["n_way"][0] > 0 and self._route["plan_step"][0] == step
        trigger = int(self._route["trigger"][0])
        return PilotCommand(
            step=step,
            time_s=step * self.config.episode.control_dt_s,
            action=action,
            velocity=action * self._top,
            chosen=chosen,
            asked_w=self._teacher["last_vel_w"][0].copy(),
            leaf=self._nodes[node] if node >= 0 else "",
            trigger=TRIGGERS[trigger - 1] if planned and trigger > 0 else "",
            pos_w=self._pos_w[0].copy(),
            held=held,
        )

    def _reasons_to_stop(self, chosen: np.ndarray) -> tuple[str, ...]:
        found = []
        for name in self._inbox.tallies:
            if name == "position" and self.config.sensors.localization == "estimated":
                continue
            age_s, limit_s = self._inbox.age_s(name, self._sensors.now_s), getattr(self.limits, name)
            if age_s > limit_s:
                found.append(f"{name}: nothing yet" if math.isinf(age_s) else f"{name}: {age_s:.2f} s old")
        if not np.isfinite(chosen).all():
            found.append("the stack's command is not finite")
        return tuple(found)


def _shapes(sonar_cfg: SonarConfig) -> dict[str, tuple[int, ...]]:
    """Of a ping's arrays."""
    beams = () if sonar_cfg.mechanical else (sonar_cfg.n_ray,)
    one_each = {f"sonar.{name}": beams or (ANY,) for name in ("range_m", "hit")}
    return one_each | {
        "sonar.doppler_m_s": (sonar_cfg.n_ray if sonar_cfg.doppler else 0,),
        "sonar.first_beam": (),
    }


def _check_beams(ping: SonarPing, sonar_cfg: SonarConfig) -> None:
    """ValueError for beams that the sonar does not have."""
    n, last = len(ping.range_m), 2 * sonar_cfg.n_ray if sonar_cfg.is_ring else sonar_cfg.n_ray
    there = 0 <= ping.first_beam < sonar_cfg.n_ray and n <= sonar_cfg.n_ray and ping.first_beam + n <= last
    if sonar_cfg.mechanical and not (there and n == len(ping.hit) > 0):
        raise ValueError(
            f"sonar: {n} ranges and {len(ping.hit)} hits from beam {ping.first_beam} on are no neighbouring "
            f"beams of {sonar_cfg.n_ray}"
        )
    if not sonar_cfg.mechanical and ping.first_beam != 0:
        raise ValueError("sonar: first_beam is for a mechanical beam (sensors.sonar.mechanical)")
