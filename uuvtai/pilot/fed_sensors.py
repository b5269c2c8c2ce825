"""The stack's readings, filled from messages in place of the simulator's sensor kernels.

What each stage reads (``kernels/*/bundles.py``), and where it comes from here:

- pose filter: ``ego.rpy``, ``rate_b``, ``specific_force_b`` and ``depth_m`` in every step, ``vel_b`` and
  ``vel_valid`` where ``step % sensors.dvl.period_steps == 0``, and the scan's ranges, Doppler and ping. It
  overwrites yaw, velocity and position in ``ego``, so the instruments' own values are written anew each step.
- tracking, mapping, spotting: ``scan`` and ``image`` in the step in which they are ``fresh``, with the own
  pose *of the ping and of the shot*: what ``ego`` held then, which is kept here for a second or so.
- all others: ``ego`` as it is now, ``clock``, ``mission``, and what those before them wrote.

Nobody behind the sensors reads the truth (``tests/test_observation_only.py``). Between two messages the last
one is held, and one that comes late is carried forward to this step (``carrying.py``); a DVL without a
message in its turn has lost the bottom. Until its next message how the given position changes stands for it,
as that was told and not as it was carried (``find_velocity`` takes it). Nothing late is compared with, or
carried by, corrections that came after it (``own_motion.py``). Sonar intensity is read by nobody.
"""

from __future__ import annotations

import numpy as np

from uuvtai.pilot.carrying import to_world, turned_on
from uuvtai.pilot.inbox import Inbox
from uuvtai.pilot.motion_watch import MotionWatch
from uuvtai.pilot.own_motion import OwnPose
from uuvtai.pilot.pilot_numbers import PilotNumbers
from uuvtai.pilot.sensor_messages import (
    DepthShot,
    DvlReading,
    ImuReading,
    PositionFix,
    PressureReading,
    SonarPing,
    ThrusterLoss,
)

FIX_AGE_S = 0.3
"""[s] a scan or an image taken while attitude or position was older than this is not used: it would be drawn
at the wrong place of the map. A velocity or depth later than this is not carried forward, and a velocity by
positions is no older"""
FASTEST_M_S = 3.0
"""a position that changes faster was corrected, not driven"""


