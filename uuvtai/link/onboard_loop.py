"""``uuv pilot``: fifty times a second hear, think, decide, speak. Everything it decides is elsewhere;
what it says meanwhile is here."""

from __future__ import annotations

import dataclasses
import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from uuvtai.config import Config
from uuvtai.link.dialect import MavCodec
from uuvtai.link.endpoint import Address, Endpoint
from uuvtai.link.flight_plan import FlightPlan
from uuvtai.link.followed_endpoint import FollowedEndpoint
from uuvtai.link.handover import Handover
from uuvtai.link.intake import Intake
from uuvtai.link.link_log import LinkLog
from uuvtai.link.orders import ALT_HOLD, HARMLESS, MODE_NAMES, Order, ask_for, heartbeat
from uuvtai.link.safety import (
    STALL_S,
    STOP,
    SafeAction,
    SafeDecision,
    SafetyMemory,
    VehicleView,
    Velocity,
    decide,
)
from uuvtai.pilot import Mission, OnboardPilot, PilotCommand
from uuvtai.pilot.sensor_messages import NAMES
from uuvtai.sim import Sim
from uuvtai.tree import FlatTree

COMPONENT = 191
"""MAV_COMP_ID_ONBOARD_COMPUTER"""
_WANTED_HZ = {30: 50.0, 27: 50.0, 29: 10.0, 137: 10.0, 32: 20.0, 1: 2.0}
"""message id -> rate: ATTITUDE, RAW_IMU, SCALED_PRESSURE and 2, LOCAL_POSITION_NED, SYS_STATUS"""
_GIVE_BACK_S = 6.0
_REACHED = "goal reached"
_FAREWELLS = (_REACHED, "time is up", "interrupted")


