"""What can be wrong with a log file."""

from uuvtai.errors import UserError


class LogError(UserError, RuntimeError):
    """A log that cannot be written, read or drawn: the message says what, where, why and what to type next."""
