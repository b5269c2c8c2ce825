"""A person's hands: the keyboard, perhaps a gamepad, and a place to see what they do."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager

from uuvtai.live.gamepad import STICKS_HELP, gamepad
from uuvtai.live.hand_driver import HandPiece, Show
from uuvtai.live.hand_steering import HELP
from uuvtai.live.keyboard import keyboard


@contextmanager
def at_the_wheel(
    rate: float, use_gamepad: bool, view: Callable[[str], AbstractContextManager[Show]]
) -> Iterator[HandPiece]:
    """Who drives ``rate`` seconds of the episode in one of the clock's; ``view``: shows what the vehicle
    knows, below it the text it is given. Raises LiveError."""
    with ExitStack() as held:
        sticks = held.enter_context(gamepad()) if use_gamepad else None
        keys = held.enter_context(keyboard())
        show = held.enter_context(view(f"{STICKS_HELP}\n{HELP}" if sticks else HELP))
        yield HandPiece(keys, show, rate, sticks)
