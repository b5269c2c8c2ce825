"""``uuv pilot``: fifty times a second hear, think, decide, speak. What it decides is elsewhere."""

from __future__ import annotations

import dataclasses
import math
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any, Literal, TypeVar

import numpy as np

from uuvtai.common.signals import StopEvent
from uuvtai.config import Config
from uuvtai.sim.behavior_tree import FlatTree
from uuvtai.sim.sim import Sim
from uuvtai.vehicle import calibrate, mavlink, safety
from uuvtai.vehicle.handover import Handover
from uuvtai.vehicle.instruments.rig import HAVE_IMAGES, Rig
from uuvtai.vehicle.mavlink import LinkError
from uuvtai.vehicle.messages import NAMES, DvlReading, ImuReading, SensorMessage, three
from uuvtai.vehicle.onboard import Mission, OnboardPilot, PilotCommand
from uuvtai.vehicle.pilot_log import LinkLog
from uuvtai.vehicle.preflight import CHECK_S, MISSING, Preflight
from uuvtai.vehicle.start_fix import MISFIT, StartFix, StartFound, WallWatch
from uuvtai.vehicle.telemetry import AUTOPILOT, COMPANION, Heard, Intake, Senders, waiting_for

# ---- What ``uuv pilot`` was told, checked before anything is opened or compiled.

_ECHOES = 3  # more of our own heartbeats than we sent are another's
EDGE_M = 0.01  # the fence keeps the hull so far from surface and floor of the tank where no depths are typed
MOST_SPEED_M_S = 2.0
_USUAL_S = {"fly": math.inf, "check": CHECK_S, "calibrate": calibrate.LONGEST_S}
_DRY = {"fly": "dry run", "check": "check", "calibrate": "calibration"}


@dataclass(frozen=True)
class FlightPlan:
    """What ``uuv pilot`` was told."""

    place: mavlink.LinkPlace
    mission: Mission
    limits: safety.SafetyLimits
    log: Path
    arms: bool = False  # whether orders are sent; else a dry run
    heading_rad: float | None = None  # compass heading of the world's x axis; None = where the vehicle looks
    seconds: float = math.inf
    rate: float = 1.0
    """seconds of the vehicle's clock in one of ours, if simulated; 0 = it is followed"""
    system: int = 1
    operator: int = 255
    senders: Senders | None = None  # from whom what counts; None = the usual ones of ``system``
    instruments: Mapping[str, str] = field(default_factory=dict)
    """what is heard from an instrument itself ('dvl', 'sonar') -> its place"""
    purpose: Literal["fly", "check", "calibrate"] = "fly"
    """the last two take nothing, not even in pretence: they judge what they hear, or find out how the
    instruments are mounted"""

    @classmethod
    def typed(
        cls,
        config: Config,
        link: str,
        start: Sequence[float] | None,
        goal: Sequence[float] | None,
        box: Sequence[float] | None,
        depth: Sequence[float] | None,
        max_speed: float,
        battery: float,
        *,
        arms: bool,
        heading_deg: float | None,
        seconds: float | None,
        rate: float,
        log: Path | None,
        system: int,
        operator: int,
        senders: Sequence[str] = (),
        instruments: Mapping[str, str | None] | None = None,
        purpose: Literal["fly", "check", "calibrate"] = "fly",
    ) -> FlightPlan:
        """Of what was typed. Raises LinkError."""
        if config.sensors.sonar.doppler:
            raise LinkError(
                "the pilot would wait for a sonar with Doppler, which OBSTACLE_DISTANCE does not have: "
                "--sensors multibeam, or --set sensors.sonar.doppler=false"
            )
        if system == operator:
            raise LinkError(f"--system {system}: the operator has this id too; give another --operator")
        if not 0 < max_speed <= MOST_SPEED_M_S:
            raise LinkError(f"--max-speed {max_speed:g}: give metres per second up to {MOST_SPEED_M_S:g}")
        if not 0 <= battery < 100:
            raise LinkError(f"--battery {battery:g}: give volts, 0 = never mind")
        if heading_deg is not None and not abs(heading_deg) <= 360:
            raise LinkError(f"--heading {heading_deg:g}: give degrees of a compass, for example --heading 90")
        if seconds is not None and not 0 < seconds < math.inf:
            raise LinkError(f"--seconds {seconds:g}: give a number above 0, or leave it out")
        heading_deg = config.world.tank.heading_deg if heading_deg is None else heading_deg
        mounted = {"dvl": config.sensors.dvl.at, "sonar": config.sensors.sonar.at}
        heard_at = mounted | {option: place for option, place in (instruments or {}).items() if place}
        limits = _limits(config, box, depth, max_speed, battery)
        mission = Mission(three(start or ()), three(goal or ()))
        _refuse_places(mission, limits)
        return cls(
            mavlink.place_of(link),
            mission,
            limits,
            log or Path("runs") / f"pilot_{time.strftime('%Y%m%d-%H%M%S')}.mcap",
            arms,
            None if heading_deg is None else math.radians(heading_deg),
            _USUAL_S[purpose] if seconds is None else seconds,
            rate,
            system,
            operator,
            Senders.typed(senders, system),
            {option: place for option, place in heard_at.items() if place},
            purpose,
        )


