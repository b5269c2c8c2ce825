"""The stack's readings, filled from messages in place of the simulator's sensor kernels.

What each stage reads (``kernels/*/io.py``), and where it comes from here:

- pose filter: ``ego.rpy``, ``rate_b``, ``specific_force_b`` and ``depth_m`` in every step, ``vel_b`` and
  ``vel_valid`` where ``step % sensors.dvl.period_steps == 0``, and the scan's ranges, Doppler and ping. It
  overwrites yaw, velocity and position in ``ego``, so the instruments' own values are written anew each step.
- tracking, mapping, spotting: ``scan`` and ``image`` in the step in which they are ``fresh``, with the own
  pose *of the ping and of the shot*: what ``ego`` held then, which is kept here for a second or so.
- all others: ``ego`` as it is now, ``clock``, ``mission``, and what those before them wrote.

Nobody behind the sensors reads the truth (``tests/sim/test_observation_only.py``). Between two messages the
last one is held, and one that comes late is carried forward to this step; a DVL without a
message in its turn has lost the bottom. Until its next message how the given position changes stands for it,
as that was told and not as it was carried (``find_velocity`` takes it). Nothing late is compared with, or
carried by, corrections that came after it. Sonar intensity is read by nobody.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from uuvtai.vehicle.messages import (
    DepthShot,
    DvlReading,
    ImuReading,
    Inbox,
    PilotNumbers,
    PositionFix,
    PressureReading,
    SonarPing,
    ThrusterLoss,
)

# ---- Readings that come late, carried forward to now by what the vehicle knows of its motion since. The pose
# filter takes every reading for one of this very step. One of a tenth of a second ago is wrong by what the
# vehicle has done meanwhile, which is far more than the instrument's own error.


def turned_on(imu: ImuReading, late_s: float) -> np.ndarray:
    """(3,) [rad] roll, pitch, yaw ``late_s`` after the reading, at its own rates (Fossen, Handbook of Marine
    Craft Hydrodynamics and Motion Control, 2011, eq. 2.28)."""
    rpy, (p, q, r) = np.asarray(imu.rpy, np.float64), np.asarray(imu.rate_b, np.float64)
    (sin_roll, sin_pitch, _), (cos_roll, cos_pitch, _) = np.sin(rpy), np.cos(rpy)
    turning = (q * sin_roll + r * cos_roll) / max(cos_pitch, 0.1)
    rates = np.array([p + sin_pitch * turning, q * cos_roll - r * sin_roll, turning])
    return rpy + late_s * rates


def acceleration_b(imu: ImuReading, vel_b: np.ndarray, gravity_m_s2: float) -> np.ndarray:
    """(3,) [m/s^2] rate of change of the velocity in body axes: specific force, gravity, turning axes."""
    roll, pitch, _ = np.asarray(imu.rpy, np.float64)
    down_b = np.array([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)])
    turning = np.cross(np.asarray(imu.rate_b, np.float64), np.asarray(vel_b, np.float64))
    return np.asarray(imu.specific_force_b, np.float64) - gravity_m_s2 * down_b - turning


def to_world(vector_b: np.ndarray, rpy: np.ndarray) -> np.ndarray:
    """(3,) of body axes in the world's."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(rpy), np.cos(rpy)
    rotation = np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
    return rotation @ np.asarray(vector_b, np.float64)


# ---- What the vehicle has felt of its own motion, and what readings have corrected of the estimate of it.
# Both are sums since the start; their differences between two steps carry a late reading forward, or take
# what was estimated at a ping to what is known now. Neither may hold the other: a reading carried by an
# estimate that later readings have corrected, or compared with one that they have not, has one error
# corrected once for each reading on its way, and the estimate runs away (T. Larsen et al., Incorporation of
# time delayed measurements in a discrete-time Kalman filter, CDC 1998).


def _nothing() -> np.ndarray:
    return np.zeros(3)


@dataclass(frozen=True, eq=False)
class OwnPose:
    """What the pilot takes for its own pose and velocity at one moment."""

    pos_w: np.ndarray  # (3,) [m]
    rpy: np.ndarray  # (3,) [rad]
    vel_b: np.ndarray  # (3,) [m/s]
    bias_b: np.ndarray = field(default_factory=_nothing)  # (3,) [m/s^2] error of the accelerometer


