"""Watches the pose filter from outside, step by step: what it predicts, and what readings have corrected.

A step goes: ``note_walls``, ``feel``, the filter's prediction with DVL and pressure, ``note_dvl``, the
filter's correction by the walls. Where the position is given nothing corrects it.
"""

from __future__ import annotations

import numpy as np

from uuvtai.pilot.carrying import acceleration_b, to_world
from uuvtai.pilot.own_motion import MotionSums, OwnPose
from uuvtai.pilot.pilot_numbers import PilotNumbers
from uuvtai.pilot.sensor_messages import ImuReading


class MotionWatch:
    """Of row 0 of ``views``, the stages' arrays by 'struct.field'."""

    def __init__(self, numbers: PilotNumbers, views: dict[str, np.ndarray]) -> None:
        self._views, self._estimated = views, numbers.estimated
        self._dt, self._gravity = numbers.dt_s, numbers.gravity_m_s2
        self.sums = MotionSums()
        self._before = self._expected = self._own()

    def note_walls(self, step: int) -> None:
        """Before ``step``: what the last one's scan has corrected."""
        now = self._own()
        if self._estimated and step > 0:
            self.sums.correct(self._before, now, self._dt * (step - 1))
        self._before = now

    def feel(self, imu: ImuReading, rpy: np.ndarray) -> None:
        """The step by the IMU, whose attitude (3,) [rad] is now taken to be ``rpy``; before that is told."""
        before, dt = self._before, self._dt
        corrected = self._views["ego.rpy"][0, 2] - self._views["ego.imu_rpy"][0, 2]
        attitude = np.array([rpy[0], rpy[1], rpy[2] + corrected], np.float64)
        accel_b = acceleration_b(imu, before.vel_b, self._gravity) - before.bias_b
        vel_w = to_world(before.vel_b + 0.5 * dt * accel_b, attitude)
        self._expected = OwnPose(
            before.pos_w + dt * vel_w, attitude, before.vel_b + dt * accel_b, before.bias_b
        )
        self.sums.feel(accel_b, vel_w, dt)

    def note_dvl(self, step: int) -> None:
        """After the filter's prediction: what a DVL's reading has corrected in it; in other steps there is
        none of the horizontal pose."""
        now = self._own()
        if self._estimated and step > 0 and self._views["ego.dvl_fresh"][0]:
            self.sums.correct(self._expected, now, self._dt * step)
        self._before = now

    def _own(self) -> OwnPose:
        """As the filter has it now."""
        own = (np.array(self._views[f"ego.{name}"][0], np.float64) for name in ("pos_w", "rpy", "vel_b"))
        return OwnPose(*own, bias_b=self._bias_b())

    def _bias_b(self) -> np.ndarray:
        """(3,) [m/s^2] error of the accelerometer: the last numbers of both filters (perception/pose.py)."""
        if not self._estimated:
            return np.zeros(3)
        return np.append(self._views["pose.mean"][0, 7:9], self._views["pose.depth"][0, 3]).astype(np.float64)