@dataclass
class FlightTally:
    """What happened, in numbers."""

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
        endpoint: Endpoint,
        log: LinkLog,
        now: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
        note: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._config, self._pilot, self._plan, self._endpoint, self._log = config, pilot, plan, endpoint, log
        self._now, self._sleep, self._note_to = now, sleep, note
        self._notes = FlightNotes(f"{plan.place.host}:{plan.place.port}")
        self._rate = plan.rate or 1.0
        self._codec = MavCodec(plan.system, COMPONENT, plan.operator)
        self._intake = Intake(
            config, plan.mission.start, plan.heading_rad, plan.system, plan.operator, plan.senders
        )
        self._handover = Handover(plan.system, plan.limits, pretended=not plan.arms)
        self._memory, self.tally = SafetyMemory(), FlightTally()
        self._needed = [name for name in NAMES.values() if name != "depth"]
        if config.sensors.localization == "estimated":
            self._needed.remove("position")
        self._measured_s = dict.fromkeys(NAMES.values(), -math.inf)
        self._vehicle: Address | None = endpoint.calls
        self._asked_s = self._beat_s = -math.inf
        self._clock_jumps = endpoint.clock_jumps
        self._lag_s = 0.0
        """pilot's clock behind ours: what was lost in stalls"""
        self.last = SafeDecision(SafeAction.HOLD, STOP, ("nothing was decided yet",))

    def run(self) -> None:
        """Until the goal is reached, the time is up, the vehicle was given back, or Ctrl-C; then it gives the
        vehicle back."""
        begun, dt = self._now(), self._config.episode.control_dt_s
        due_s, farewell, until_s = 0.0, "", math.inf
        while True:
            now_s = (self._now() - begun) * self._rate
            stalled_s = max(0.0, now_s - due_s)
            if stalled_s > STALL_S:
                self._lag_s, due_s = self._lag_s + stalled_s, now_s
            try:
                command = self.step(now_s, stalled_s, farewell)
                if not farewell and (farewell := self._farewell(now_s, command)):
                    until_s = now_s + _GIVE_BACK_S
                if self._handover.ended or now_s >= until_s:
                    return
                due_s += dt
                wait_s = due_s / self._rate - (self._now() - begun)
                if wait_s > 0:
                    self._sleep(wait_s)
            except KeyboardInterrupt:
                if farewell:
                    raise
                farewell, until_s = "interrupted", now_s + _GIVE_BACK_S

    def step(self, now_s: float, stalled_s: float = 0.0, farewell: str = "") -> PilotCommand:
        """One step: hear, think, decide, speak."""
        self._log.begin_step()
        self._hear(now_s)
        command = self._pilot.tick()
        view = self._view(now_s, stalled_s, command)
        decision, memory = decide(view, self._memory, self._plan.limits)
        self._memory = memory if self._handover.engaged else SafetyMemory(memory.since_s)
        if farewell:
            decision, self._handover.leaving = SafeDecision(SafeAction.HAND_BACK, STOP, (farewell,)), True
        heard = self._intake.heard
        for order in self._handover.orders(decision, now_s, heard.mode, heard.is_armed, self._measured()):
            self._say(now_s, order)
        self._keep_in_touch(now_s)
        self._note(now_s, command, decision, view.speed_m_s)
        return command

    def _hear(self, now_s: float) -> None:
        datagrams = self._endpoint.receive()
        if self._endpoint.clock_jumps != self._clock_jumps:
            self._clock_jumps = self._endpoint.clock_jumps
            self._intake.forget_clocks()
        for sender, datagram in datagrams:
            for message in self._codec.decode(datagram):
                self.tally.heard[message.name] += 1
                self._log.saw(now_s, message)
                before = self._intake.heard.vehicle_s
                told = self._intake.take(
                    message.name, message.system, message.component, message.fields, now_s
                )
                if self._intake.heard.vehicle_s > before and (
                    self._vehicle is None or now_s - before > self._plan.limits.vehicle_s
                ):
                    self._vehicle = self._endpoint.calls or sender
                for reading in told:
                    name = NAMES[type(reading)]
                    self._measured_s[name] = max(self._measured_s[name], reading.time_s)
                    self._pilot.feed(dataclasses.replace(reading, time_s=reading.time_s - self._lag_s))
        self._handover.watch(self._intake.heard.mode, self._intake.heard.is_armed)

    def _view(self, now_s: float, stalled_s: float, command: PilotCommand) -> VehicleView:
        heard = self._intake.heard
        surge, sway, heave, turn = (float(value) for value in command.velocity)
        x, y, z = (float(value) for value in command.pos_w)
        return VehicleView(
            now_s=now_s,
            wanted=(surge, sway, heave, turn),
            held=command.held,
            vehicle_age_s=now_s - heard.vehicle_s,
            operator_age_s=now_s - heard.operator_s,
            sensor_age_s={name: now_s - self._measured_s[name] for name in self._needed},
            pos_w=(x, y, z),
            rpy=heard.rpy,
            speed_m_s=math.hypot(*heard.vel_b) if heard.vel_b else 0.0,
            battery_v=heard.battery_v,
            battery_share=heard.battery_share,
            stalled_s=stalled_s,
            lost_command=self._handover.lost,
        )

    def _measured(self) -> Velocity | None:
        heard = self._intake.heard
        return (*heard.vel_b, heard.yaw_rate) if heard.vel_b else None

    def _say(self, now_s: float, order: Order) -> None:
        was_sent = False
        if (self._plan.arms or order.kind in HARMLESS) and self._vehicle is not None:
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
        self._say(now_s, heartbeat())
        if now_s - self._asked_s >= 5.0 and self._intake.heard.vehicle_s > -math.inf:
            self._asked_s = now_s
            if (
                now_s - min(self._measured_s["imu"], self._measured_s["pressure"]) > 1.0
                or not self.tally.said[HARMLESS[1]]
            ):
                for number, rate in _WANTED_HZ.items():
                    self._say(now_s, ask_for(number, rate, self._plan.system))

    def _note(self, now_s: float, command: PilotCommand, decision: SafeDecision, speed: float) -> None:
        heard, self.last = self._intake.heard, decision
        self.tally.steps += 1
        self.tally.actions[decision.action.name] += 1
        for reason in decision.reasons:
            self.tally.reasons[reason.partition(":")[0]] += 1
        self._log.decided(now_s, command, decision, heard.mode, heard.is_armed, speed)
        wrong = ", ".join(heard.refused)
        engaged, messages = self._handover.engaged, self.tally.heard.total()
        if text := self._notes.look(now_s, decision, engaged, messages, wrong):
            self._note_to(text)

    def _farewell(self, now_s: float, command: PilotCommand) -> str:
        goal, radius = self._plan.mission.goal, self._config.episode.goal_radius_m
        if self._handover.engaged and math.dist(command.pos_w.tolist(), goal) <= radius:
            return _REACHED
        return "time is up" if now_s >= self._plan.seconds else ""

    def document(self) -> dict[str, Any]:
        """What ``uuv pilot --json`` prints."""
        tally, heard = self.tally, self._intake.heard
        reasons = list(self.last.reasons)
        return {
            "schema": 1,
            "dry_run": not self._plan.arms,
            "log": str(self._log.path),
            "log_trouble": self._log.trouble,
            "steps": tally.steps,
            "ended": "; ".join(reasons) or "it was driving",
            "reached": reasons == [_REACHED],
            "safe": not self._handover.engaged or bool(reasons and reasons[0] in _FAREWELLS),
            "mode": MODE_NAMES.get(heard.mode, "none"),
            "driven_in": MODE_NAMES[self._handover.mode] if self._handover.engaged else "",
            "fallback": self._handover.mode == ALT_HOLD,
            "actions": {action.name: tally.actions[action.name] for action in SafeAction},
            "reasons": dict(tally.reasons),
            "heard": dict(tally.heard),
            "broken": self._codec.broken,
            "refused": dict(heard.refused),
            "said": {kind: {"said": said, "sent": tally.sent[kind]} for kind, said in tally.said.items()},
            "sensors": {name: dataclasses.asdict(row) for name, row in self._pilot.tallies.items()},
        }