class FedSensors:
    """A ``SensorSource`` for row 0; ``views`` are the simulator's arrays in memory, by 'struct.field'."""

    def __init__(self, numbers: PilotNumbers, views: dict[str, np.ndarray], inbox: Inbox) -> None:
        self._inbox, self._dt = inbox, numbers.dt_s
        self._dvl_period = numbers.dvl_steps
        self._sonar_m, self._camera_m = numbers.sonar_m, numbers.camera_m
        self._clock, self._ego, self._scan, self._image = (
            {name.partition(".")[2]: array for name, array in views.items() if name.startswith(f"{struct}.")}
            for struct in ("clock", "ego", "scan", "image")
        )
        self._pings, self._shots, self._motions = PoseHistory(), PoseHistory(), PoseHistory()
        self._watch, self._sonar_latency = MotionWatch(numbers, views), numbers.sonar_latency_steps
        self._imu = ImuReading(0.0, np.zeros(3), np.zeros(3), np.array([0.0, 0.0, numbers.gravity_m_s2]))
        """until the first one comes: at rest"""
        self._pressure: PressureReading | None = None
        """until the first one comes: where the start is known to be"""
        self._fixes = ("imu",) if numbers.estimated else ("imu", "position")
        self.loses_velocity = not numbers.estimated
        self._dvl_valid, self._dvl_step = 0, -KEPT
        """what the DVL has said in its last turn, and when it last said anything"""
        self._fix_step, self._fix_w, self._fix_steps = -KEPT, np.zeros(3, np.float32), KEPT
        self._fix_vel_w = np.zeros(3, np.float32)
        """[m/s] change up to the newest position, from the one so many steps before it"""

    @property
    def step(self) -> int:
        """Control steps since the start."""
        return int(self._clock["step"][0])

    @property
    def now_s(self) -> float:
        """Until when a message counts as of this step: half a step later."""
        return (self.step + 0.5) * self._dt

    def sense_motion(self, stages: object) -> None:
        """IMU, DVL, pressure and position as they were last told; what came late is carried forward."""
        self._watch.note_walls(self.step)
        if isinstance(imu := self._inbox.newest("imu", self.now_s), ImuReading):
            self._imu = imu
        ego, imu = self._ego, self._imu
        late_s = min(self._steps_since(imu.time_s) * self._dt, FIX_AGE_S)
        rpy = turned_on(imu, late_s) if late_s else np.asarray(imu.rpy)
        self._watch.feel(imu, rpy)
        ego["rpy"][0] = ego["imu_rpy"][0] = rpy
        ego["rate_b"][0], ego["specific_force_b"][0] = imu.rate_b, imu.specific_force_b
        ego["dvl_fresh"][0] = 0
        if isinstance(position := self._inbox.newest("position", self.now_s), PositionFix):
            self._take_change(position)
        if self.step % self._dvl_period == 0:
            self._take_velocity()
        if self.loses_velocity:
            self._offer_change()
        if isinstance(loss := self._inbox.newest("thruster", self.now_s), ThrusterLoss):
            ego["given_up"][0] = int(loss.thruster)
        if isinstance(pressure := self._inbox.newest("pressure", self.now_s), PressureReading):
            self._pressure = pressure
        self._take_pressure(
            self._pressure or PressureReading(self.step * self._dt, -float(ego["pos_w"][0, 2]))
        )
        if isinstance(position, PositionFix):
            late_s = self._steps_since(position.time_s) * self._dt
            moved = to_world(ego["vel_b"][0], ego["rpy"][0]) * late_s if late_s else 0.0
            ego["pos_w"][0] = position.pos_w + moved

    def _take_velocity(self) -> None:
        """Valid where the DVL has said anything since its last turn; else it holds the last reading. A late
        one changes by what the accelerometer has felt since."""
        reading, ego = self._inbox.newest("dvl", self.now_s), self._ego
        ego["vel_valid"][0] = ego["dvl_fresh"][0] = isinstance(reading, DvlReading)
        if isinstance(reading, DvlReading):
            velocity = np.asarray(reading.vel_b)
            if self._steps_since(reading.time_s):
                then = self._motion_at(reading.time_s, self._dvl_period)
                ego["vel_valid"][0] = ego["dvl_fresh"][0] = then is not None
                velocity = velocity + self._watch.sums.won_b - then["won_b"] if then else ego["vel_b"][0]
            ego["vel_b"][0] = ego["dvl_b"][0] = velocity
        self._dvl_valid = ego["vel_valid"][0]
        self._dvl_step = self.step if self._dvl_valid else self._dvl_step

    def _offer_change(self) -> None:
        """A velocity by positions that are younger than the DVL's reading, if they are not old themselves."""
        steps = self._fix_steps + self.step - self._fix_step
        known = np.abs(self._fix_vel_w).max() < FASTEST_M_S and steps * self._dt <= FIX_AGE_S
        self._ego["vel_valid"][0], self._ego["fix_vel_w"][0] = self._dvl_valid, self._fix_vel_w
        self._ego["fix_valid"][0] = known and self._fix_step > self._dvl_step

    def _take_change(self, fix: PositionFix) -> None:
        """[m/s] by the newest two positions, in float32 as the simulator's own kernel has it."""
        step, pos_w = self._step_of(fix.time_s), np.asarray(fix.pos_w, np.float32)
        if step > self._fix_step:
            self._fix_steps = step - self._fix_step
            self._fix_vel_w = (pos_w - self._fix_w) * np.float32(1.0 / (self._fix_steps * self._dt))
            self._fix_step, self._fix_w = step, pos_w

    def _take_pressure(self, pressure: PressureReading) -> None:
        """A late one, or one held, changes by what the vehicle has risen since."""
        depth_m, then = pressure.depth_m, self._motion_at(pressure.time_s)
        if self._steps_since(pressure.time_s) and then is not None:
            depth_m -= self._watch.sums.risen_m - float(then["risen_m"])
        self._ego["depth_m"][0] = depth_m

    def sense_sonar(self, stages: object) -> None:
        """The newest ping, placed where the vehicle was when it was taken."""
        ego, scan = self._ego, self._scan
        self._watch.note_dvl(self.step)
        if self._inbox.age_s("imu", self.now_s) < np.inf:
            self._motions.note(self.step, **self._watch.sums.noted())
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
            hit, n = np.asarray(ping.hit) > 0, len(ping.range_m)
            beams = (ping.first_beam + np.arange(n)) % scan["hit"].shape[1]
            scan["range_m"][0, beams] = np.where(
                hit, np.clip(ping.range_m, 0.0, self._sonar_m), self._sonar_m
            )
            doppler = np.where(hit, ping.doppler_m_s, 0.0) if len(ping.doppler_m_s) else 0.0
            scan["doppler_m_s"][0, beams] = doppler
            scan["hit"][0, beams], scan["fresh"][0] = hit, 1
            scan["new_from"][0], scan["new_count"][0] = ping.first_beam, n
            scan["ping_step"][0] = self._step_of(ping.time_s)
            for name, value in self._corrected(then, ping.time_s).items():
                scan[name][0] = value

    def sense_depth(self, stages: object) -> None:
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

    def _corrected(self, then: dict[str, np.ndarray], time_s: float) -> dict[str, np.ndarray]:
        """The pose of a ping as it is known now, where it is later than its sonar always is."""
        noted = self._motions.at(self._step_of(time_s))
        if noted is None or self._steps_since(time_s) <= self._sonar_latency:
            return then
        rpy = np.append(self._imu.rpy[:2], then["ping_yaw"])
        was = OwnPose(then["ping_pos_w"], rpy, then["ping_vel_b"])
        known = self._watch.sums.known_now(was, noted, time_s)
        return then | {"ping_pos_w": known.pos_w, "ping_yaw": known.rpy[2], "ping_vel_b": known.vel_b}

    def _motion_at(self, time_s: float, waited: int = 0) -> dict[str, np.ndarray] | None:
        """The own motion then; None where that is not known, or too long ago but for steps ``waited``."""
        late_s = (self._steps_since(time_s) - waited) * self._dt
        return None if late_s > FIX_AGE_S else self._motions.at(self._step_of(time_s))

    def _steps_since(self, time_s: float) -> int:
        """0 = measured in this step."""
        return self.step - self._step_of(time_s)

    def _step_of(self, time_s: float) -> int:
        return round(time_s / self._dt)

    def _is_placed(self) -> bool:
        return all(self._inbox.age_s(name, self.now_s) <= FIX_AGE_S for name in self._fixes)

    def _pose_at(self, name: str, poses: PoseHistory, time_s: float) -> dict[str, np.ndarray] | None:
        found = poses.at(self._step_of(time_s))
        if found is None:
            self._inbox.reject(name)
        return found


KEPT = 75
"""steps"""


class PoseHistory:
    """A ring of rows of numbers; the row of a step is there while the step is one of the last KEPT noted."""

    def __init__(self) -> None:
        self._rows: dict[int, dict[str, np.ndarray]] = {}

    def clear(self) -> None:
        """Forget all."""
        self._rows.clear()

    def note(self, step: int, **values: np.ndarray) -> None:
        """Keep copies of this step's values."""
        self._rows[step] = {name: np.array(value) for name, value in values.items()}
        self._rows.pop(step - KEPT, None)

    def at(self, step: int) -> dict[str, np.ndarray] | None:
        """Values of a step; None where it was not noted, or too long ago."""
        return self._rows.get(step)
