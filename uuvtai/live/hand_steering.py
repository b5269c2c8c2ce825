"""From keys to a command: a key acts while it is held, which a terminal tells by sending it over and over."""

from __future__ import annotations

import numpy as np

from uuvtai.live.keyboard import DOWN, LEFT, RIGHT, UP

SURGE, SWAY, HEAVE, YAW = range(4)
AXES = {
    "w": (SURGE, 1), "s": (SURGE, -1), UP: (SURGE, 1), DOWN: (SURGE, -1),
    "a": (SWAY, 1), "d": (SWAY, -1),
    "r": (HEAVE, 1), "f": (HEAVE, -1),
    "q": (YAW, 1), "e": (YAW, -1), LEFT: (YAW, 1), RIGHT: (YAW, -1),
}  # fmt: skip
"""axis of the action and sign, by key; ahead, left, up and counter-clockwise are positive (ROS, REP 103)"""
STOP = " "
HELP = """w s ahead, back   a d left, right   r f up, down   q e turn   arrows too
1-9 how fast   space stop   Ctrl-C end"""

_HELD_S = 0.6
"""a terminal sends a held key again after up to half a second for the first time"""


class HandSteering:
    """What the hands ask for."""

    def __init__(self, share: float = 0.6) -> None:
        """``share`` of the vehicle's limits that a key asks for."""
        self.share = share
        self._sign, self._until_s = np.zeros(4, np.float32), np.full(4, -np.inf)

    def press(self, keys: list[str], now_s: float) -> None:
        """Take in keys pressed by now; those that mean nothing do nothing."""
        for key in keys:
            if (name := key.lower()) in AXES:
                axis, sign = AXES[name]
                self._sign[axis], self._until_s[axis] = sign, now_s + _HELD_S
            elif key == STOP:
                self.stop()
            elif key in tuple("123456789"):
                self.share = int(key) / 9

    def stop(self) -> None:
        """Let go of everything."""
        self._until_s[:] = -np.inf

    def action(self, now_s: float, tilt: np.ndarray | None = None) -> np.ndarray:
        """(4,) surge, sway, heave, yaw rate in parts of the vehicle's limits; ``tilt`` (4,): where sticks
        are, which outweigh keys where they are not at rest."""
        asked = np.where(now_s < self._until_s, self._sign, 0.0)
        if tilt is not None:
            asked = np.where(tilt != 0, tilt, asked)
        return (self.share * asked).astype(np.float32)