def _limits(
    config: Config,
    box: Sequence[float] | None,
    depth: Sequence[float] | None,
    max_speed: float,
    battery: float,
) -> safety.SafetyLimits:
    """As typed; where nothing is, the tank's and the vehicle's own."""
    tank, vehicle = config.world.tank, config.vehicle
    low_x, low_y, high_x, high_y = box or (tank.x_m[0], tank.y_m[0], tank.x_m[1], tank.y_m[1])
    edge_m = vehicle.hull_radius_m + EDGE_M
    return safety.SafetyLimits(
        box_m=(low_x, low_y, high_x, high_y),
        depth_m=(depth[0], depth[1]) if depth else (edge_m - tank.z_m[1], -tank.z_m[0] - edge_m),
        speed_m_s=max_speed,
        heave_m_s=min(max_speed, vehicle.max_heave_m_s),
        yaw_rate_rad_s=vehicle.max_yaw_rate_rad_s,
        battery_v=battery,
    )


def _refuse_places(mission: Mission, limits: safety.SafetyLimits) -> None:
    low_x, low_y, high_x, high_y = limits.box_m
    if not (low_x < high_x and low_y < high_y):
        raise LinkError("--box: give least x, least y, most x, most y, for example --box 0,0,20,6")
    if not 0 <= limits.depth_m[0] < limits.depth_m[1]:
        raise LinkError("--depth: give the least depth, then the most, for example --depth 0.3,1.4")
    for option, place in (("--start", mission.start), ("--goal", mission.goal)):
        if (out := safety.outside_m(place, limits)) > 0:
            where = ",".join(f"{value:g}" for value in place)
            raise LinkError(
                f"{option} {where}: is {out:.2f} m outside the fence; z is up and 0 at the surface, so a "
                "depth of 0.8 m is -0.8; or widen --box and --depth"
            )


_WANTED_HZ = {30: 50.0, 27: 50.0, 29: 10.0, 137: 10.0, 32: 20.0, 1: 2.0}
"""message id -> rate: ATTITUDE, RAW_IMU, SCALED_PRESSURE and 2, LOCAL_POSITION_NED, SYS_STATUS"""
_GIVE_BACK_S = 6.0
FEEDBACK_AGE_S = 0.5  # a velocity that is older is not fed back to the sticks
_LEAST_ASKED_M_S, _ANSWER = 0.15, 0.2
"""a vehicle that is asked for so much, and has less than this share of it, does not answer"""
_REST_S, _LOOK_RAD_S, _SWEEP_RAD_S = 5.0, 0.5, 0.3
"""where the walls that are seen at rest do not tell the start for so long, the vehicle turns on the spot; the
last: where a head turns, too"""
_UNKNOWN = (math.nan, math.nan, math.nan)
_NEARER_M = 0.1  # than the goal's radius, so that it is near wherever it is
_REACHED, _INTERRUPTED, _CALIBRATED = "goal reached", "interrupted", "calibrated"
_T = TypeVar("_T")
_FAREWELLS = (_REACHED, "time is up", _INTERRUPTED)


@dataclass
class FlightTally:
    steps: int = 0
    actions: Counter[str] = field(default_factory=Counter)
    reasons: Counter[str] = field(default_factory=Counter)
    heard: Counter[str] = field(default_factory=Counter)
    said: Counter[str] = field(default_factory=Counter)
    sent: Counter[str] = field(default_factory=Counter)


