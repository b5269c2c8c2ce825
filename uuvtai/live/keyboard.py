"""Keys of a terminal as they are pressed, without waiting for the end of the line."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from uuvtai.live.viewer_server import LiveError

UP, DOWN, RIGHT, LEFT = "up", "down", "right", "left"
_ARROWS = {"A": UP, "B": DOWN, "C": RIGHT, "D": LEFT}
_WINDOWS_ARROWS = {"H": UP, "P": DOWN, "M": RIGHT, "K": LEFT}
_MOST = 1024
"""[bytes] read at once: who leans on a key is not answered key by key"""


class Keys(Protocol):
    """Where keys come from."""

    def pressed(self) -> list[str]:
        """Those pressed since the last call, oldest first: characters, and names of the arrows."""
        ...


class TerminalKeys:
    """The keyboard of a terminal on POSIX."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    def pressed(self) -> list[str]:
        """Those pressed since the last call."""
        if not select.select([self._descriptor], [], [], 0)[0]:
            return []
        return keys_of(os.read(self._descriptor, _MOST).decode("utf-8", "ignore"))


class ConsoleKeys:
    """The keyboard of a console on Windows."""

    def pressed(self) -> list[str]:
        """Those pressed since the last call."""
        import msvcrt  # there alone

        found = []
        while msvcrt.kbhit():  # type: ignore[attr-defined]
            key = msvcrt.getwch()  # type: ignore[attr-defined]
            if key in ("\0", "\xe0"):
                key = _WINDOWS_ARROWS.get(msvcrt.getwch(), "")  # type: ignore[attr-defined]
            found.append(key)
        return found


def keys_of(text: str) -> list[str]:
    """Keys of what a terminal sends: an arrow is three characters (ECMA-48, cursor keys)."""
    found, rest = [], text
    while rest:
        if rest[:2] in ("\x1b[", "\x1bO") and rest[2:3] in _ARROWS:
            found.append(_ARROWS[rest[2]])
            rest = rest[3:]
        else:
            found.append(rest[0])
            rest = rest[1:]
    return found


@contextmanager
def keyboard() -> Iterator[Keys]:
    """The keyboard of standard input, which is put back as it was. Raises LiveError where that is none."""
    if not (sys.stdin and sys.stdin.isatty()):
        raise LiveError(
            "standard input is no terminal, so there is no keyboard to steer with; run uuv drive in a "
            "terminal, without a pipe"
        )
    if os.name == "nt":
        yield ConsoleKeys()
        return
    import termios
    import tty

    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    try:
        tty.setcbreak(descriptor)  # Ctrl-C stays a signal
        yield TerminalKeys(descriptor)
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
