"""What ``uuv pilot`` says while it runs: what it waits for, and what it does from when on. Pure."""

from __future__ import annotations

from uuvtai.link.safety import SafeAction, SafeDecision

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