class OnboardLoop:
    """One flight. ``now`` and ``sleep`` are of the clock that it keeps."""

    def __init__(
        self,
        config: Config,
        pilot: OnboardPilot,
        plan: FlightPlan,
        endpoint: mavlink.Endpoint,
        log: LinkLog,
        now: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
        note: Callable[[str], None] = lambda text: None,
        fix: StartFix | None = None,
        rig: Rig | None = None,
    ) -> None:
        """``fix``: checks the start by the walls before the vehicle is taken; None = it is believed. ``rig``:
        instruments that are heard beside MAVLink."""
        self._config, self._pilot, self._plan, self._endpoint, self._log = config, pilot, plan, endpoint, log
        self._now, self._sleep, self._note_to = now, sleep, note
        self._notes = FlightNotes(f"{plan.place.host}:{plan.place.port}", plan.operator)
        self._rate = plan.rate or 1.0
        self._codec = mavlink.MavCodec(plan.system, COMPANION, plan.operator)
        self._rig, self._rate_b = rig or Rig(config, {}), np.zeros(3)
        """instruments; [rad/s] of the newest gyro"""
        self._intake = Intake(
            config, plan.mission.start, plan.heading_rad, plan.system, plan.operator, plan.senders,
            self._rig.replaced,
        )  # fmt: skip
        self._handover = Handover(plan.system, plan.limits, pretended=not plan.arms)
        self._memory, self.tally = safety.SafetyMemory(), FlightTally()
        self._needed = [name for name in NAMES.values() if name not in ("depth", "thruster")]
        if config.sensors.localization == "estimated":
            self._needed.remove("position")
        self._measured_s = dict.fromkeys(NAMES.values(), -math.inf)
        """when what the pilot uses was measured; a scan counts when it is placed in the map"""
        self._scan_s, self._scans = -math.inf, 0  # newest scan heard; scans that were placed
        self._vehicle: mavlink.Address | None = endpoint.calls
        self._speaker: mavlink.Address | None = None  # where the autopilot's heartbeats come from
        self._asked_s = self._beat_s = -math.inf
        self._clock_jumps = self._jumps_before = endpoint.clock_jumps
        self._heard_s = 0.0  # time of the newest step
        self._begun_s: float | None = None
        self._lag_s = self._unanswered_s = 0.0
        """pilot's clock behind ours: what was lost in stalls; how long the vehicle did not move as asked"""
        self._stalls: list[tuple[float, float]] = []
        self.last = safety.SafeDecision(safety.SafeAction.HOLD, safety.STOP, ("nothing was decided yet",))
        self._is_leaving, self._told = False, ""
        self._fix, self._start, self._walls = fix, StartFound(), WallWatch(config) if fix else None
        self._sees_around = self._rig.look_around(fix is not None or plan.purpose == "calibrate")
        """whether the start is sought by a sonar's head that turns all around"""
        self._look_rad_s = 0.0  # at which the vehicle turns until the start is found
        self._sought, self._check = fix, None
        """who seeks the start, also when it is found; what a check gathers"""
        if plan.purpose == "check":
            self._check = Preflight(config, plan.limits, plan.mission.start[2], plan.system, plan.operator)
        self._calibration = None
        if plan.purpose == "calibrate":
            self._calibration = calibrate.Calibration(config, plan.mission.start)
        self.failure: BaseException | None = None
        """an error of this program that ended the flight, or came while it ended"""

    def run(self, stop: Event | None = None) -> None:
        """Until the goal is reached, the time is up, the vehicle was given back or ``stop`` is set; whatever
        ends it, an exception too (see ``failure``), the vehicle is stopped and given back."""
        self._begun_s = self._now()
        try:
            reasons = self._drive(stop)
        except KeyboardInterrupt:
            reasons = (_INTERRUPTED,)
        except BaseException as error:
            self.failure, reasons = error, (f"{type(error).__name__}: {error}",)
        if not self._handover.ended:
            self._leave(reasons)

    @property
    def _only_listens(self) -> bool:
        """Whether it takes nothing, not even in pretence."""
        return self._plan.purpose != "fly"

    def _time_s(self) -> float:
        return 0.0 if self._begun_s is None else (self._now() - self._begun_s) * self._rate

    def _drive(self, stop: Event | None) -> tuple[str, ...]:
        """Why it is over."""
        due_s, dt = 0.0, self._config.episode.control_dt_s
        while not (stop is not None and stop.is_set()):
            now_s = self._time_s()
            stalled_s = max(0.0, now_s - due_s)
            if stalled_s > safety.STALL_S:
                self._lag_s, due_s = self._lag_s + stalled_s, now_s
                self._rig.forget(now_s)  # what came meanwhile would count as told now
            command = self.step(now_s, stalled_s)
            if self._start.refusal:
                return (f"start refused: {self._start.refusal}",)
            if farewell := self._farewell(now_s, command):
                return (farewell,)
            if self._handover.ended or (
                self.last.action == safety.SafeAction.HAND_BACK and self._handover.has_asked
            ):
                return self.last.reasons
            due_s += dt
            if (wait_s := due_s / self._rate - (self._now() - (self._begun_s or 0.0))) > 0:
                self._sleep(wait_s)
        return (_INTERRUPTED,)

    def _leave(self, reasons: tuple[str, ...]) -> None:
        """Stop and hand back until the vehicle has left our mode, whatever error or Ctrl-C comes."""
        self.last = safety.SafeDecision(safety.SafeAction.HAND_BACK, safety.STOP, reasons)
        self._is_leaving = True
        until_s = time.monotonic() + _GIVE_BACK_S / min(self._rate, 1.0)
        heard, dt = self._intake.heard, self._config.episode.control_dt_s
        while not self._handover.ended and time.monotonic() < until_s:
            now_s = self._tried(self._time_s) or 0.0
            self._tried(self._hear, now_s)
            orders = self._tried(self._handover.leave, now_s, heard)
            for order in self._handover.last_words() if orders is None else orders:
                self._tried(self._say, now_s, order)
            self._tried(self._log.decided, now_s, None, self.last, heard, None)
            if not self._handover.ended:
                self._tried(self._sleep, dt if orders is not None else 10 * dt)
        self.tally.actions[self.last.action.name] += 1
        self.tally.reasons.update(reason.partition(":")[0] for reason in reasons)
        if not self._only_listens:
            self._tried(self.tell, "hand back: " + "; ".join(reasons))

    def _tried(self, do: Callable[..., _T], *given: Any) -> _T | None:
        """What ``do`` gives, None where it fails; the first failure is kept."""
        try:
            return do(*given)
        except KeyboardInterrupt:
            pass
        except Exception as error:
            self.failure = self.failure or error
        return None

    def step(self, now_s: float, stalled_s: float = 0.0, farewell: str = "") -> PilotCommand:
        """One step: hear, think, decide, speak."""
        self._log.begin_step()
        self._hear(now_s)
        if self._intake.heard.jumped and not self._handover.has_asked:
            self._intake.forget_jump()
        self._find_start(now_s)
        command = self._pilot.tick()
        if (used := self._pilot.tallies["sonar"].used) != self._scans:  # a scan was placed in the map
            self._scans, self._measured_s["sonar"] = used, self._scan_s
        view = self._view(now_s, stalled_s, command)
        decision, memory = safety.decide(view, self._memory, self._plan.limits)
        self._memory = memory if self._handover.has_asked else safety.SafetyMemory(memory.since_s)
        heard, measured = self._intake.heard, self._measured(now_s)
        if farewell:
            decision = safety.SafeDecision(safety.SafeAction.HAND_BACK, safety.STOP, (farewell,))
            said = self._handover.leave(now_s, heard)
        elif self._only_listens:
            said = []
            if self._check is not None:
                self._check.stepped(now_s, self._plan.seconds, command.held, memory.since_s)
        else:
            said = self._handover.orders(decision, now_s, heard, measured)
        for order in said:
            self._say(now_s, order)
        self._note_answer(decision, view)
        self._keep_in_touch(now_s)
        self._note(now_s, command, decision, view.speed_m_s)
        return command

    def _hear(self, now_s: float) -> None:
        datagrams = self._endpoint.receive()
        # what was received was there by now, not by ``now_s``
        self._heard_s = come_s = max(now_s, self._time_s())
        if self._endpoint.clock_jumps != self._clock_jumps:
            self._clock_jumps = self._endpoint.clock_jumps
            self._intake.forget_clocks()
            self._rig.forget_clocks()
        for sender, datagram in datagrams:
            for message in self._codec.decode(datagram):
                if self._is_leaving:
                    self._tried(self._take, sender, message, come_s)
                else:
                    self._take(sender, message, come_s)
        if self._codec.echoes > self.tally.sent["HEARTBEAT"] + _ECHOES:
            self._intake.refuse("another program speaks as we do: does a second uuv pilot run?")
        if not self._is_leaving:
            for instrument, reading in self._rig.poll(come_s, self._rate_b):
                try:
                    self._feed(reading, self._plan.instruments.get(NAMES[type(reading)], ""), come_s)
                except ValueError as error:  # arrays of another vehicle's shape
                    instrument.refuse(str(error))
                else:
                    self._log.read(come_s, reading)
                    if isinstance(reading, DvlReading):
                        self._intake.note_velocity(reading)
        self._handover.watch(self._intake.heard, now_s)

    def _take(self, sender: mavlink.Address, message: mavlink.MavMessage, come_s: float) -> None:
        self.tally.heard[message.name] += 1
        refused = self._intake.heard.refused.total()
        if not self._is_another(sender, message, come_s):
            told = self._intake.take(message.name, message.system, message.component, message.fields, come_s)
            for reading in () if self._is_leaving else told:
                self._feed(reading, f"{message.name} {message.system}/{message.component}", come_s)
        if self._check is not None:
            was_used = self._intake.heard.refused.total() == refused
            self._check.saw(message, come_s, self._intake.heard, was_used)
        self._log.saw(come_s, message)

    def _is_another(self, sender: mavlink.Address, message: mavlink.MavMessage, come_s: float) -> bool:
        """Whether somebody else than the vehicle speaks as its autopilot: what comes from another address
        than its heartbeats, while those come, is not used."""
        if (message.system, message.component) != (self._plan.system, AUTOPILOT):
            return False
        is_silent = come_s - self._intake.heard.vehicle_s > self._plan.limits.vehicle_s
        if message.name == "HEARTBEAT" and (self._speaker is None or is_silent):
            self._speaker = sender
            self._vehicle = self._endpoint.calls or sender
        if self._speaker in (None, sender):
            return False
        self._intake.refuse(f"a second sender speaks as system {self._plan.system}: {sender[0]}:{sender[1]}")
        return True

    def _find_start(self, now_s: float) -> None:
        """Begin where the walls say that the vehicle is."""
        if self._fix is None or self._fix.result is None:
            return
        self._start, self._fix = self._fix.result, None
        if self._start.refusal:
            return
        self._rig.look_around(False)
        mission = self._plan.mission
        place = self._intake.correct(self._start.place, self._start.turn_rad)
        if self._check is not None:
            self._check.begun(now_s)
        self._pilot.begin_again(dataclasses.replace(mission, start=place, spread=self._start.spread))
        self._lag_s, self._scans, self._measured_s["sonar"] = now_s, 0, -math.inf
        off_m, off = math.hypot(*self._start.shift), math.degrees(self._start.turn_rad)
        self.tell(f"start found by the walls, {off_m:.2f} m and {off:.1f} degrees from what was typed")

    def _misfit(self) -> str:
        """How the scans disagree with the walls; before the start was found nothing is compared."""
        if self._walls is None or self._fix is not None or self._start.refusal:
            return ""
        share = self._walls.look(self._pilot.stack.views)
        return f"{100 * share:.0f} % of the returns miss a wall" if share > MISFIT else ""

    def _feed(self, reading: SensorMessage, source: str, come_s: float) -> None:
        self._pilot.feed(dataclasses.replace(reading, time_s=reading.time_s - self._lag_s))
        if self._check is not None:
            self._check.read(reading, source, come_s)
        for one in (self._fix, self._calibration):
            if one is not None:
                one.feed(reading)
        if isinstance(reading, ImuReading):
            self._rate_b = reading.rate_b
        name = NAMES[type(reading)]
        if name == "sonar":
            self._scan_s = max(self._scan_s, reading.time_s)
        else:
            self._measured_s[name] = max(self._measured_s[name], reading.time_s)

    def _view(self, now_s: float, stalled_s: float, command: PilotCommand) -> safety.VehicleView:
        heard, limits = self._intake.heard, self._plan.limits
        surge, sway, heave, turn = (float(value) for value in command.velocity)
        x, y, z = (float(value) for value in command.pos_w)
        self._stalls = [row for row in self._stalls if now_s - row[0] <= safety.LATE_WINDOW_S]
        if stalled_s > safety.STALL_S:
            self._stalls.append((now_s, stalled_s))
        is_fresh = now_s - heard.vel_b_s <= limits.sensor_s["dvl"]
        turns = self._plan.arms and not self._sees_around
        looks_around = self._fix is not None and turns and now_s - self._fix.first_s >= _REST_S
        if self._fix is not None and looks_around and not self._look_rad_s:
            most_rad_s = _SWEEP_RAD_S if self._config.sensors.sonar.mechanical else _LOOK_RAD_S
            self._look_rad_s = most_rad_s * self._fix.way_round()
        return safety.VehicleView(
            now_s=now_s,
            wanted=(0.0, 0.0, 0.0, self._look_rad_s) if looks_around else (surge, sway, heave, turn),
            held=command.held,
            vehicle_age_s=now_s - heard.vehicle_s,
            operator_age_s=now_s - heard.operator_s,
            sensor_age_s={name: now_s - self._measured_s[name] for name in self._needed},
            pos_w=(x, y, z),
            rpy=heard.rpy if now_s - heard.rpy_s <= limits.sensor_s["imu"] else _UNKNOWN,
            speed_m_s=math.hypot(*heard.vel_b) if heard.vel_b and is_fresh else None,
            battery_v=heard.battery_v,
            battery_share=heard.battery_share,
            stalled_s=stalled_s,
            lost_command=self._handover.lost,
            late_s=sum(late_s for _, late_s in self._stalls),
            battery_age_s=now_s - heard.battery_s,
            unanswered_s=self._unanswered_s,
            moved=heard.jumped,
            misfit=self._misfit(),
            unchecked="" if self._fix is None or looks_around else self._fix.waits_for,
        )

    def _measured(self, now_s: float) -> safety.Velocity | None:
        """What may be fed back now; an axis that was not measured lately is NaN."""
        heard = self._intake.heard
        is_fresh = heard.vel_b is not None and now_s - heard.vel_b_s <= FEEDBACK_AGE_S
        turn = heard.yaw_rate if now_s - heard.yaw_rate_s <= FEEDBACK_AGE_S else math.nan
        return (*(heard.vel_b if heard.vel_b and is_fresh else _UNKNOWN), turn)

    def _note_answer(self, decision: safety.SafeDecision, view: safety.VehicleView) -> None:
        """For how long the vehicle was asked to move and did not; while it is held nothing is known."""
        asked_m_s = math.hypot(*decision.velocity[:2])
        if not (self._plan.arms and self._handover.engaged) or decision.action != safety.SafeAction.DRIVE:
            return
        moves = view.speed_m_s is None or view.speed_m_s >= _ANSWER * asked_m_s
        if moves or asked_m_s < _LEAST_ASKED_M_S:
            self._unanswered_s = 0.0
        else:
            self._unanswered_s += self._config.episode.control_dt_s

    def _say(self, now_s: float, order: mavlink.Order) -> None:
        was_sent = False
        if (self._plan.arms or order.kind in mavlink.HARMLESS) and self._vehicle is not None:
            was_sent = self._endpoint.send(self._codec.encode(order), self._vehicle)
            self._codec.sent(order)
        self.tally.said[order.kind] += 1
        self.tally.sent[order.kind] += was_sent
        self._log.said(now_s, order, was_sent)

    def _keep_in_touch(self, now_s: float) -> None:
        """A heartbeat a second; and what the pilot needs is asked for until it comes."""
        if self._vehicle is None or now_s - self._beat_s < 1.0:
            return
        self._beat_s = now_s
        self._say(now_s, mavlink.heartbeat())
        for order in () if self._check is None else self._check.asks():
            self._say(now_s, order)
        if now_s - self._asked_s >= 5.0 and self._intake.heard.vehicle_s > -math.inf:
            self._asked_s = now_s
            if (
                now_s - min(self._measured_s["imu"], self._measured_s["pressure"]) > 1.0
                or not self.tally.said[mavlink.HARMLESS[1]]
            ):
                for number, rate in _WANTED_HZ.items():
                    self._say(now_s, mavlink.ask_for(number, rate, self._plan.system))

    def _note(
        self, now_s: float, command: PilotCommand, decision: safety.SafeDecision, speed: float | None
    ) -> None:
        heard, self.last = self._intake.heard, decision
        self.tally.steps += 1
        self.tally.actions[decision.action.name] += 1
        for reason in decision.reasons:
            self.tally.reasons[reason.partition(":")[0]] += 1
        self._log.decided(now_s, command, decision, heard, speed)
        engaged, messages = self._handover.engaged, self.tally.heard.total()
        text = self._notes.look(now_s, decision, engaged, messages, heard)
        if self._calibration is not None and heard.vehicle_s > -math.inf:
            newest_s = self._measured_s | {"sonar": self._scan_s}
            missing = (name for name in ("imu", "dvl", "sonar") if now_s - newest_s[name] > DEAF_S)
            text = next((MISSING[name] for name in missing), self._calibration.says)
        if text and not (self._check is not None and decision.action == safety.SafeAction.DRIVE):
            self.tell(text)

    def tell(self, text: str) -> None:
        """A sentence for the operator; a terminal that is gone ends nothing."""
        try:
            if text != self._told:
                self._told = text
                self._note_to(text)
        except OSError:  # the terminal is gone
            self._note_to = lambda text: None

    def _farewell(self, now_s: float, command: PilotCommand) -> str:
        goal, radius = self._plan.mission.goal, self._config.episode.goal_radius_m
        sure_m = radius - min(0.5 * radius, max(2.0 * command.place_sigma_m, _NEARER_M))
        if self._handover.engaged and math.dist(command.pos_w.tolist(), goal) <= sure_m:
            return _REACHED
        if self._calibration is not None and (self._calibration.found or self._calibration.refusal):
            return _CALIBRATED if self._calibration.found else self._calibration.refusal
        return "time is up" if now_s >= self._plan.seconds else ""

    def _checked(self) -> dict[str, Any] | None:
        """What a check found (``Preflight.document``); None: it was a flight."""
        if self._check is None:
            return None
        start, jumps = (self._sought, self._start), self._clock_jumps - self._jumps_before
        heard, spent_s = self._intake.heard, self._heard_s
        return self._check.document(spent_s, heard, self._needed, self._rig.document(), start, jumps)

    def document(self) -> dict[str, Any]:
        tally, heard = self.tally, self._intake.heard
        check, calibration = self._checked(), self._calibration
        calibrated = calibration.document(self._intake.heading) if calibration else None
        reasons = list(self.last.reasons)
        return {
            "schema": 1,
            "dry_run": not self._plan.arms,
            "log": str(self._log.path),
            "log_trouble": self._log.trouble,
            "steps": tally.steps,
            "ended": "; ".join(reasons) or "it was driving",
            "reached": reasons == [_REACHED],
            "safe": self.failure is None
            and not self._start.refusal
            and (not self._handover.engaged or bool(reasons and reasons[0] in _FAREWELLS)),
            "interrupted": _INTERRUPTED in reasons,
            "mode": mavlink.MODE_NAMES.get(heard.mode, "none"),
            "driven_in": mavlink.MODE_NAMES[self._handover.mode] if self._handover.engaged else "",
            "fallback": self._handover.mode == mavlink.ALT_HOLD,
            "actions": {action.name: tally.actions[action.name] for action in safety.SafeAction},
            "reasons": dict(tally.reasons),
            "heard": dict(tally.heard),
            "broken": self._codec.broken,
            "refused": dict(heard.refused),
            "said": {kind: {"said": said, "sent": tally.sent[kind]} for kind, said in tally.said.items()},
            "instruments": self._rig.document(),
            "check": check,
            "calibration": calibrated,
            "ready": (check or calibrated or {"ready": True})["ready"],
            "sensors": {name: dataclasses.asdict(row) for name, row in self._pilot.tallies.items()},
        }


