"""The stack's readings, filled from messages in place of the simulator's sensor kernels.

What each stage reads (``kernels/*/bundles.py``), and where it comes from here:

- pose filter: ``ego.rpy``, ``rate_b``, ``specific_force_b`` and ``depth_m`` in every step, ``vel_b`` and
  ``vel_valid`` where ``step % sensors.dvl.period_steps == 0``, and the scan's ranges, Doppler and ping. It
  overwrites yaw, velocity and position in ``ego``, so the instruments' own values are written anew each step.
- tracking, mapping, spotting: ``scan`` and ``image`` in the step in which they are ``fresh``, with the own
  pose *of the ping and of the shot*: what ``ego`` held then, which is kept here for a second or so.
- all others: ``ego`` as it is now, ``clock``, ``mission``, and what those before them wrote.

Nobody behind the sensors reads the truth (``tests/test_observation_only.py``). Between two messages the last
one is held; a DVL without a message in its turn has lost the bottom. Sonar intensity is read by nobody.
"""

from __future__ import annotations

import numpy as np

from uuvtai.config import Config
from uuvtai.pilot.inbox import Inbox
from uuvtai.pilot.pose_history import PoseHistory
from uuvtai.pilot.sensor_messages import (
    DepthShot,
    DvlReading,
    ImuReading,
    PositionFix,
    PressureReading,
    SonarPing,
)
from uuvtai.stages import Stages

FIX_AGE_S = 0.3
"""[s] a scan or an image taken while attitude or position was older than this is not used: it would be drawn
at the wrong place of the map"""


class FedSensors:
    """A ``SensorSource`` for row 0; ``views`` are the simulator's arrays in memory, by 'struct.field'."""

    def __init__(self, config: Config, views: dict[str, np.ndarray], inbox: Inbox) -> None:
        sensors = config.sensors
        self._inbox, self._dt = inbox, config.episode.control_dt_s
        self._dvl_period = sensors.dvl.period_steps
        self._sonar_m, self._camera_m = sensors.sonar.max_range_m, sensors.depth.max_range_m
        self._clock, self._ego, self._scan, self._image = (
            {name.partition(".")[2]: array for name, array in views.items() if name.startswith(f"{struct}.")}
            for struct in ("clock", "ego", "scan", "image")
        )
        self._pings, self._shots = PoseHistory(), PoseHistory()
        self._imu = ImuReading(0.0, np.zeros(3), np.zeros(3), np.zeros(3))
        self._fixes = ("imu",) if sensors.localization == "estimated" else ("imu", "position")

    @property
    def step(self) -> int:
        """Control steps since the start."""
        return int(self._clock["step"][0])

    @property
    def now_s(self) -> float:
        """Until when a message counts as of this step: half a step later."""
        return (self.step + 0.5) * self._dt

    def sense_motion(self, stages: Stages) -> None:
        """IMU, DVL, pressure and position as they were last told."""
        if isinstance(imu := self._inbox.newest("imu", self.now_s), ImuReading):
            self._imu = imu
        ego = self._ego
        ego["rpy"][0] = ego["imu_rpy"][0] = self._imu.rpy
        ego["rate_b"][0], ego["specific_force_b"][0] = self._imu.rate_b, self._imu.specific_force_b
        ego["dvl_fresh"][0] = 0
        if self.step % self._dvl_period == 0:
            self._take_velocity()
        if isinstance(pressure := self._inbox.newest("pressure", self.now_s), PressureReading):
            ego["depth_m"][0] = pressure.depth_m
        if isinstance(position := self._inbox.newest("position", self.now_s), PositionFix):
            ego["pos_w"][0] = position.pos_w

    def _take_velocity(self) -> None:
        """Valid where the DVL has said anything since its last turn; else it holds the last reading."""
        reading, ego = self._inbox.newest("dvl", self.now_s), self._ego
        ego["vel_valid"][0] = ego["dvl_fresh"][0] = isinstance(reading, DvlReading)
        if isinstance(reading, DvlReading):
            ego["vel_b"][0] = ego["dvl_b"][0] = reading.vel_b

    def sense_sonar(self, stages: Stages) -> None:
        """The newest ping, placed where the vehicle was when it was taken."""
        ego, scan = self._ego, self._scan
        if self._is_placed():
            self._pings.note(
                self.step,
                ping_pos_w=ego["pos_w"][0],
                ping_yaw=ego["rpy"][0, 2],
                ping_vel_b=ego["vel_b"][0],
                ping_vel_valid=ego["vel_valid"][0],
            )
        ping = self._inbox.newest("sonar", self.now_s)
        scan["fresh"][0] = 0
        if isinstance(ping, SonarPing) and (then := self._pose_at("sonar", self._pings, ping.time_s)):
            hit = np.asarray(ping.hit) > 0
            scan["range_m"][0] = np.where(hit, np.clip(ping.range_m, 0.0, self._sonar_m), self._sonar_m)
            scan["doppler_m_s"][0] = np.where(hit, ping.doppler_m_s, 0.0)
            scan["hit"][0], scan["fresh"][0] = hit, 1
            scan["ping_step"][0] = self._step_of(ping.time_s)
            for name, value in then.items():
                scan[name][0] = value

    def sense_depth(self, stages: Stages) -> None:
        """The newest image, with the own pose when it was taken."""
        ego, image = self._ego, self._image
        if self._is_placed():
            self._shots.note(self.step, shot_pos_w=ego["pos_w"][0], shot_rpy=ego["rpy"][0])
        shot = self._inbox.newest("depth", self.now_s)
        image["fresh"][0] = 0
        if isinstance(shot, DepthShot) and (then := self._pose_at("depth", self._shots, shot.time_s)):
            image["depth_m"][0] = np.clip(shot.depth_m, 0.0, self._camera_m)
            image["fresh"][0] = 1
            for name, value in then.items():
                image[name][0] = value

    def _step_of(self, time_s: float) -> int:
        return round(time_s / self._dt)

    def _is_placed(self) -> bool:
        return all(self._inbox.age_s(name, self.now_s) <= FIX_AGE_S for name in self._fixes)

    def _pose_at(self, name: str, poses: PoseHistory, time_s: float) -> dict[str, np.ndarray] | None:
        found = poses.at(self._step_of(time_s))
        if found is None:
            tally = self._inbox.tallies[name]
            tally.used, tally.unplaced = tally.used - 1, tally.unplaced + 1
        return found