@dataclass(eq=False)
class MotionSums:
    """Sums up to the present step."""

    won_b: np.ndarray = field(default_factory=_nothing)
    """(3,) [m/s] velocity by the accelerometer alone, less its error as it was known, body axes"""
    risen_m: float = 0.0  # upwards, by the velocity alone
    bias_w: np.ndarray = field(default_factory=_nothing)
    """(3,) [m/s^2] corrections of the accelerometer's error,"""
    vel_w: np.ndarray = field(default_factory=_nothing)
    """(3,) [m/s] of the velocity, led back to time 0 by those,"""
    pos_w: np.ndarray = field(default_factory=_nothing)  # (3,) [m] and of the position, led back by both
    yaw: float = 0.0  # [rad] corrections of the heading

    def feel(self, accel_b: np.ndarray, vel_w: np.ndarray, dt_s: float) -> None:
        """A step of dt at an acceleration (3,) [m/s^2] and a velocity (3,) [m/s]."""
        self.won_b = self.won_b + dt_s * accel_b
        self.risen_m += dt_s * float(vel_w[2])

    def correct(self, expected: OwnPose, found: OwnPose, time_s: float) -> None:
        """Readings at ``time_s`` made ``found`` of what was ``expected``."""
        bias_w = to_world(found.bias_b - expected.bias_b, expected.rpy)
        vel_w = to_world(found.vel_b - expected.vel_b, expected.rpy)
        self.bias_w = self.bias_w + bias_w
        self.vel_w = self.vel_w + vel_w + time_s * bias_w
        self.pos_w = self.pos_w + found.pos_w - expected.pos_w - time_s * (vel_w + 0.5 * time_s * bias_w)
        self.yaw += float(found.rpy[2] - expected.rpy[2] + np.pi) % (2 * np.pi) - np.pi

    def noted(self) -> dict[str, np.ndarray]:
        return {name: np.array(value) for name, value in vars(self).items()}

    def known_now(self, then: OwnPose, noted: dict[str, np.ndarray], time_s: float) -> OwnPose:
        """``then``, a past pose as taken when the sums were those ``noted``, as it is known now."""
        pos_w, vel_w, bias_w = (getattr(self, name) - noted[name] for name in ("pos_w", "vel_w", "bias_w"))
        return OwnPose(
            then.pos_w + pos_w + time_s * (vel_w - 0.5 * time_s * bias_w),
            then.rpy + np.array([0.0, 0.0, self.yaw - float(noted["yaw"])]),
            then.vel_b + to_body(vel_w - time_s * bias_w, then.rpy),
        )


def to_body(vector_w: np.ndarray, rpy: np.ndarray) -> np.ndarray:
    """(3,) of the world's axes in the body's."""
    return np.array([vector_w @ to_world(axis, rpy) for axis in np.eye(3)])


# ---- Watches the pose filter from outside, step by step: what it predicts, and what readings have corrected.
# A step goes: ``note_walls``, ``feel``, the filter's prediction with DVL and pressure, ``note_dvl``, the
# filter's correction by the walls. Where the position is given nothing corrects it.


class MotionWatch:
    """Of row 0 of ``views``, the stages' arrays by 'struct.field'."""

    def __init__(self, numbers: PilotNumbers, views: dict[str, np.ndarray]) -> None:
        self._views, self._estimated = views, numbers.estimated
        self._dt, self._gravity = numbers.dt_s, numbers.gravity_m_s2
        self.sums = MotionSums()
        self._before = self.expected = self._own()  # after the last step; now, by the accelerometer

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
        self.expected = OwnPose(
            before.pos_w + dt * vel_w, attitude, before.vel_b + dt * accel_b, before.bias_b
        )
        self.sums.feel(accel_b, vel_w, dt)

    def note_dvl(self, step: int) -> None:
        """After the prediction: what a DVL's reading has corrected in it; other steps have none."""
        now = self._own()
        if self._estimated and step > 0 and self._views["ego.dvl_fresh"][0]:
            self.sums.correct(self.expected, now, self._dt * step)
        self._before = now

    def _own(self) -> OwnPose:
        """As the filter has it now."""
        own = (np.array(self._views[f"ego.{name}"][0], np.float64) for name in ("pos_w", "rpy", "vel_b"))
        return OwnPose(*own, bias_b=self._bias_b())

    def _bias_b(self) -> np.ndarray:
        """(3,) [m/s^2] error of the accelerometer: the last numbers of both filters (perception/pose.py)."""
        if not self._estimated:
            return np.zeros(3)
        return np.append(
            self._views["localization.mean"][0, 7:9], self._views["localization.depth"][0, 3]
        ).astype(np.float64)