def fly(
    config: Config, tree: FlatTree, plan: FlightPlan, note: Callable[[str], None]
) -> tuple[dict[str, Any], BaseException | None]:
    """The document of a flight, and the error of this program that ended it. Raises LinkError, LogError."""
    mavlink.MavCodec(plan.system, COMPANION)  # refused before a minute of compiling
    config = as_driven(config, plan)
    followed = mavlink.FollowedEndpoint(plan.place, plan.system) if plan.rate == 0 else None
    with followed or mavlink.Endpoint(plan.place) as endpoint, Rig(config, plan.instruments) as rig:
        pilot = warmed(config, tree, plan.mission)
        about = {"dry_run": str(not plan.arms), "limits": str(plan.limits), "mission": str(plan.mission)}
        with StopEvent(is_last=False) as stop:
            log = LinkLog(plan.log, about)
            now, sleep = time.monotonic, time.sleep
            if followed:
                now, sleep = followed.now, partial(followed.sleep, stop=stop)
            endpoint.forget()  # what came while kernels were compiled
            rig.forget(0.0)
            fix = None if plan.purpose == "calibrate" else StartFix(config, plan.mission.start)
            loop = OnboardLoop(config, pilot, plan, endpoint, log, now, sleep, note, fix, rig)
            dry = f"{_DRY[plan.purpose]}: no order that moves the vehicle is sent"
            what = "ARMS AND DRIVES the vehicle" if plan.arms else dry
            where = "speaks to" if plan.place.calls else "listens at"
            ends = "gives the vehicle back" if plan.purpose == "fly" else "ends it"
            loop.tell(f"{what}; {where} {plan.place.host}:{plan.place.port}; Ctrl-C {ends}")
            try:
                loop.run(stop)
            finally:
                log.close()
        return loop.document(), loop.failure


