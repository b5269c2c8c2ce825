"""What can be wrong with a log file, and with the name of a file that is to be drawn from it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from uuvtai.errors import UserError


class LogError(UserError, RuntimeError):
    """A log that cannot be written, read or drawn: the message says what, where, why and what to type
    next."""


def checked_suffix(out: Path, formats: Sequence[str], what: str) -> str:
    """The ending of ``out`` in small letters. Raises LogError for one that is not among ``formats``: no file
    says what it is not."""
    suffix = out.suffix.lower()
    if suffix not in formats:
        raise LogError(
            f"{out}: a {what} can be {', '.join(formats)}; give a name that ends so with --out FILE"
        )
    return suffix
