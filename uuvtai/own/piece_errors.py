"""What goes wrong in a piece of the user's, told by her file and line."""

from __future__ import annotations

from pathlib import Path
from types import FrameType, TracebackType

from uuvtai.errors import OwnCodeError


class PieceError(OwnCodeError):
    """A piece cannot be used, or its code failed: which line, what, and what is wanted."""


def failed(error: BaseException, path: Path, what: str) -> PieceError:
    """Of an exception in the user's code: the last line of her file on the way to it."""
    line = line_in(error.__traceback__, path)
    if isinstance(error, SyntaxError) and error.filename == str(path):
        line = error.lineno
    place = f"{path}:{line}" if line else str(path)
    reason = " ".join(str(error).split())[:300]
    told = f"{place}: {type(error).__name__}{f': {reason}' if reason else ''} ({what})"
    found = PieceError(told)
    found.__cause__ = error
    return found


def line_in(trace: TracebackType | None, path: Path) -> int | None:
    """Line of ``path`` that was reached last on the way to an exception; None = none was."""
    found = None
    while trace is not None:
        if _is(trace.tb_frame, path):
            found = trace.tb_lineno
        trace = trace.tb_next
    return found


def line_of_frame(frame: FrameType | None, path: Path) -> int | None:
    """Line of ``path`` that runs now, or has called what runs."""
    while frame is not None and not _is(frame, path):
        frame = frame.f_back
    return frame.f_lineno if frame is not None else None


def _is(frame: FrameType, path: Path) -> bool:
    return frame.f_code.co_filename == str(path)
