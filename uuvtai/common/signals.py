"""SIGINT, SIGTERM and SIGHUP, heard alike from the first line on: at once while there is nothing to lose,
else by an exception that tidies up.

Standard library only, and little of it: the entry point imports this before anything else. Until ``engage``
is called (a run folder, a file under way) a signal says "interrupted" and ends the process on the spot. From
then on it raises ``Interrupted``, a KeyboardInterrupt, so that ``finally`` clauses do their work; not in the
middle of an import or of a finaliser, where exceptions get lost, nor in the middle of a write that would be
left half done (``never_within``), but right after. The second signal of a kind
is the system's own affair: it ends the process at once, even while compiled code holds the interpreter.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from threading import Event
    from types import FrameType
    from typing import Any

STOPPING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Ctrl-C, a supervisor, a terminal that closes"""
_AGAIN_S = 0.02
_LOADERS = ("<frozen importlib._bootstrap>", "<frozen importlib._bootstrap_external>")
_LINUX_FLAGS_AT, _RESET_HAND = 8 + 128, 0x80000000
"""struct sigaction of glibc and musl on 64 bits: handler, 128 bytes of mask, flags"""

_received: list[int] = []
_unbroken: set[str] = set()
_installed: list[bool] = []
_engaged: list[bool] = []
_finished: list[int] = []


class Interrupted(KeyboardInterrupt):
    """The user, or whoever supervises us, wants the process to end."""


def exit_code() -> int:
    """128 + number of the signal that was received; 130, that of Ctrl-C, where none was."""
    return 128 + (_received[0] if _received else signal.SIGINT)


def was_received() -> bool:
    """Whether a signal has told this process to end."""
    return bool(_received)


def install() -> None:
    """Hear these signals, also where a library has set its handlers; an ignored one stays so (nohup)."""
    for number in STOPPING:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _on_signal)
    if not _installed:  # what is registered first runs last
        atexit.register(_rest)
    _installed[:] = [True]
    sys.unraisablehook = _unraisable


def reinstall() -> None:
    """As ``install``, in processes that have done so."""
    if _installed:
        install()
        end_at_second()


def engage() -> None:
    """From now on there is something to tidy up."""
    _engaged[:] = [True]


def never_within(file: str) -> None:
    """From now on no signal raises while a function of this source file runs: call it with ``__file__``."""
    _unbroken.add(file)


class StopEvent:
    """Context in which the first signal sets ``event``, in place of what it does otherwise; the next one ends
    at once, or interrupts; unless ``is_last`` is false: then it changes nothing, for what is under way must
    end well. A signal that came before, and whose exception something has swallowed, counts."""

    def __init__(self, is_last: bool = True) -> None:
        import threading

        self._is_last = is_last
        self.event = threading.Event()
        self._before: dict[signal.Signals, Any] = {}
        self._on_main_thread = threading.current_thread() is threading.main_thread()
        """signals go to the main thread; whoever runs this elsewhere stops it otherwise"""

    def __enter__(self) -> Event:
        """Listen."""
        if self._on_main_thread:
            heard = [number for number in STOPPING if signal.getsignal(number) != signal.SIG_IGN]
            self._before = {number: signal.signal(number, self._note) for number in heard}
            if self._is_last:
                end_at_second()
        if was_received():
            self.event.set()
        return self.event

    def __exit__(self, *_error: object) -> None:
        """As before; but after a signal the next one is still the last."""
        if self.event.is_set() and _installed:
            return
        for number, handler in self._before.items():
            signal.signal(number, handler)
        end_at_second()

    def _note(self, number: int, _frame: FrameType | None) -> None:
        if self.event.is_set() and self._is_last:
            raise Interrupted
        if _installed:
            _received.append(number)
        self.event.set()


def finish(code: int) -> None:
    """The command is over, the interpreter tidies up: a signal only shortens that, with this code."""
    _finished[:] = [code]


def end_at_second() -> None:
    """Leave the second signal of a kind to the system, which does not wait for the interpreter (Linux)."""
    if (
        not _installed
        or sys.platform != "linux"
        or sys.maxsize < 2**32
        or os.uname().machine not in ("x86_64", "aarch64")
    ):
        return
    import ctypes

    libc = ctypes.CDLL(None)
    for number in STOPPING:
        if signal.getsignal(number) in (signal.SIG_IGN, signal.SIG_DFL, None):
            continue
        action = ctypes.create_string_buffer(256)
        if libc.sigaction(int(number), None, action) == 0:
            flags = ctypes.c_uint32.from_buffer(action, _LINUX_FLAGS_AT)
            flags.value |= _RESET_HAND
            libc.sigaction(int(number), action, None)


def _on_signal(number: int, frame: FrameType | None) -> None:
    _received.append(number)
    if _finished:
        os._exit(_finished[0])
    if not _engaged or len(_received) > 1:
        _say("interrupted\n")
        os._exit(exit_code())
    _deliver(number, frame)


def _deliver(_number: int, frame: FrameType | None) -> None:
    """Raise, or look again soon."""
    if _finished:
        return
    if _ignores_signals(frame):
        signal.signal(signal.SIGALRM, _deliver)
        signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
        return
    raise Interrupted


def _ignores_signals(frame: FrameType | None) -> bool:
    """Whether an exception would get lost here: in an import (extension modules make other errors of it), in
    a finaliser; or would leave a file half written."""
    if not hasattr(signal, "setitimer"):
        return False
    while frame is not None:
        file = frame.f_code.co_filename
        if file in _LOADERS or file in _unbroken or frame.f_code.co_name == "__del__":
            return True
        frame = frame.f_back
    return False


def _unraisable(unraisable: Any) -> None:
    """An interrupt that a callback or finaliser has swallowed is raised once more, outside of it."""
    if isinstance(unraisable.exc_value, Interrupted):
        if hasattr(signal, "setitimer"):
            signal.signal(signal.SIGALRM, _deliver)
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
        return
    if not _received:
        sys.__unraisablehook__(unraisable)


def _rest() -> None:
    """Python is about to restore the system's handlers: a signal then would change the exit code only."""
    for number in STOPPING:
        signal.signal(number, signal.SIG_IGN)


def _say(text: str) -> None:
    try:  # noqa: SIM105 - contextlib is more than is imported here
        os.write(2, text.encode())
    except OSError:
        pass