FIX_AGE_S = 0.3
"""[s] a scan or an image taken while attitude or position was older than this is not used: it would be drawn
at the wrong place of the map. A velocity or depth later than this is not carried forward, and a velocity by
positions is no older"""
FASTEST_M_S = 3.0  # a position that changes faster was corrected, not driven
JUMP_M_S, JUMP_M_S2 = 1.0, 2.0  # a velocity may be off by so much, and more after a silence (EC)


class FedSensors:
    """A ``SensorSource`` for row 0; ``views`` are the simulator's arrays in memory, by 'struct.field'."""

    def __init__(self, numbers: PilotNumbers, views: dict[str, np.ndarray], inbox: Inbox) -> None:
        self._inbox, self._dt = inbox, numbers.dt_s
        self._dvl_period = numbers.dvl_steps
        self._mechanical = numbers.mechanical
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
        self._fix_step, self._fix_w, self._fix_steps = -KEPT, np.zeros(3, np.float32), float(KEPT)
        self._fix_s = -KEPT * self._dt
        self._fix_vel_w = np.zeros(3, np.float32)
        """[m/s] change up to the newest position, from the one so many steps before it"""

    @property
    def step(self) -> int:
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
        one changes by what the accelerometer has felt since; one that no thrust explains is none."""
        reading, ego = self._inbox.newest("dvl", self.now_s), self._ego
        is_valid = isinstance(reading, DvlReading)
        if isinstance(reading, DvlReading):
            velocity = np.asarray(reading.vel_b)
            if self._steps_since(reading.time_s):
                then = self._motion_at(reading.time_s, self._dvl_period)
                is_valid = then is not None
                velocity = velocity + self._watch.sums.won_b - then["won_b"] if then else ego["vel_b"][0]
            silent_s = (self.step - self._dvl_step) * self._dt
            if np.linalg.norm(velocity - self._watch.expected.vel_b) > JUMP_M_S + JUMP_M_S2 * silent_s:
                self._inbox.reject("dvl")
                is_valid, velocity = False, ego["vel_b"][0]
            ego["vel_b"][0] = ego["dvl_b"][0] = velocity
        self._dvl_valid = ego["vel_valid"][0] = ego["dvl_fresh"][0] = is_valid
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
            self._fix_steps = round((fix.time_s - self._fix_s) / self._dt, 3)  # 20 a second are 2.5 apart
            self._fix_s = fix.time_s
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
        ping = self._inbox.newest("sonar", self.now_s, in_turn=self._mechanical)
        scan["fresh"][0] = 0
        if isinstance(ping, SonarPing) and (then := self._pose_at("sonar", self._pings, ping.time_s)):
            hit, n = np.asarray(ping.hit) > 0, len(ping.range_m)
            beams = (int(ping.first_beam) + np.arange(n)) % scan["hit"].shape[1]
            scan["range_m"][0, beams] = np.where(
                hit, np.clip(ping.range_m, 0.0, self._sonar_m), self._sonar_m
            )
            doppler = np.where(hit, ping.doppler_m_s, 0.0) if len(ping.doppler_m_s) else 0.0
            scan["doppler_m_s"][0, beams] = doppler
            scan["hit"][0, beams], scan["fresh"][0] = hit, 1
            scan["new_from"][0], scan["new_count"][0] = int(ping.first_beam), n
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


KEPT = 75  # steps


class PoseHistory:
    """A ring of rows of numbers; the row of a step is there while the step is one of the last KEPT noted."""

    def __init__(self) -> None:
        self._rows: dict[int, dict[str, np.ndarray]] = {}

    def clear(self) -> None:
        self._rows.clear()

    def note(self, step: int, **values: np.ndarray) -> None:
        self._rows[step] = {name: np.array(value) for name, value in values.items()}
        self._rows.pop(step - KEPT, None)

    def at(self, step: int) -> dict[str, np.ndarray] | None:
        """Values of a step; None where it was not noted, or too long ago."""
        return self._rows.get(step)