_SCAN_S = 0.1  # between two scans, at least: as a multibeam's, and as MAVLink tells them


def as_driven(config: Config, plan: FlightPlan) -> Config:
    """The stack plans for depths that the fence allows, takes scans to come no more often than they do, and
    believes in no camera where no instrument has one."""
    (low, high), limits = config.world.tank.z_m, plan.limits
    room = min(high + limits.depth_m[0], -limits.depth_m[1] - low)
    gap = max(config.behavior.edge_gap_m, room + safety.FENCE_ROOM_M[1])
    keys: dict[str, dict[str, object]] = {"behavior": {"edge_gap_m": gap}}
    if not (sonar := config.sensors.sonar).mechanical:
        period = max(sonar.period_steps, round(_SCAN_S / config.episode.control_dt_s))
        keys["sensors"] = {"sonar": sonar.model_copy(update={"period_steps": period})}
    if not plan.instruments.get("sonar", "").startswith(HAVE_IMAGES):
        keys |= {"camera_tracking": {"use_camera": False}, "height": {"use_camera": False}}
        keys["mapping"] = {"depth_hit": 0.0}
    update = {name: getattr(config, name).model_copy(update=own) for name, own in keys.items()}
    return config.model_copy(update=update)


def warmed(config: Config, tree: FlatTree, mission: Mission) -> OnboardPilot:
    """A pilot whose kernels are compiled, at its first step."""
    sim = Sim(config, 1, tree)
    pilot = OnboardPilot(sim, mission)
    for _ in range(3):
        pilot.tick()
    return OnboardPilot(sim, mission)


