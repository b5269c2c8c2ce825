"""The frame around the stack: messages in, one step, the command and its reasons out. NumPy alone: it also
runs where there is neither Taichi nor torch (``uuvtai.vehicle.embedded``)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from uuvtai.common.enums import TRIGGERS
from uuvtai.vehicle.messages import ANY, Inbox, Mission, PilotNumbers, SensorMessage, SonarPing, Tally
from uuvtai.vehicle.sensor_inputs import FedSensors

_START = [0, 1, 2, 9, 10, 17]  # places of x, y and heading in the covariance of perception/localization.py
_X_Y = [0, 9]  # and of the variances of x and y


@dataclass(frozen=True)
class StaleLimits:
    """[s] how old the newest message of a sensor may be; beyond, the pilot stops. Infinite: it goes on.

    The DVL has none: without it the pose filter goes on by the accelerometer, and the stack knows
    (``vel_valid``) when the velocity is no longer sure. So has the camera, which only adds to the sonar, and
    who tells of dead thrusters, which most never do.
    """

    imu: float = 0.5
    sonar: float = 1.0
    pressure: float = 2.0
    position: float = 0.5  # where the pilot does not estimate its own
    dvl: float = math.inf
    depth: float = math.inf
    thruster: float = math.inf


@dataclass(frozen=True, eq=False)
class PilotCommand:
    step: int
    time_s: float
    action: np.ndarray  # (4,) float32 in [-1, 1]: surge, sway, heave, yaw rate over the limits; zero = stop
    velocity: np.ndarray  # (4,) the same in m/s and rad/s, body axes
    chosen: np.ndarray  # (4,) the tree's own choice, which ``action`` is unless ``held``
    asked_w: np.ndarray  # (3,) [m/s] velocity that the tree asks for, world
    leaf: str  # node of the tree that chose, as logs name it; '' = none
    trigger: str  # why the route was planned in this step, '' = it was not
    pos_w: np.ndarray  # (3,) [m] where the vehicle takes itself to be
    held: tuple[str, ...]  # why the pilot stops instead of doing what the tree chose; none = it does it
    place_sigma_m: float = 0.0  # standard deviation of x or y, the larger; 0 where the position is given


class StackRunner(Protocol):
    """Runs the stages behind the sensors for row 0."""

    views: dict[str, np.ndarray]  # the stages' arrays in memory, by 'struct.field'

    def begin(self, mission: Mission, sensors: FedSensors) -> None:
        """The first step: forget everything, then as ``step``."""
        ...

    def step(self, sensors: FedSensors) -> None:
        """A control step: ``sensors`` is asked for what is sensed, up to the tree's choice."""
        ...


class FedPilot:
    """One vehicle's stack, fed from outside."""

    def __init__(self, numbers: PilotNumbers, stack: StackRunner, mission: Mission) -> None:
        self.limits, self.numbers, self.stack = StaleLimits(), numbers, stack
        views = stack.views
        self.begin_again(mission)
        self._behavior = {name: views[f"behavior.{name}"] for name in ("action", "last_vel_w", "leaf")}
        self._route = {name: views[f"route.{name}"] for name in ("n_way", "plan_step", "trigger")}
        self._pos_w, self._cov = views["ego.pos_w"], views["localization.cov"]
        self._top = np.array(numbers.top, np.float32)

    def begin_again(self, mission: Mission) -> None:
        """Forget everything: the next ``tick`` is the first one, of ``mission``."""
        self.mission, self._begun = mission, False
        self._inbox = Inbox(_shapes(self.numbers))
        self.sensors = FedSensors(self.numbers, self.stack.views, self._inbox)

    @property
    def tallies(self) -> dict[str, Tally]:
        return self._inbox.tallies

    def feed(self, message: SensorMessage) -> None:
        """Take a message, at any time before the ``tick`` that is to use it. TypeError, ValueError."""
        if not isinstance(message, SonarPing) or _is_seen(message, self.numbers):
            self._inbox.feed(message)

    def tick(self) -> PilotCommand:
        """One control step, the first one at time 0."""
        if self._begun:
            self.stack.step(self.sensors)
        else:
            self.stack.begin(self.mission, self.sensors)
            self._begun = True
            if self.mission.spread and self.numbers.estimated:
                self.stack.views["localization.cov"][0, _START] = self.mission.spread
        return self._command()

    def _command(self) -> PilotCommand:
        step, node = self.sensors.step, int(self._behavior["leaf"][0])
        chosen = self._behavior["action"][0].copy()
        held = self._reasons_to_stop(chosen)
        action = np.zeros(4, np.float32) if held else chosen
        planned = self._route["n_way"][0] > 0 and self._route["plan_step"][0] == step
        trigger = int(self._route["trigger"][0])
        return PilotCommand(
            step=step,
            time_s=step * self.numbers.dt_s,
            action=action,
            velocity=action * self._top,
            chosen=chosen,
            asked_w=self._behavior["last_vel_w"][0].copy(),
            leaf=self.numbers.nodes[node] if node >= 0 else "",
            trigger=TRIGGERS[trigger - 1] if planned and trigger > 0 else "",
            pos_w=self._pos_w[0].copy(),
            held=held,
            place_sigma_m=math.sqrt(max(0.0, self._cov[0, _X_Y].max())) if self.numbers.estimated else 0.0,
        )

    def _reasons_to_stop(self, chosen: np.ndarray) -> tuple[str, ...]:
        found = []
        for name in self._inbox.tallies:
            if name == "position" and self.numbers.estimated:
                continue
            age_s, limit_s = self._inbox.age_s(name, self.sensors.now_s), getattr(self.limits, name)
            if age_s > limit_s:
                found.append(f"{name}: nothing yet" if math.isinf(age_s) else f"{name}: {age_s:.2f} s old")
        if not np.isfinite(chosen).all():
            found.append("the stack's command is not finite")
        return tuple(found)


def _shapes(numbers: PilotNumbers) -> dict[str, tuple[int, ...]]:
    """Of a ping's and an image's arrays."""
    beams = () if numbers.mechanical else (numbers.beams,)
    one_each = {f"sonar.{name}": beams or (ANY,) for name in ("range_m", "hit")}
    return one_each | {
        "sonar.doppler_m_s": (numbers.beams if numbers.doppler else 0,),
        "sonar.first_beam": (),
        "depth.depth_m": numbers.image,
    }


def _is_seen(ping: SonarPing, numbers: PilotNumbers) -> bool:
    """Whether beams lie neither beside the fan nor between. ValueError for those that the sonar has not."""
    n, is_ring = np.size(ping.range_m), numbers.circle == numbers.beams
    there = 0 <= ping.first_beam < numbers.circle and n <= numbers.beams
    there = there and (is_ring or math.floor(ping.first_beam) + n <= numbers.circle)
    if numbers.mechanical and not (there and n == np.size(ping.hit) > 0):
        raise ValueError(
            f"sonar: {n} ranges and {np.size(ping.hit)} hits from beam {ping.first_beam} on are no "
            f"beams of {numbers.beams}"
        )
    if not numbers.mechanical and ping.first_beam != 0:
        raise ValueError("sonar: first_beam is for a mechanical beam (sensors.sonar.mechanical)")
    within = ping.first_beam % 1 == 0 and (is_ring or ping.first_beam + n <= numbers.beams)
    return within or not numbers.mechanical
