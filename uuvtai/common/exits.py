"""How a command ends: an exit code, one message, and for a bug of ours a file with the traceback."""

from __future__ import annotations

import errno
import os
import platform
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from typing import Any

import typer

from uuvtai.common import signals
from uuvtai.common.errors import OwnCodeError, UserError
from uuvtai.common.version import __version__

OK, FAILED, USAGE, GATE, INTERRUPTED = 0, 1, 2, 3, 130

UsageError: Any = typer.BadParameter.__base__
"""Typer carries its own copy of click from 0.26 on, so the class is taken from what Typer exports."""

_SYSTEM_NAMES = (
    "ENOSPC", "EDQUOT", "EFBIG", "EIO", "EROFS", "EMFILE", "ENFILE", "ENOMEM", "EAGAIN", "EACCES", "EPERM",
    "ESTALE",
)  # fmt: skip
_SYSTEM = tuple(getattr(errno, name) for name in _SYSTEM_NAMES if hasattr(errno, name))
"""what the system may refuse at any moment, whatever was typed and however right the program is"""

_LONGEST = 300


def guarded(run: Callable[[], Any]) -> int:
    """Run a command; its exit code. Whatever goes wrong is told on stderr."""
    try:
        code = run()
        _flush()
        if code == INTERRUPTED:  # Typer turns Ctrl-C into this
            return _interrupted()
        return code if isinstance(code, int) else OK
    except (KeyboardInterrupt, typer.Abort):
        return _interrupted()
    except BaseException as error:
        if signals.was_received():  # compiled code in between has made another error of it
            return _interrupted()
        return _ended_by(error)


def reported(text: str, code: int) -> int:
    """Say it on stderr; the code."""
    say(text)
    return code


def say(text: str) -> None:
    """A message, on stderr: stdout belongs to results."""
    typer.echo(plain(text), err=True)


def plain(text: str) -> str:
    """Text that a file may have brought along, without what would steer the terminal."""
    return "".join(c if c.isprintable() or c in "\n\t" else "?" for c in text)


def _ended_by(error: BaseException) -> int:
    if isinstance(error, UsageError.__base__):
        error.show()
        return USAGE
    if isinstance(error, OwnCodeError) and error.__cause__ is not None:
        return _own_code(error)
    if isinstance(error, UserError):
        return reported(f"uuv: {error}", USAGE)
    if isinstance(error, BrokenPipeError):  # the reader of our output has gone (| head): not an error of ours
        _drop_output()
        return OK
    if isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG:
        return reported(f"uuv: {_one_line(error)}; give a shorter path", USAGE)
    if isinstance(error, OSError) and error.errno in _SYSTEM:
        _settle_output()
        return reported(f"uuv: {_one_line(error)}; make room, or choose another place", FAILED)
    if _is_out_of_memory(error):
        return reported(
            f"uuv: out of memory ({_one_line(error) or 'no more is known'}); try a smaller --num-envs", FAILED
        )
    if isinstance(error, SystemExit):
        return (
            error.code
            if isinstance(error.code, int)
            else OK
            if error.code is None
            else reported(str(error.code), FAILED)
        )
    # one line, and all that a report needs in a file; with UUV_DEBUG=1 in the terminal
    what = f"uuv: a bug of ours: {type(error).__name__}: {_one_line(error)}"
    kept = _kept(error, "uuv-bug")
    return reported(f"{what}; please report it with {kept}" if _is_file(kept) else f"{what}{kept}", FAILED)


def _is_out_of_memory(error: BaseException) -> bool:
    """Python's own, and torch's on a GPU and on a CPU, without importing torch."""
    is_told = isinstance(error, RuntimeError) and (
        "can't allocate memory" in str(error) or "not enough memory" in str(error)
    )
    return isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError" or is_told


def _interrupted() -> int:
    if sys.platform != "win32":
        import signal

        signal.setitimer(signal.ITIMER_REAL, 0.0)
    _settle_output()
    return reported("interrupted", signals.exit_code())


def _own_code(error: BaseException) -> int:
    """The line of the user's own file that failed, and the way to it in a file."""
    kept = _kept(error, "uuv-own")
    return reported(
        f"uuv: {error}; its traceback: {kept}" if _is_file(kept) else f"uuv: {error}{kept}", USAGE
    )


def _kept(error: BaseException, prefix: str) -> str:
    """The file that holds the traceback; or, beginning with a semicolon or empty, why there is none."""
    trace = "".join(traceback.format_exception(type(error), error, error.__traceback__))
    if os.environ.get("UUV_DEBUG") == "1":
        sys.stderr.write(plain(trace))
        return ""
    about = f"uuvtai {__version__}, Python {platform.python_version()}, {platform.platform()}\n{sys.argv}\n"
    try:
        handle, name = tempfile.mkstemp(prefix=f"{prefix}-{time.strftime('%Y%m%d-%H%M%S')}-", suffix=".txt")
        with os.fdopen(handle, "w", encoding="utf-8", errors="backslashreplace") as file:
            file.write(about + trace)
    except OSError as reason:
        return f"; its traceback could not be kept ({reason.strerror}): UUV_DEBUG=1 shows it"
    return name


def _is_file(kept: str) -> bool:
    return bool(kept) and not kept.startswith(";")


def _one_line(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return text if len(text) <= _LONGEST else text[:_LONGEST] + " ..."


def _flush() -> None:
    """See the results out while an error can still be told; Python's own flush at the very end prints
    tracebacks."""
    if sys.stdout is not None:
        sys.stdout.flush()


def _settle_output() -> None:
    try:
        _flush()
    except (OSError, ValueError):
        _drop_output()


def _drop_output() -> None:
    """Nobody reads stdout any more, or it cannot be written: what is left in its buffer goes nowhere."""
    try:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        os.close(null)
    except (OSError, ValueError, AttributeError):
        pass  # no file behind it: a test, a notebook
