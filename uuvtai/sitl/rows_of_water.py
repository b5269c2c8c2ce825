"""Rows of a simulator that move one at a time, each at the pace of the ArduSub that drives it."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from uuvtai.kernels.task import episode
from uuvtai.kernels.vehicle import actuation, dynamics
from uuvtai.kernels.world import scenarios
from uuvtai.link.motors import Motors
from uuvtai.outcomes import OUTCOMES, RUNNING
from uuvtai.sensing import forget_readings
from uuvtai.sim import Sim
from uuvtai.sitl.fdm_reply import Motion


class WaterRows:
    """The vehicles of several instances. Row i plays episode ``first + i`` of ``seed``."""

    def __init__(self, sim: Sim, seed: int, first: int) -> None:
        """SettingError for a vehicle that is none of ArduSub's frames."""
        self.config, self.motors = sim.config, Motors(sim.config.vehicle)
        self._sim, self._seed, self._first = sim, seed, first
        self._dt_s = 0.0
        """one object for as long as it stays: kernels are launched again by the identity of what they take"""
        memory = self._sim.memory()
        views = memory.views(memory.read(), scratch=True)
        self._awake, self._active = views["clock.awake"], views["clock.active"]
        self._rpm = views["actuation.rpm_command"]
        names = ("pos_w", "vel_b", "quat_wb", "rate_b", "acc_b")
        self._vehicle = {name: views[f"vehicle.{name}"] for name in names}
        self._read = views
        self._sim.sleep()

    def warm(self) -> None:
        """Have all kernels compiled before anybody waits for an answer."""
        self.begin(0)
        self.push(0, (1500,) * 16, 1e-3)
        self.control_step(0)

    def begin(self, row: int) -> None:
        """The row's episode from its beginning: vehicle at rest at the start."""
        one, seeds, numbers = (torch.zeros(self._sim.num_envs, dtype=torch.int32) for _ in range(3))
        one[row], seeds[row], numbers[row] = 1, self._seed, self._first + row
        io = self._sim.io
        self._sim.draw(one, seeds, numbers)
        dynamics.reset_vehicle(io.dynamics)
        actuation.reset_actuation(io.actuation)
        forget_readings(io)
        episode.reset_referee(io.episode)
        self.sense(row)

    def push(self, row: int, pwm: tuple[int, ...], dt_s: float) -> None:
        """Move the vehicle by one step of ``dt_s`` with these pulses."""
        self._wake(row)
        rpm = self.motors.rpm(pwm)
        self._rpm[row, : len(rpm)] = rpm
        if dt_s != self._dt_s:
            self._dt_s = dt_s
        dynamics.move_vehicle(self._sim.io.dynamics, self._dt_s, 1)

    def control_step(self, row: int) -> str:
        """The world moves on by a control step and the referee looks; how the episode stands."""
        self._wake(row)
        io = self._sim.io
        episode.advance_clock(io.episode)
        scenarios.move_obstacles(io.world)
        episode.judge(io.episode)
        outcome = int(self._read["referee.outcome"][row])
        return "" if outcome == RUNNING else OUTCOMES[outcome]

    def sense(self, row: int) -> None:
        """Instruments and sonar by the simulator's own kernels, with errors as configured."""
        self._wake(row)
        self._sim.sensors.sense_motion(self._sim.io)
        self._sim.sensors.sense_sonar(self._sim.io)

    def motion(self, row: int, time_s: float) -> Motion:
        """What the vehicle really does."""
        quat = self._vehicle["quat_wb"][row].astype(float)
        rotation = _rotation(quat)
        gravity = self.config.vehicle.gravity_m_s2
        place = self._vehicle["pos_w"][row].astype(float)
        return Motion(
            time_s,
            _three(place),
            _three(rotation @ self._vehicle["vel_b"][row]),
            (float(quat[0]), float(quat[1]), float(quat[2]), float(quat[3])),
            _three(self._vehicle["rate_b"][row]),
            _three(self._vehicle["acc_b"][row] + gravity * rotation[2]),
            float(place[2]) - self.config.world.tank.z_m[0],
        )

    def turns(self, pwm: tuple[int, ...]) -> bool:
        """Whether any thruster is asked to turn."""
        return bool(np.any(self.motors.rpm(pwm)))

    def value(self, name: str, row: int) -> np.ndarray:
        """Copy of 'struct.field' of the row."""
        return self._read[name][row].copy()

    def _wake(self, row: int) -> None:
        """This row alone takes part in what comes."""
        self._awake[:], self._active[:] = 0, 0
        self._awake[row] = self._active[row] = 1


def _rotation(quat: np.ndarray) -> np.ndarray:
    w, x, y, z = quat
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _three(values: Any) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
