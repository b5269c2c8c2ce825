"""From the first order to the last: who has the vehicle, and what is said to it in every step."""

from __future__ import annotations

from uuvtai.link.orders import (
    ALT_HOLD,
    GUIDED,
    MODE_NAMES,
    SURFACE,
    Order,
    arm,
    push_sticks,
    set_mode,
    set_velocity,
)
from uuvtai.link.safety import STOP, SafeAction, SafeDecision, SafetyLimits, Velocity

ORDER_S = 0.1
"""between two velocities; ArduSub stops 3 s after the last"""
REPEAT_S, REPEATS = 1.0, 5
"""a mode or the arming is asked for again so often, so many times"""


class Handover:
    """Takes the vehicle over, tells it what was decided, gives it back.

    It begins when a decision is to drive: arm, then GUIDED, or else ALT_HOLD with sticks. A mode that is
    neither ours nor what we asked for, or a disarmed vehicle, means that somebody else has it: ``lost`` says
    so, and nothing is said any more. ``pretended``: nobody listens (a dry run), so every request counts as
    granted.
    """

    def __init__(self, system: int, limits: SafetyLimits, pretended: bool) -> None:
        self.engaged = False
        """whether a velocity has been asked for"""
        self.ended = False
        """whether the vehicle was given back, or never had; nothing is said any more"""
        self.leaving = False
        """whether it is to end, whatever was decided"""
        self.lost = ""
        self.mode = GUIDED
        """in which it is driven"""
        self._system, self._limits, self._pretended = system, limits, pretended
        self._asked: dict[str, tuple[float, int]] = {}
        self._spoke_s = float("-inf")

    def watch(self, mode: int, is_armed: bool) -> None:
        """Look whether the vehicle still does what it was told."""
        if self._pretended or not self.engaged or self.ended:
            return
        ours = (self.mode, SURFACE) if "surface" in self._asked else (self.mode,)
        if mode not in ours:
            self.lost = f"the mode is {MODE_NAMES.get(mode, mode)} now"
        elif not is_armed:
            self.lost = "it is disarmed"

    def orders(
        self, decision: SafeDecision, now_s: float, mode: int, is_armed: bool, measured: Velocity | None
    ) -> list[Order]:
        """What to say in this step."""
        if self.ended:
            return []
        if self.leaving or (decision.action == SafeAction.HAND_BACK and (self.engaged or self.lost)):
            return self._give_back(now_s, mode)
        if decision.action == SafeAction.SURFACE:
            return self._surface(now_s, mode)
        if not self.engaged:
            if decision.action != SafeAction.DRIVE:
                return []
            return self._take(now_s, mode, is_armed)
        return self._velocity(decision.velocity, now_s, measured)

    def _take(self, now_s: float, mode: int, is_armed: bool) -> list[Order]:
        if self._pretended:
            self.engaged = True
            return [arm(self._system), set_mode(GUIDED, self._system)]
        if not is_armed:
            if (found := self._repeated("arm", now_s, arm(self._system))) is not None:
                return found
            self.lost = "it does not arm"
            return []
        if mode == self.mode:
            self.engaged = True
            return []
        if (
            found := self._repeated(f"mode {self.mode}", now_s, set_mode(self.mode, self._system))
        ) is not None:
            return found
        if self.mode == GUIDED:
            self.mode = ALT_HOLD
        else:
            self.lost = "it takes neither GUIDED nor ALT_HOLD"
        return []

    def _velocity(self, velocity: Velocity, now_s: float, measured: Velocity | None) -> list[Order]:
        if now_s - self._spoke_s < ORDER_S - 1e-6:
            return []
        self._spoke_s = now_s
        if self.mode == GUIDED:
            return [set_velocity(velocity, now_s, self._system, self._limits)]
        return [push_sticks(velocity, measured, self._system, self._limits)]

    def _surface(self, now_s: float, mode: int) -> list[Order]:
        if not self.engaged:
            return []
        if mode == SURFACE:
            self.ended = True
            return []
        found = self._repeated("surface", now_s, set_mode(SURFACE, self._system))
        if found is None or self._pretended:
            self.ended = True
        return [*(found or []), *self._velocity(STOP, now_s, None)]

    def _give_back(self, now_s: float, mode: int) -> list[Order]:
        if not self._asked_for_anything or self.mode != GUIDED or (mode != GUIDED and not self._pretended):
            self.ended = True
            sticks = self.engaged and self.mode == ALT_HOLD and mode == ALT_HOLD
            return [push_sticks(STOP, None, self._system, self._limits)] if sticks else []
        found = self._repeated("back", now_s, set_mode(ALT_HOLD, self._system))
        if found is None or self._pretended:
            self.ended = True
        return found or []

    @property
    def _asked_for_anything(self) -> bool:
        return bool(self._asked) or self.engaged

    def _repeated(self, what: str, now_s: float, order: Order) -> list[Order] | None:
        """The order where it is due, nothing while waiting for an answer; None = asked for in vain."""
        last_s, count = self._asked.get(what, (float("-inf"), 0))
        if now_s - last_s < REPEAT_S:
            return []
        if count >= REPEATS:
            return None
        self._asked[what] = (now_s, count + 1)
        return [order]
