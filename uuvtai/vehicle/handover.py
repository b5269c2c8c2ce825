"""From the first order to the last: who has the vehicle, and what is said to it in every step."""

from __future__ import annotations

import math

from uuvtai.vehicle import mavlink
from uuvtai.vehicle.safety import STOP, SafeAction, SafeDecision, SafetyLimits, Velocity
from uuvtai.vehicle.telemetry import Heard

ORDER_S = 0.1  # between two velocities; ArduSub stops 3 s after the last
REPEAT_S, REPEATS = 1.0, 5  # a mode or the arming is asked for again so often, so many times
STICKS_S = 1.0  # age of the operator's sticks that counts as none
_ACK_S = 0.1  # a heartbeat that comes so long after a request was granted tells what came of it


class Handover:
    """Takes the vehicle over, tells it what was decided, gives it back.

    It begins when a decision is to drive: arm, then GUIDED, or else ALT_HOLD with sticks. From the first
    order on, a mode that nobody here asked for, a vehicle that disarms, or an operator at the sticks means
    that somebody else has it: ``lost`` says so. Whatever ends it, ``orders`` stops the vehicle and asks for
    ALT_HOLD until a heartbeat says that it left our mode; where somebody else chose the mode nothing is said.
    ``pretended``: nobody listens (a dry run), so every request counts as granted.
    """

    def __init__(self, system: int, limits: SafetyLimits, pretended: bool) -> None:
        self.engaged = False  # whether a velocity has been asked for
        self.ended = False  # whether the vehicle was given back, or never had; nothing is said any more
        self.lost = ""
        self.mode = mavlink.GUIDED  # in which it is driven
        self._system, self._limits, self._pretended = system, limits, pretended
        self._leaving = False
        self._asked: dict[str, tuple[float, int]] = {}  # request -> (when it was asked for last, how often)
        self._modes: set[int] = set()  # asked for
        self._before = -1  # mode at the first order
        self._took = self._was_armed = False  # whether it was ever in a mode that was asked for; armed
        self._spoke_s = -math.inf

    @property
    def has_asked(self) -> bool:
        """Whether anything was said that moves the vehicle, arms it or changes its mode."""
        return bool(self._asked)

    def watch(self, heard: Heard, now_s: float) -> None:
        """Look whether the vehicle still does what it was told."""
        if self._pretended or self.ended or self.lost or not self.has_asked:
            return
        self._note_answers(heard)
        self._took |= heard.mode in self._modes
        self._was_armed |= heard.is_armed
        if heard.mode not in self._modes and (self._took or heard.mode != self._before):
            self.lost = f"the mode is {mavlink.MODE_NAMES.get(heard.mode, heard.mode)} now"
        elif self._was_armed and not heard.is_armed:
            self.lost = "it is disarmed"
        elif self.mode == mavlink.ALT_HOLD and now_s - heard.sticks_s <= STICKS_S:
            self.lost = "the operator's sticks are heard"
        elif now_s - heard.sticks_moved_s <= STICKS_S:
            self.lost = "the operator moves the sticks"

    def _note_answers(self, heard: Heard) -> None:
        """What was granted, and is not so at the next heartbeat, was taken back by somebody."""
        for command, what in ((mavlink.DO_SET_MODE, f"mode {self.mode}"), (mavlink.ARM_DISARM, "arm")):
            asked_s, _ = self._asked.get(what, (math.inf, 0))
            if asked_s <= heard.granted_s.get(command, -math.inf) <= heard.vehicle_s - _ACK_S:
                self._took |= command == mavlink.DO_SET_MODE
                self._was_armed |= command == mavlink.ARM_DISARM

    def orders(
        self, decision: SafeDecision, now_s: float, heard: Heard, measured: Velocity | None
    ) -> list[mavlink.Order]:
        """What to say in this step. ``measured``: velocity now, NaN or None = not known."""
        if self.ended:
            return []
        grave = decision.action == SafeAction.HAND_BACK and (self.has_asked or bool(self.lost))
        if self._leaving or grave or (decision.action == SafeAction.SURFACE and not self.engaged):
            return self._leave(now_s, heard) if self.has_asked else []
        if decision.action == SafeAction.SURFACE:
            return self._surface(now_s, heard)
        if self.engaged:
            is_driving = decision.action == SafeAction.DRIVE
            return self._velocity(decision.velocity, now_s, measured if is_driving else None)
        return self._take(now_s, heard) if decision.action == SafeAction.DRIVE else []

    def leave(self, now_s: float, heard: Heard) -> list[mavlink.Order]:
        """What to say from now on, whatever was decided: stop, and the mode that gives the vehicle back."""
        self._leaving = True
        if not self.has_asked:
            self.ended = True
        return [] if self.ended else self._leave(now_s, heard)

    def last_words(self) -> list[mavlink.Order]:
        """Stop and hand back, for the case that nothing else works any more."""
        if not self.has_asked or self.lost:
            return []
        stop = mavlink.set_velocity(STOP, 0.0, self._system, self._limits)
        return [stop, mavlink.set_mode(mavlink.ALT_HOLD, self._system)]

    def _take(self, now_s: float, heard: Heard) -> list[mavlink.Order]:
        if not self.has_asked:
            self._before = heard.mode
        if self._pretended:
            self.engaged, self._asked["arm"] = True, (now_s, 1)
            return [mavlink.arm(self._system), mavlink.set_mode(mavlink.GUIDED, self._system)]
        if now_s - heard.sticks_moved_s <= STICKS_S:  # the operator drives
            return []
        if not heard.is_armed:
            if (found := self._repeated("arm", now_s, mavlink.arm(self._system))) is not None:
                return found
            self.lost = "it does not arm"
            return []
        if heard.mode == self.mode:
            self._asked.setdefault("arm", (now_s, 0))
            self._modes.add(self.mode)
            self.engaged = self._took = True
            return []
        self._modes.add(self.mode)
        asked = self._repeated(f"mode {self.mode}", now_s, mavlink.set_mode(self.mode, self._system))
        if asked is not None:
            return asked
        if self.mode == mavlink.GUIDED:
            self.mode = mavlink.ALT_HOLD
        else:
            self.lost = "it takes neither GUIDED nor ALT_HOLD"
        return []

    def _velocity(self, velocity: Velocity, now_s: float, measured: Velocity | None) -> list[mavlink.Order]:
        if now_s - self._spoke_s < ORDER_S - 1e-6:
            return []
        self._spoke_s = now_s
        if self.mode == mavlink.GUIDED:
            return [mavlink.set_velocity(velocity, now_s, self._system, self._limits)]
        return [mavlink.push_sticks(velocity, measured, self._system, self._limits)]

    def _surface(self, now_s: float, heard: Heard) -> list[mavlink.Order]:
        if heard.mode == mavlink.SURFACE:
            self.ended = True
            return []
        self._modes.add(mavlink.SURFACE)
        found = self._repeated("surface", now_s, mavlink.set_mode(mavlink.SURFACE, self._system))
        if found is None:
            self._leaving = True
            return self._leave(now_s, heard)
        self.ended = self._pretended
        return [*found, *self._velocity(STOP, now_s, None)]

    def _leave(self, now_s: float, heard: Heard) -> list[mavlink.Order]:
        """Stop, then ALT_HOLD, until a heartbeat says that the vehicle has left our mode. A vehicle in a mode
        that somebody else chose, or whose sticks the operator holds, is left alone."""
        left = heard.mode != mavlink.GUIDED and (self._took or heard.mode != self._before)
        said_s, _ = self._asked.setdefault("back", (-math.inf, 0))
        if self.lost and (left or self.mode == mavlink.ALT_HOLD or not self._modes):
            self.ended = True
        elif heard.vehicle_s > said_s > -math.inf and (left or heard.mode == mavlink.ALT_HOLD):
            self.ended = True
        if self.ended:
            return []
        if math.isinf(said_s):  # the stop comes first
            self._spoke_s = -math.inf
        found = self._repeated("back", now_s, mavlink.set_mode(mavlink.ALT_HOLD, self._system))
        self.ended = found is None or self._pretended
        return [] if found is None else [*self._velocity(STOP, now_s, None), *found]

    def _repeated(self, what: str, now_s: float, order: mavlink.Order) -> list[mavlink.Order] | None:
        """The order where it is due, nothing while waiting for an answer; None = asked for in vain."""
        last_s, count = self._asked.get(what, (-math.inf, 0))
        if now_s - last_s < REPEAT_S:
            return []
        if count >= REPEATS:
            return None
        self._asked[what] = (now_s, count + 1)
        return [order]