EVERY_S = 1.0  # between two sentences
DEAF_S = 5.0  # nothing at all has come for so long


class FlightNotes:
    """``look`` is called in every step."""

    def __init__(self, place: str, operator: int) -> None:
        self._place, self._operator = place, operator
        self._told: tuple[str, ...] = ()
        self._told_s = float("-inf")
        self._missing: set[str] = set()

    def look(
        self, now_s: float, decision: safety.SafeDecision, is_engaged: bool, messages: int, heard: Heard
    ) -> str:
        """A sentence about what is new, or ''. ``messages``: heard so far."""
        if now_s >= DEAF_S and not is_engaged:
            missing = waiting_for(heard, messages, self._place, self._operator)
            if missing and missing not in self._missing:
                self._missing.add(missing)
                return missing
        if not messages:
            return ""
        wrong = heard.left_out() if not is_engaged else ""
        reasons = (reason.partition(":")[0] for reason in decision.reasons)
        what = (str(is_engaged), decision.action.name, *reasons, *(heard.refused if wrong else ()))
        if what == self._told or now_s - self._told_s < EVERY_S:
            return ""
        self._told, self._told_s = what, now_s
        if decision.action == safety.SafeAction.DRIVE:
            return "drives" if is_engaged else "nothing is wrong: takes the vehicle"
        doing = decision.action.name.lower().replace("_", " ") if is_engaged else "waits"
        return f"{doing}: {'; '.join(decision.reasons)}" + (f" (not used: {wrong})" if wrong else "")