def fly(config: Config, tree: FlatTree, plan: FlightPlan, note: Callable[[str], None]) -> dict[str, Any]:
    """The document of a flight. Raises LinkError, LogError."""
    MavCodec(plan.system, COMPONENT)  # refused before a minute of compiling
    followed = FollowedEndpoint(plan.place, plan.system) if plan.rate == 0 else None
    with followed or Endpoint(plan.place) as endpoint:
        pilot = warmed(config, tree, plan.mission)
        about = {"dry_run": str(not plan.arms), "limits": str(plan.limits), "mission": str(plan.mission)}
        log = LinkLog(plan.log, about)
        clock = (followed.now, followed.sleep) if followed else (time.monotonic, time.sleep)
        endpoint.forget()  # what came while kernels were compiled
        loop = OnboardLoop(config, pilot, plan, endpoint, log, *clock, note)
        what = (
            "ARMS AND DRIVES the vehicle" if plan.arms else "dry run: no order that moves the vehicle is sent"
        )
        where = "speaks to" if plan.place.calls else "listens at"
        note(f"{what}; {where} {plan.place.host}:{plan.place.port}; Ctrl-C gives the vehicle back")
        try:
            loop.run()
        finally:
            log.close()
        return loop.document()


def warmed(config: Config, tree: FlatTree, mission: Mission) -> OnboardPilot:
    """A pilot whose kernels are compiled, at its first step."""
    sim = Sim(config, 1, tree)
    pilot = OnboardPilot(sim, mission)
    for _ in range(3):
        pilot.tick()
    return OnboardPilot(sim, mission)


EVERY_S = 1.0
"""between two sentences"""
DEAF_S = 5.0
"""nothing at all has come for so long"""


class FlightNotes:
    """``look`` is called in every step."""

    def __init__(self, place: str) -> None:
        self._place = place
        self._told: tuple[str, ...] = ()
        self._told_s = float("-inf")
        self._is_deaf = False

    def look(self, now_s: float, decision: SafeDecision, is_engaged: bool, messages: int, wrong: str) -> str:
        """A sentence about what is new, or ''. ``messages``: heard so far; ``wrong``: what was refused."""
        if not messages:
            if now_s < DEAF_S or self._is_deaf:
                return ""
            self._is_deaf = True
            return (
                f"nothing has come at {self._place} yet: does the vehicle (ardusub --serial1 "
                "udpclient:HOST:PORT, or the router) send there? --mavlink names the place"
            )
        what = (str(is_engaged), decision.action.name, *(r.partition(":")[0] for r in decision.reasons))
        if what == self._told or now_s - self._told_s < EVERY_S:
            return ""
        self._told, self._told_s = what, now_s
        if decision.action == SafeAction.DRIVE:
            return "drives" if is_engaged else "nothing is wrong: takes the vehicle"
        doing = decision.action.name.lower().replace("_", " ") if is_engaged else "waits"
        return f"{doing}: {'; '.join(decision.reasons)}" + (f" ({wrong})" if wrong else "")
