"""A gamepad's sticks, by SDL (pygame-ce), which knows where each maker puts them."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol

import numpy as np

from uuvtai.live.viewer_server import LiveError

EXTRA = "uuvtai[gamepad]"
STICKS_HELP = "left stick ahead, back, left, right   right stick turn, up, down"

_FULL = 32767
_DEAD = 0.15
"""share of its way that a worn stick rests at"""


class Sticks(Protocol):
    """Where sticks are."""

    def tilted(self) -> np.ndarray:
        """(4,) surge, sway, heave, yaw rate in -1 to 1; exactly 0 where a stick rests."""
        ...


class Gamepad:
    """The sticks of one game controller."""

    def __init__(self, pygame: Any, controller: Any) -> None:
        """``controller``: one of ``pygame._sdl2.controller``."""
        self._pygame, self._controller = pygame, controller

    def tilted(self) -> np.ndarray:
        """(4,) where the sticks are now; all 0 once the gamepad is unplugged. SDL counts right and down as
        positive, a vehicle left and up (ROS, REP 103)."""
        self._pygame.event.pump()
        if not self._controller.attached():
            return np.zeros(4, np.float32)
        names = ("LEFTY", "LEFTX", "RIGHTY", "RIGHTX")
        axes = [getattr(self._pygame, f"CONTROLLER_AXIS_{name}") for name in names]
        return -without_rest(np.array([self._controller.get_axis(axis) / _FULL for axis in axes]))


def without_rest(tilt: np.ndarray) -> np.ndarray:
    """Tilts (-1 to 1) that begin at 0 where the dead zone ends, float32."""
    beyond = np.clip((np.abs(tilt) - _DEAD) / (1.0 - _DEAD), 0.0, 1.0)
    return (np.sign(tilt) * beyond).astype(np.float32)


@contextmanager
def gamepad() -> Iterator[Sticks]:
    """The first gamepad that is connected. Raises LiveError where there is none, or no SDL."""
    if importlib.util.find_spec("pygame") is None:
        raise LiveError(f"a gamepad is read by SDL, which is not here: pip install '{EXTRA}'")
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # events without a window
    os.environ.setdefault("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "1")
    import pygame
    from pygame._sdl2 import controller

    pygame.display.init()
    controller.init()
    try:
        found = next((i for i in range(controller.get_count()) if controller.is_controller(i)), None)
        if found is None:
            raise LiveError(
                "no gamepad is connected, or SDL does not know it; plug one in, or leave --gamepad out"
            )
        yield Gamepad(pygame, controller.Controller(found))
    finally:
        controller.quit()
        pygame.display.quit()
